"""Where the cells of a comparison run: in this process, or in several on this machine.

A cell is a pure function of files and seeds and writes its own result, so an engine only has to see to it that
every cell is run; a cell whose process dies is run again.
"""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nesy.errors import UserError
from nesy.progress import Task

if TYPE_CHECKING:
    from collections.abc import Iterator

    from planners.compare import Cell
    from planners.config import CompareConfig

CellJob = tuple["Cell", Path, "CompareConfig", int, str]
"""What `planners.compare.run_cell` is called with."""

_ATTEMPTS = 3
_reports: Any = None  # in a worker process: where it reports finished episodes


class _Relay:
    """A progress that hands finished units on, whatever the stage."""

    def __init__(self, advance: Any) -> None:
        self._advance = advance

    @contextmanager
    def task(self, description: str, total: int) -> Iterator[_Relay]:
        """A stage; its units count towards the whole grid."""
        yield self

    def advance(self, steps: int = 1, **metrics: float) -> None:
        """Report finished episodes."""
        self._advance(steps)


def run_cells(jobs_of: list[CellJob], jobs: int, task: Task) -> None:
    """Run every cell, in this process or in `jobs` of them."""
    if not jobs_of:
        return
    if jobs == 1 or len(jobs_of) == 1:
        for job in jobs_of:
            _run(job, task.advance)
        return
    _run_in_processes(jobs_of, jobs, task)


def _run(job: CellJob, advance: Any) -> None:
    from planners.compare import run_cell

    run_cell(*job, progress=_Relay(advance), advance=advance)


def _run_in_processes(jobs_of: list[CellJob], jobs: int, task: Task) -> None:
    context = multiprocessing.get_context("spawn")
    waiting = list(jobs_of)
    for _ in range(_ATTEMPTS):
        reports = context.SimpleQueue()
        failed: list[CellJob] = []
        with ProcessPoolExecutor(min(jobs, len(waiting)), context, _begin_worker, (reports,)) as pool:
            futures: dict[Future[None], CellJob] = {pool.submit(_work, job): job for job in waiting}
            running = set(futures)
            try:
                while running:
                    done, running = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
                    while not reports.empty():
                        task.advance(reports.get())
                    for future in done:
                        try:
                            future.result()
                        except BrokenProcessPool:
                            failed.append(futures[future])
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        if not failed:
            return
        waiting = failed
    names = ", ".join(job[0].name for job in waiting)
    raise UserError(f"worker processes keep dying ({_ATTEMPTS} attempts); still to do: {names}; try fewer --jobs")


def _begin_worker(reports: Any) -> None:
    global _reports
    _reports = reports
    os.environ.setdefault("OMP_NUM_THREADS", "1")


def _work(job: CellJob) -> None:
    _run(job, lambda count=1, **_: _reports.put(count))
