"""Mutated input files for every loader: no traceback, no hang, no memory blow-up, no code run.

    .venv/bin/python scripts/fuzz_loaders.py --run runs/demo --count 20000

Good files are taken from a finished run. Each is damaged at random: bytes flipped, cut off, doubled, swapped; JSON
values replaced by others; and, where a checksum would stop a change at the door, the checksum is made to fit
again. A loader may return or raise `UserError`; anything else counts against it, as do more than 5 s or 1 GB, a
process that dies, and a payload (a pickle, a script in a rule file) that gets to run.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import multiprocessing
import pickle
import resource
import shutil
import sys
import tempfile
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

MOST_SECONDS = 5.0
MOST_BYTES = 1 << 30
BATCH = 200
_AWKWARD: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2**31, 2**63, -(2**70), 10**400, 1e308, -0.5, "", "x", "\x00", "../../etc/passwd", [], {},
    [[]], [0] * 1000, {"format": 1}, "é\ud83d",
)  # fmt: skip


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
    from nesy.experience import Experience
    from nesy.formats import read
    from nesy.report.page import section_body
    from nesy.report.sections import provenance, world_model
    from nesy.run_folder import RunFolder
    from nesy.world_model import load_world_model
    from planners.dqn import DQNPolicy
    from planners.ialm import IALM
    from planners.pomdp import TabularPOMDP
    from planners.replay import load_replays

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


# ---------------------------------------------------------------- mutations
def mutate(path: Path, content: bytes, rng: np.random.Generator, canary: Path) -> tuple[str, bytes]:
    """A damaged version of a file, and how it was damaged."""
    kinds: list[tuple[str, Callable[[], bytes]]] = [
        ("bytes", lambda: _bytes(content, rng)),
        ("cut", lambda: content[: int(rng.integers(len(content) + 1))]),
        ("spliced", lambda: _spliced(content, rng)),
        ("payload", lambda: _payload(path, content, rng, canary)),
    ]
    if path.suffix in (".json", ".jgum"):
        kinds += [("json", lambda: _json(path, content, rng))] * 4
    if path.suffix == ".npz":
        kinds += [("array", lambda: _npz(content, rng))] * 3
    if path.suffix == ".parquet":
        kinds += [("column", lambda: _column(content, rng))] * 3
    if path.suffix == ".safetensors":
        kinds += [("header", lambda: _header(content, rng))] * 3
    if path.suffix in (".lp", ".pomdp"):
        kinds += [("words", lambda: _words(content, rng))] * 4
    name, make = kinds[int(rng.integers(len(kinds)))]
    return name, make()


def _bytes(content: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(content or b"\0")
    for _ in range(int(rng.integers(1, 9))):
        changed[int(rng.integers(len(changed)))] = int(rng.integers(256))
    return bytes(changed)


def _spliced(content: bytes, rng: np.random.Generator) -> bytes:
    a, b, c = sorted(int(rng.integers(len(content) + 1)) for _ in range(3))
    return (
        content[:a] + content[b:],
        content[:b] + content[a:],
        content[:a] + content[b:c] + content[a:b] + content[c:],
        content[:a] + bytes(b - a) + content[b:],
        b"",
    )[int(rng.integers(5))]


class _Hurt:
    """Unpickled, it leaves a file behind."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, (str(self.canary), "w"))


def _payload(path: Path, content: bytes, rng: np.random.Generator, canary: Path) -> bytes:
    if path.suffix == ".lp":
        script = f"#script (python)\nopen({str(canary)!r}, 'w')\n#end.\n".encode()
        lua = f"#script (lua)\nio.open({json.dumps(str(canary))}, 'w')\n#end.\n".encode()
        include = b'#include "/etc/passwd".\n'
        return content + (script, lua, include)[int(rng.integers(3))]
    poison = pickle.dumps(_Hurt(canary))
    if path.suffix == ".npz":
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr("tables.npy", poison)
        return (poison, buffer.getvalue())[int(rng.integers(2))]
    return (poison, content + poison)[int(rng.integers(2))]


