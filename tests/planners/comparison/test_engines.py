"""Killed workers change nothing but the time it takes."""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from nesy.errors import UserError
from nesy.run_folder import RunFolder
from planners.comparison.compare import compare
from planners.comparison.engines.jobs import Tally
from planners.config import CompareConfig, DQNConfig

REFERENCES = CompareConfig(agents=("greedy-follower", "random", "greedy-last-seen"), episodes=84, seeds=(0, 1))
LEARNERS = CompareConfig(
    agents=("dqn",),
    influences=("perspective-shift", "random"),
    episodes=42,
    dqn=DQNConfig(
        episodes=100, num_envs=8, hidden=(16,), batch_size=16, warm_up=50, updates_per_step=0.5, checkpoint_seconds=0.02
    ),
)


@pytest.fixture(autouse=True)
def _no_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("planners.comparison.compare.map_optimum", lambda *_: None)


def rows(run: RunFolder) -> dict[str, list[object]]:
    columns = pq.read_table(run.results / "episodes.parquet").to_pydict()
    del columns["ms_per_decision"]
    return columns


@contextmanager
def killing(ready: Callable[[], bool], kills: int) -> Iterator[list[int]]:
    """Kill a worker process at random moments from when things are `ready`, `kills` times in all."""
    killed: list[int] = []
    over = threading.Event()
    rng = np.random.default_rng(0)

    def kill() -> None:
        while not over.is_set() and len(killed) < kills:
            children = multiprocessing.active_children()
            if children and ready():
                time.sleep(0.3 * rng.random())
                victim = children[int(rng.integers(len(children)))]
                if victim.is_alive() and victim.pid is not None:
                    victim.kill()
                    killed.append(victim.pid)
                    time.sleep(0.2)
            time.sleep(0.01)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        thread.join()


def test_a_damaged_result_is_worked_out_again(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    compare(run, REFERENCES, jobs=1)
    good = rows(run)
    damaged = sorted((run.results / "cells").glob("*.parquet"))[0]
    content = bytearray(damaged.read_bytes())
    content[len(content) // 4] ^= 255  # in the midst of the columns: the footer still reads well
    damaged.write_bytes(content)
    compare(run, REFERENCES, jobs=1)
    assert rows(run) == good
    assert damaged.read_bytes() != content


def test_killed_workers_change_nothing(tmp_path: Path) -> None:
    undisturbed, disturbed = RunFolder(tmp_path / "undisturbed"), RunFolder(tmp_path / "disturbed")
    compare(undisturbed, REFERENCES, jobs=1)
    with killing(lambda: True, kills=3) as killed:
        compare(disturbed, REFERENCES, jobs=2)
    assert killed
    assert rows(undisturbed) == rows(disturbed)


def test_a_training_killed_in_the_middle_ends_the_same(tiny_run: Path, tmp_path: Path) -> None:
    def fresh(name: str) -> RunFolder:
        run = RunFolder(tmp_path / name)
        run.path.mkdir()
        (run.world_model).symlink_to((tiny_run / "world_model").resolve())
        return run

    undisturbed, disturbed = fresh("undisturbed"), fresh("disturbed")
    compare(undisturbed, LEARNERS, jobs=1)

    def training() -> bool:
        return any(disturbed.policies.glob(".*.checkpoint.safetensors"))

    with killing(training, kills=2) as killed:
        compare(disturbed, LEARNERS, jobs=2)
    assert killed
    assert rows(undisturbed) == rows(disturbed)
    with disturbed.lock():
        pass  # whoever writes next removes what a killed process had begun to write
    assert not list(disturbed.policies.glob(".*"))
    for path in undisturbed.policies.iterdir():
        assert path.read_bytes() == (disturbed.policies / path.name).read_bytes()


def test_what_a_dead_worker_had_done_is_not_counted_twice() -> None:
    class Counting:
        total = 0

        def advance(self, steps: int = 1, **metrics: float) -> None:
            self.total += steps

    task = Counting()
    tally = Tally(task)
    for done in (3, 7, 2, 5, 9):  # died after 7, began anew
        tally.report("cell", done)
    tally.report("other", 1)
    assert task.total == 10


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="unknown engine 'slurm'"):
        compare(RunFolder(tmp_path), REFERENCES, engine="slurm")
