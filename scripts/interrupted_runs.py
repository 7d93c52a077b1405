"""Runs killed at random moments and resumed: each must end as the undisturbed run did, apart from times.

    .venv/bin/python scripts/interrupted_runs.py --kills 50

Every run is started in a process group of its own and killed as a whole, worker processes included, after a random
time. Then the folder must hold whole files only, and the same command must finish it with the same results.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from safetensors.numpy import load_file

SMOKE = ("--preset", "smoke", "--jobs", "2")
IGNORED = ("tensorboard", ".lock", "report.html")
TIMES = frozenset({"timing", "ms", "ms_per_decision", "seconds", "time", "train_seconds", "steps_per_second", "rate"})
"""Names of figures that measure time, at any depth."""


def start(folder: Path, options: Sequence[str]) -> subprocess.Popen[bytes]:
    """`nesy run` on a folder, in a process group of its own."""
    command = [sys.executable, "-m", "nesy.cli.main", "run", "--run", str(folder), *options]
    return subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
        cwd=Path(__file__).parents[1],
    )


def finish(folder: Path, options: Sequence[str]) -> tuple[int, str, float]:
    """Run to the end: status, standard error, seconds."""
    started = time.perf_counter()
    process = start(folder, options)
    try:
        _, said = process.communicate()
    except BaseException:  # we are being stopped: do not leave the run behind
        os.killpg(process.pid, signal.SIGKILL)
        raise
    return process.returncode, said.decode(errors="replace"), time.perf_counter() - started


def interrupt(folder: Path, options: Sequence[str], after: float, number: int) -> tuple[int | None, str]:
    """Run for a while, then send a signal to the whole group; status None where the run was done before."""
    process = start(folder, options)
    try:
        process.communicate(timeout=after)
        return None, ""
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, number)
    except BaseException:
        os.killpg(process.pid, signal.SIGKILL)
        raise
    _, said = process.communicate()
    return process.returncode, said.decode(errors="replace")


def interrupt_when(folder: Path, options: Sequence[str], pattern: str, number: int = signal.SIGKILL) -> tuple[int, str]:
    """Run until a file of the pattern is there, then send a signal to the whole group.

    Raises:
        RuntimeError: the run ended without such a file.
    """
    process = start(folder, options)
    try:
        while not any(folder.glob(pattern)):
            if process.poll() is not None:
                raise RuntimeError(f"the run ended with status {process.returncode} before there was a {pattern}")
            time.sleep(0.01)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, number)
    _, said = process.communicate()
    return process.returncode, said.decode(errors="replace")


def half_written(folder: Path) -> list[str]:
    """Files that cannot be read; what a killed writer left under a temporary name does not count."""
    bad = []
    for path in sorted(folder.rglob("*")):
        if path.name.startswith(".") or not path.is_file() or "tensorboard" in path.parts:
            continue
        try:
            _content(path)
        except Exception as error:  # whatever a reader makes of it
            bad.append(f"{path.relative_to(folder)}: {type(error).__name__}: {error}")
    return bad


def differences(one: Path, other: Path) -> list[str]:
    """What two finished runs differ in, apart from times and logs."""
    names = [{p.relative_to(root).as_posix() for p in root.rglob("*") if _counts(p, root)} for root in (one, other)]
    found = [f"only in one of the runs: {name}" for name in sorted(names[0] ^ names[1])]
    for name in sorted(names[0] & names[1]):
        if _content(one / name) != _content(other / name):
            found.append(f"different: {name}")
    return found


def _counts(path: Path, root: Path) -> bool:
    return path.is_file() and not any(part in IGNORED for part in path.relative_to(root).parts)


def _is_time(column: str) -> bool:
    """Whether a column measures time, or is a bound of one that does."""
    return not TIMES.isdisjoint(column.split("."))


def _content(path: Path) -> Any:
    """What a file says, without times: tables as columns, JSON as values, others as bytes."""
    if path.suffix == ".parquet":
        table = pq.ParquetFile(path).read()
        times = [name for name in table.column_names if _is_time(name)]
        return table.drop_columns(times).replace_schema_metadata(None)
    if path.suffix == ".json":
        return _timeless(json.loads(path.read_text()))
    if path.suffix == ".csv":
        rows = csv.DictReader(path.read_text().splitlines())
        return [{name: value for name, value in row.items() if not _is_time(name)} for row in rows]
    if path.suffix == ".safetensors":  # the metadata of a checkpoint says how long it took
        return {name: (array.dtype, array.tobytes()) for name, array in load_file(path).items()}
    if path.suffix in (".md", ".tex"):
        return None  # the rows of the CSV beside it, with times in their midst
    if path.suffix == ".jsonl":
        return [_timeless(json.loads(line)) for line in path.read_text().splitlines()]
    return path.read_bytes()


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _timeless(item) for name, item in value.items() if name not in TIMES}
    return [_timeless(item) for item in value] if isinstance(value, list) else value


def trial(
    folder: Path, options: Sequence[str], reference: Path, moments: Sequence[float], number: int = signal.SIGKILL
) -> tuple[list[str], int]:
    """Interrupt one run at each of the moments (seconds after it was started again), resume it, and compare.

    Returns:
        What was wrong, empty if all is well, and how many of the signals found the run still running.
    """
    wrong: list[str] = []
    sent = 0
    for after in moments:
        status, said = interrupt(folder, options, after, number)
        if status is None:
            break
        sent += 1
        if "Traceback" in said:
            wrong.append(f"a traceback after {after:.1f} s: {said.strip().splitlines()[-1]}")
        if number != signal.SIGKILL and (status != 130 or "goes on where it stopped" not in said):
            wrong.append(f"after {after:.1f} s: status {status}, said: {said.strip().splitlines()[-1:]}")
        wrong += [f"after {after:.1f} s half-written: {name}" for name in half_written(folder)]
    status, said, _ = finish(folder, options)
    if status:
        return [*wrong, f"resumed, it ends with status {status}: {' '.join(said.strip().splitlines()[-3:])}"], sent
    left = [p.name for p in folder.rglob("*") if p.name.startswith(".") and ".tmp" in p.name]
    return wrong + [f"temporary file left: {name}" for name in left] + differences(reference, folder), sent


def main() -> int:
    """Print one line per run and the count; the status is 1 unless every run ended as it should."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=50, help="signals in all")
    parser.add_argument(
        "--kills-per-run", type=int, default=1, help="one after the other, each when it has been resumed"
    )
    parser.add_argument("--signal", choices=("KILL", "TERM", "INT"), default="KILL")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("options", nargs="*", default=list(SMOKE), help="options of `nesy run`, after --")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    rng = np.random.default_rng(options.seed)
    good = runs = sent = 0
    with tempfile.TemporaryDirectory() as scratch:
        reference = Path(scratch) / "reference"
        status, said, _ = finish(reference, options.options)  # also compiles the kernels
        if status:
            print(said, file=sys.stderr)
            return 1
        _, _, seconds = finish(Path(scratch) / "timed", options.options)
        print(f"undisturbed: {seconds:.1f} s", flush=True)
        longest = seconds * min(1.0, 2.0 / options.kills_per_run)  # so that all of a run's signals find it running
        while sent < options.kills:
            moments = rng.uniform(0.2, longest, size=min(options.kills_per_run, options.kills - sent)).tolist()
            folder = Path(scratch) / f"run-{runs}"
            wrong, found = trial(folder, options.options, reference, moments, getattr(signal, f"SIG{options.signal}"))
            runs, sent, good = runs + 1, sent + found, good + (not wrong)
            where = ", ".join(f"{moment:.1f}" for moment in moments[:found])
            print(
                f"{runs:3}: SIG{options.signal} after {where} s: {'; '.join(wrong[:5]) or 'as undisturbed'}", flush=True
            )
    print(f"{good} of {runs} runs ({sent} signals) ended with the results of the undisturbed run")
    return int(good < runs)


if __name__ == "__main__":
    sys.exit(main())
