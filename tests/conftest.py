"""One small finished run for all tests that read a run folder; nobody may write into it."""

from __future__ import annotations

import fcntl
import os
import shutil
from pathlib import Path

import pytest

TINY = (
    *("--preset", "smoke", "--jobs", "1"),
    *("--collect.crossing-episodes", "60", "--collect.following-episodes", "60"),
    *("--train.epochs", "2"),
    *("--compare.dqn.episodes", "64", "--compare.planner-episodes", "2", "--compare.episodes", "42"),
    *("--compare.search.pomdp-py-simulations", "4"),
)
"""Options of the smallest run that has every step."""


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, made once for all worker processes; NESY_TEST_RUN names one that is there already."""
    if given := os.environ.get("NESY_TEST_RUN"):
        return Path(given)
    from nesy.cli.main import main

    base = tmp_path_factory.getbasetemp()
    shared = base.parent if os.environ.get("PYTEST_XDIST_WORKER") else base
    folder = shared / "tiny-run" / "tiny run"
    with (shared / "tiny-run.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "report.html").is_file():
            assert main(["run", "--run", str(folder), *TINY]) == 0
    return folder


@pytest.fixture
def run_copy(tiny_run: Path, tmp_path: Path) -> Path:
    """A copy of the run, to be written into."""
    return Path(shutil.copytree(tiny_run, tmp_path / "run"))
