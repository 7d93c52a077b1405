"""Mutated input files for every loader: no traceback, no hang, no memory blow-up, no code run.

    .venv/bin/python scripts/fuzz_loaders.py --run runs/demo --count 20000

Good files are taken from a finished run. Each is damaged at random: bytes flipped, cut off, doubled, swapped; JSON
values replaced by others; and, where a checksum would stop a change at the door, the checksum is made to fit
again. A loader may return or raise `UserError`; anything else counts against it, as do more than 5 s or 1 GB, a
process that dies, and a payload (a pickle, a script in a rule file) that gets to run.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from scripts.mutations import fit_checksum, mutate

MOST_SECONDS = 5.0
MOST_BYTES = 1 << 30
BATCH = 200


@dataclass(frozen=True)
class Loader:
    """Something that reads files of strangers.

    Attributes:
        name: as printed.
        files: paths that it reads, relative to the scratch folder; mutated one at a time.
        load: reads them from the scratch folder.
    """

    name: str
    files: tuple[str, ...]
    load: Callable[[Path], Any]


@dataclass(frozen=True)
class Failure:
    """A mutation that a loader did not take well."""

    loader: str
    number: int
    mutation: str
    what: str


def loaders() -> tuple[Loader, ...]:
    """Every loader of the project; heavy imports happen here, not while loading is timed."""
    from nesy.asp import KnowledgeBase
    from nesy.cli import configuration
    from nesy.dbn import Codebook, TwoSliceDBN
    from nesy.formats import read
    from nesy.log.experience import Experience
    from nesy.report.page import section_body
    from nesy.report.sections import provenance, world_model
    from nesy.run_folder import RunFolder
    from nesy.world_model import load_world_model
    from planners.comparison.replay.record import load_replays
    from planners.dqn.dqn import DQNPolicy
    from planners.explicit.pomdp import TabularPOMDP
    from planners.person_following.ialm import IALM

    def summary(root: Path) -> None:
        run = RunFolder(root)
        for section in (world_model, provenance):
            section_body(section, run, run.read_summary())

    dbn_files = ("dbn/model.json", "dbn/tables.npz")
    return (
        Loader("config.json", ("config.json",), lambda root: configuration.load(root / "config.json")),
        Loader("summary.json", ("summary.json",), summary),
        Loader("experience", ("experience/part-00000.parquet",), lambda root: Experience.load(root / "experience")),
        Loader("world model", ("world_model/model.safetensors", "world_model/config.json"),
               lambda root: load_world_model(root / "world_model")),
        Loader("2DBN", dbn_files, lambda root: TwoSliceDBN.load(root / "dbn")),
        Loader("codebook", ("dbn/codebook.json", "dbn/codebook.npz"), lambda root: Codebook.load(root / "dbn")),
        Loader("jgum", ("small.jgum",), lambda root: read(root / "small.jgum")),
        Loader("parquet table", ("small.parquet",), lambda root: read(root / "small.parquet")),
        Loader("pomdp file", ("tiger.pomdp",), lambda root: TabularPOMDP.from_file(root / "tiger.pomdp")),
        Loader("policy", ("policy.safetensors",), lambda root: DQNPolicy.load(root / "policy.safetensors")),
        Loader("IALM", ("ialm/model.json", "ialm/tables.npz"), lambda root: IALM.load(root / "ialm")),
        Loader("replays", ("results/replays.json",), lambda root: load_replays(root / "results/replays.json")),
        Loader("rule file", ("mine.lp",),
               lambda root: KnowledgeBase.from_folder(root / "dbn").query(root / "mine.lp", time_limit=2.0)),
    )  # fmt: skip


RULES = """% what the robot must not do
forbidden(forward) :- now(wall_ahead).
preferred(left) :- at(3,5), not now(goal_visible).
count(N) :- N = #count { F : at(F,V), V > 2 }.
#show count/1.
"""
TIGER = """discount: 0.95
values: reward
states: tiger-left tiger-right
actions: listen open-left open-right
observations: hear-left hear-right
start: uniform
T: listen
identity
T: open-left
uniform
T: open-right
uniform
O: listen
0.85 0.15
0.15 0.85
O: open-left
uniform
O: open-right
uniform
R: listen : * : * : * -1
R: open-left : tiger-left : * : * -100
R: open-left : tiger-right : * : * 10
R: open-right : tiger-left : * : * 10
R: open-right : tiger-right : * : * -100
"""


def good_files(run: Path, scratch: Path) -> None:
    """Copy from a run what loaders read, and write the files of other formats."""
    from nesy.dbn import TwoSliceDBN
    from nesy.formats import export

    for name in ("config.json", "summary.json", "world_model", "dbn", "ialm", "results"):
        source = run / name
        if source.is_dir():
            shutil.copytree(source, scratch / name, ignore=shutil.ignore_patterns("practice", "tensorboard", "cells"))
        else:
            shutil.copy(source, scratch / name)
    (scratch / "experience").mkdir()
    shutil.copy(min((run / "experience").glob("*.parquet"), key=lambda p: p.stat().st_size),
                scratch / "experience" / "part-00000.parquet")  # fmt: skip
    shutil.copy(sorted((run / "policies").glob("*.safetensors"))[0], scratch / "policy.safetensors")
    rng = np.random.default_rng(0)
    small = TwoSliceDBN.from_tables(
        [[rng.dirichlet(np.ones(3), size=9) for _ in range(3)] for _ in range(2)],
        [[(0, 1), (1, 2), (0, 2)]] * 2,
        action_names=("left", "right"),
    )
    export(small, scratch / "small.jgum")
    export(small, scratch / "small.parquet")
    small.save(scratch / "dbn-small")
    (scratch / "tiger.pomdp").write_text(TIGER)
    (scratch / "mine.lp").write_text(RULES)


# ---------------------------------------------------------------- running
def fuzz(run: Path, count: int, seed: int = 0, only: str = "") -> tuple[list[Failure], Counter[str]]:
    """Mutate and load `count` times, spread evenly over the loaders.

    Args:
        run: a finished run.
        count: mutations in all.
        seed: of the mutations.
        only: name of one loader, or empty for all.

    Returns:
        The failures, and how many mutations each loader was given and how many it took (`NAME: loaded`).
    """
    chosen = [loader for loader in loaders() if only in ("", loader.name)]
    failures: list[Failure] = []
    tally: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder) / "files"
        scratch.mkdir()
        good_files(run, scratch)
        for position, loader in enumerate(chosen):
            share = count // len(chosen) + (position < count % len(chosen))
            loader.load(scratch)  # the good files load, and what is imported late is imported
            for first in range(0, share, BATCH):
                numbers = range(first, min(first + BATCH, share))
                failures += _batch(loader, scratch, numbers, seed, tally)
    return failures, tally


def _batch(loader: Loader, scratch: Path, numbers: range, seed: int, tally: Counter[str]) -> list[Failure]:
    """Load in a process of its own, which may die or hang without taking the others along."""
    context = multiprocessing.get_context("fork")
    found: list[Failure] = []
    begin = numbers.start
    while begin < numbers.stop:
        receiving, sending = context.Pipe(duplex=False)
        worker = context.Process(target=_work, args=(loader, scratch, range(begin, numbers.stop), seed, sending))
        worker.start()
        sending.close()
        done, what = begin, ""
        while done < numbers.stop:
            if not receiving.poll(3 * MOST_SECONDS + 10):
                what = "hangs"
                break
            try:
                failure, loaded = receiving.recv()
            except EOFError:
                worker.join()
                what = f"the process dies with status {worker.exitcode}"
                break
            done += 1
            tally[loader.name] += 1
            tally[f"{loader.name}: loaded"] += loaded
            if failure is not None:
                found.append(failure)
        if what:
            found.append(Failure(loader.name, done, "unknown", what))
            tally[loader.name] += 1
            worker.kill()
            done += 1
        worker.join()
        begin = done
    return found


def _work(loader: Loader, scratch: Path, numbers: range, seed: int, sending: Any) -> None:
    import torch

    torch.set_num_threads(1)  # the threads of the process that was forked are not here, and would be waited for
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "files"
        canary = Path(folder) / "canary"
        shutil.copytree(scratch, root)
        for number in numbers:
            sending.send(_one(loader, root, number, seed, canary))


def _one(loader: Loader, root: Path, number: int, seed: int, canary: Path) -> tuple[Failure | None, bool]:
    from domains.core import DomainError
    from nesy.errors import UserError

    rng = np.random.default_rng([seed, number, *loader.name.encode()])
    path = root / loader.files[int(rng.integers(len(loader.files)))]
    written = {path: path.read_bytes()}
    kind, content = mutate(path, written[path], rng, canary)
    path.write_bytes(content)
    if path.suffix == ".npz" and rng.random() < 0.9:
        fit_checksum(path, content, written)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started = time.perf_counter()
    what, loaded = "", False
    try:
        loader.load(root)
        loaded = True
    except (UserError, DomainError) as error:
        if len(str(error)) > 2000 or not str(error).strip():
            what = f"a message of {len(str(error))} characters"
    except BaseException:
        what = "".join(traceback.format_exc().strip().splitlines()[-3:])
    seconds = time.perf_counter() - started
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    if seconds > MOST_SECONDS:
        what = f"{seconds:.1f} s"
    if grown > MOST_BYTES:
        what = f"{grown >> 20} MiB of memory"
    if canary.exists():
        canary.unlink()
        what = "code of the file was run"
    for changed, good in written.items():
        changed.write_bytes(good)
    return (Failure(loader.name, number, f"{kind} in {path.name}", what) if what else None), loaded


def main() -> int:
    """Print the table and the failures; the status is 1 if there are any."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--run", type=Path, default=Path("runs/demo"), help="a finished run")
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="one loader")
    options = parser.parse_args()
    started = time.perf_counter()
    failures, tally = fuzz(options.run, options.count, options.seed, options.only)
    for name in [name for name in tally if ": loaded" not in name]:
        bad = sum(failure.loader == name for failure in failures)
        print(f"{name:16} {tally[name]:6} mutations, {tally[f'{name}: loaded']:6} loaded, {bad:4} failures")
    for failure in failures[:40]:
        print(f"  {failure.loader} #{failure.number} ({failure.mutation}): {failure.what}")
    print(f"{len(failures)} failures in {options.count} mutations, {time.perf_counter() - started:.0f} s")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