def _json(path: Path, content: bytes, rng: np.random.Generator) -> bytes:
    """One value somewhere replaced, doubled or removed; the checksum of a sealed document is made to fit again."""
    from nesy.dbn import storage

    document = json.loads(content)
    sealed = isinstance(document, dict) and document.pop("checksum", None) is not None
    place: Any = document
    for _ in range(int(rng.integers(1, 6))):
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        if not keys:
            break
        key = keys[int(rng.integers(len(keys)))]
        if isinstance(place[key], dict | list) and place[key] and rng.random() < 0.7:
            place = place[key]
            continue
        kind = int(rng.integers(4))
        if kind == 0 and isinstance(place, dict):
            del place[key]
        elif kind == 1 and isinstance(place, list):
            place.append(place[key])
        elif kind == 2 and isinstance(place[key], int) and not isinstance(place[key], bool):
            place[key] += int(rng.integers(-3, 4))
        else:
            place[key] = _AWKWARD[int(rng.integers(len(_AWKWARD)))]
        break
    if sealed and rng.random() < 0.9:
        try:
            return storage._seal(document)
        except (ValueError, UnicodeError):
            pass
    return json.dumps(document, ensure_ascii=True).encode()


def _npz(content: bytes, rng: np.random.Generator) -> bytes:
    """One array with other numbers, another shape or another type; see `_fit` for the checksum."""
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    name = list(arrays)[int(rng.integers(len(arrays)))]
    array = arrays[name].copy()
    kind = int(rng.integers(6))
    if kind == 0 and array.size:
        flat = array.reshape(-1).view(np.uint8)
        flat[rng.integers(len(flat), size=4)] = rng.integers(256, size=4)
    elif kind == 1:
        array = array[:-1] if array.ndim and len(array) else array
    elif kind == 2:
        array = array.astype((np.float32, np.int64, np.uint8, np.complex128, "U4")[int(rng.integers(5))])
    elif kind == 3:
        array = array.reshape(-1)
    elif kind == 4 and array.dtype.kind == "f" and array.size:
        array.reshape(-1)[int(rng.integers(array.size))] = (np.nan, np.inf, -1.0, 1e300)[int(rng.integers(4))]
    else:
        del arrays[name]
        array = np.zeros(0)
    if name in arrays:
        arrays[name] = array
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for key, value in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.ascontiguousarray(value), allow_pickle=False)
            archive.writestr(f"{key}.npy", member.getvalue())
    return buffer.getvalue()


def _column(content: bytes, rng: np.random.Generator) -> bytes:
    """One Parquet column renamed, dropped, doubled, of another type, or with other values."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(content))
    i = int(rng.integers(table.num_columns))
    name, column = table.column_names[i], table.column(i)
    kind = int(rng.integers(5))
    if kind == 0:
        table = table.drop_columns([name])
    elif kind == 1:
        table = table.rename_columns([f"{n}x" if j == i else n for j, n in enumerate(table.column_names)])
    elif kind == 2:
        table = table.set_column(i, name, pa.array([str(_AWKWARD[int(rng.integers(6))])] * table.num_rows))
    elif kind == 3:
        table = table.set_column(i, name, pa.nulls(table.num_rows, column.type))
    elif pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
        values = column.to_numpy().copy()
        values[rng.integers(len(values), size=3)] = (0, 100, 127)[int(rng.integers(3))]
        table = table.set_column(i, name, pa.array(values, column.type))
    else:
        table = table.slice(0, int(rng.integers(table.num_rows)))
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def _header(content: bytes, rng: np.random.Generator) -> bytes:
    """A safetensors header with one value replaced."""
    length = int.from_bytes(content[:8], "little")
    header = _json(Path("x.json"), content[8 : 8 + length], rng)
    return len(header).to_bytes(8, "little") + header + content[8 + length :]


def _words(content: bytes, rng: np.random.Generator) -> bytes:
    words = content.decode().split(" ")
    pool = (
        *words,
        "*",
        "-1",
        "1e999",
        "nan",
        "99999999999",
        ":",
        "#include",
        "{",
        "1..10000000.",
        "not",
        "\n",
        "X",
        "(",
    )
    for _ in range(int(rng.integers(1, 4))):
        i = int(rng.integers(len(words)))
        words[i] = pool[int(rng.integers(len(pool)))]
    return " ".join(words).encode()


def _fit(root: Path, path: Path, content: bytes, written: dict[Path, bytes]) -> None:
    """Let the document beside a changed .npz name its new checksum, so that the loader looks inside."""
    from nesy.dbn import storage

    beside = next((p for p in path.parent.glob("*.json") if path.name.encode() in p.read_bytes()), None)
    if beside is None:
        return
    document = json.loads(beside.read_bytes())
    tables = document.get("tables")
    if isinstance(tables, dict) and "sha256" in tables and document.pop("checksum", None) is not None:
        written[beside] = beside.read_bytes()
        tables["sha256"] = hashlib.sha256(content).hexdigest()
        beside.write_bytes(storage._seal(document))


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
        _fit(root, path, content, written)
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
