"""A disk that is full: one clear line, the old files stay, and the same results once there is room.

A limit on the size of files stands for the full disk, since mounting one needs rights; scripts/full_disk.py mounts.
"""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from scripts.interrupted_runs import half_written

LIMIT = 40_000


def nesy(*arguments: str, limit: int | None = None) -> subprocess.CompletedProcess[str]:
    """One command in a process of its own, no file growing beyond `limit` bytes."""

    def limited() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))

    command = [sys.executable, "-m", "nesy.cli.main", *arguments]
    return subprocess.run(command, capture_output=True, text=True, preexec_fn=limited, timeout=300, check=False)


@pytest.mark.parametrize(("step", "files"), [("extract", "dbn/*"), ("report", "report.html")])
def test_a_step_on_a_full_disk(step: str, files: str, run_copy: Path) -> None:
    before = {path: path.read_bytes() for path in run_copy.glob(files)}
    assert before
    redo = ["--redo"] if step == "extract" else []
    stopped = nesy(step, "--run", str(run_copy), *redo, limit=LIMIT)
    assert stopped.returncode == 2, stopped.stderr
    last = stopped.stderr.strip().splitlines()[-1]
    assert last.startswith("nesy: ")
    assert last.endswith("make room, and the same command goes on where it stopped")
    assert "Traceback" not in stopped.stderr
    assert half_written(run_copy) == []
    assert [path for path in run_copy.rglob(".*.tmp*") if path.is_file()] == []
    if step == "report":
        assert {path: path.read_bytes() for path in run_copy.glob(files)} == before
        return
    gone_on = nesy(step, "--run", str(run_copy))
    assert gone_on.returncode == 0, gone_on.stderr
    assert {path: path.read_bytes() for path in run_copy.glob(files)} == before
