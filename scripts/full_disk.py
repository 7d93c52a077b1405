"""Runs on a disk that fills up: no lost or half-written file, a clear line, and the same results once there is room.

    .venv/bin/python scripts/full_disk.py --fills 20

Mounts a small file system in memory (tmpfs), which needs the right to mount: root, or `unshare -rm` in front. With
--limit a limit on the size of a file takes its place (RLIMIT_FSIZE), which needs no rights and stops other writes.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from scripts.interrupted_runs import SMOKE, differences, finish, half_written


@contextmanager
def small_disk(place: Path, size: int) -> Iterator[None]:
    """A file system of `size` bytes mounted on `place`."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def resize(place: Path, size: int) -> None:
    """Give the mounted file system another size."""
    subprocess.run(["mount", "-o", f"remount,size={size}", str(place)], check=True)


def complaints(status: int, said: str, folder: Path) -> list[str]:
    """What is wrong with how a command took a full disk; it may also just have had room enough."""
    wrong = [f"half-written: {name}" for name in half_written(folder)]
    if status == 0:
        return wrong
    last = said.strip().splitlines()[-1] if said.strip() else ""
    if status != 2 or "Traceback" in said or "goes on where it stopped" not in last:
        wrong.append(f"status {status}, said: {last}")
    return wrong


def on_disk(place: Path, options: Sequence[str], reference: Path, sizes: Sequence[int]) -> list[str]:
    """Run on a disk of each of the sizes in turn (bytes, growing), then with room, and compare."""
    wrong: list[str] = []
    folder = place / "run"
    with small_disk(place, sizes[0]):
        for size in sizes:
            resize(place, size)
            status, said, _ = finish(folder, options)
            wrong += [f"{size >> 10} KiB: {text}" for text in complaints(status, said, folder)]
        resize(place, 1 << 30)
        status, said, _ = finish(folder, options)
        if status:
            return [*wrong, f"with room again, status {status}: {' '.join(said.strip().splitlines()[-2:])}"]
        return wrong + differences(reference, folder)


def under_limit(folder: Path, options: Sequence[str], reference: Path, sizes: Sequence[int]) -> list[str]:
    """The same with no file allowed to grow beyond each of the sizes in turn."""
    wrong: list[str] = []
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in sizes:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            status, said, _ = finish(folder, options)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        wrong += [f"{size >> 10} KiB a file: {text}" for text in complaints(status, said, folder)]
    status, said, _ = finish(folder, options)
    if status:
        return [*wrong, f"without limit, status {status}: {' '.join(said.strip().splitlines()[-2:])}"]
    return wrong + differences(reference, folder)


def main() -> int:
    """Print one line per run and the count; the status is 1 unless every run ended as it should."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--fills", type=int, default=20)
    parser.add_argument("--fills-per-run", type=int, default=1)
    parser.add_argument("--limit", action="store_true", help="limit the size of files instead of mounting")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("options", nargs="*", default=list(SMOKE), help="options of `nesy run`, after --")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    rng = np.random.default_rng(options.seed)
    runs, good = -(-options.fills // options.fills_per_run), 0
    with tempfile.TemporaryDirectory() as scratch:
        reference = Path(scratch) / "reference"
        status, said, _ = finish(reference, options.options)
        if status:
            print(said, file=sys.stderr)
            return 1
        files = [path.stat().st_size for path in reference.rglob("*") if path.is_file()]
        largest = max(files) if options.limit else sum(files)
        print(f"undisturbed: {len(files)} files, {sum(files) >> 10} KiB, the largest {max(files) >> 10} KiB")
        for index in range(runs):
            sizes = sorted(int(size) for size in rng.uniform(1 << 14, largest, size=options.fills_per_run))
            place = Path(scratch) / f"disk-{index}"
            place.mkdir()
            if options.limit:
                wrong = under_limit(place / "run", options.options, reference, sizes)
            else:
                wrong = on_disk(place, options.options, reference, sizes)
            good += not wrong
            where = ", ".join(f"{size >> 10}" for size in sizes)
            print(f"{index + 1:3}: {where} KiB: {'; '.join(wrong[:5]) or 'as undisturbed'}", flush=True)
    print(f"{good} of {runs} runs ({options.fills} full disks) lost nothing and ended as the undisturbed run")
    return int(good < runs)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())
