"""Where the cells of a comparison run: in this process, in several on this machine, or on a Ray cluster.

A cell is a pure function of files and seeds and writes its own result, so an engine only has to see to it that
every cell is run. A cell whose worker dies is run again; other cells do not notice.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nesy.errors import UserError
from nesy.progress import Task

if TYPE_CHECKING:
    from collections.abc import Iterator

    from planners.comparison.compare import Cell
    from planners.config import CompareConfig

CellJob = tuple["Cell", Path, "CompareConfig", int, str]
"""What `planners.comparison.compare.run_cell` is called with."""

ENGINES = ("local", "ray")
ATTEMPTS = 8
"""Times that one cell is begun before its deaths are taken for its own fault."""


class Relay:
    """A progress that hands finished units on, whatever the stage."""

    def __init__(self, advance: Any) -> None:
        self._advance = advance

    @contextmanager
    def task(self, description: str, total: int) -> Iterator[Relay]:
        """A stage; its units count towards the whole grid."""
        yield self

    def advance(self, steps: int = 1, **metrics: float) -> None:
        """Report finished episodes."""
        self._advance(steps)


class Tally:
    """Progress of the grid: a cell that is run again does not count what it had done before a second time."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.counted: dict[str, int] = {}

    def report(self, name: str, done: int) -> None:
        """The cell has done so many episodes in its present attempt."""
        new = done - self.counted.get(name, 0)
        if new > 0:
            self.counted[name] = done
            self.task.advance(new)


def run_cells(jobs_of: list[CellJob], jobs: int, task: Task, engine: str = "local", address: str | None = None) -> None:
    """Run every cell.

    Args:
        jobs_of: the cells.
        jobs: processes of the engine `local`; with 1, this one.
        task: told of finished episodes.
        engine: one of `ENGINES`.
        address: of the Ray cluster.

    Raises:
        UserError: an unknown engine, Ray is missing or out of reach, or workers keep dying on one cell.
    """
    if engine not in ENGINES:
        raise UserError(f"unknown engine '{engine}' (known: {', '.join(ENGINES)})")
    if not jobs_of:
        return
    if engine == "ray":
        from planners.comparison.ray_engine import run_on_ray

        run_on_ray(jobs_of, task, address)
    elif jobs == 1 or len(jobs_of) == 1:
        for job in jobs_of:
            run_job(job, task.advance)
    else:
        _run_in_processes(jobs_of, jobs, Tally(task))


def run_job(job: CellJob, advance: Any) -> None:
    """Run one cell here; `advance` is told how many more episodes are done."""
    from planners.comparison.compare import run_cell

    run_cell(*job, progress=Relay(advance), advance=advance)


def give_up(name: str, remedy: str) -> UserError:
    """The error for a cell that workers keep dying on."""
    return UserError(f"{name}: its worker died {ATTEMPTS} times (out of memory?); {remedy}")


class _Worker:
    """A process that runs one cell after another; it is given a cell through a pipe, and reports through it."""

    def __init__(self, context: Any) -> None:
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self.process.start()
        theirs.close()  # so that the pipe ends when the process does
        self.job: CellJob | None = None

    def begin(self, job: CellJob) -> None:
        self.job = job
        self.pipe.send(job)


def _run_in_processes(jobs_of: list[CellJob], jobs: int, tally: Tally) -> None:
    context = multiprocessing.get_context("spawn")
    waiting, attempts = deque(jobs_of), dict.fromkeys((job[0].name for job in jobs_of), 0)
    workers: list[_Worker] = []
    try:
        while waiting or any(worker.job is not None for worker in workers):
            while waiting and len(workers) < jobs:
                workers.append(_Worker(context))
            for worker in workers:
                if worker.job is None and waiting:
                    _hand_over(worker, waiting, attempts)
            for pipe in wait([worker.pipe for worker in workers]):
                worker = next(worker for worker in workers if worker.pipe is pipe)
                if not _heard(worker, tally):  # it died
                    worker.process.join()
                    workers.remove(worker)
                    if worker.job is not None:
                        waiting.appendleft(worker.job)
    finally:
        for worker in workers:
            worker.process.terminate()
            worker.process.join()


def _hand_over(worker: _Worker, waiting: deque[CellJob], attempts: dict[str, int]) -> None:
    job = waiting.popleft()
    attempts[job[0].name] += 1
    if attempts[job[0].name] > ATTEMPTS:
        raise give_up(job[0].name, "try fewer --jobs")
    try:
        worker.begin(job)
    except OSError:  # it died before it could be told; its pipe says so next
        worker.job = job


def _heard(worker: _Worker, tally: Tally) -> bool:
    """Take one message of a worker; False if it is dead."""
    try:
        kind, value = worker.pipe.recv()
    except (EOFError, OSError):
        return False
    if kind == "failed":
        raise value
    if worker.job is not None:
        if kind == "progress":
            tally.report(worker.job[0].name, value)
        else:
            worker.job = None
    return True


def _serve(pipe: Connection) -> None:
    """The life of a worker process: cells come in through the pipe until it closes."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    while True:
        try:
            job: CellJob = pipe.recv()
        except EOFError:
            return
        done = 0

        def advance(count: int = 1, **_: float) -> None:
            nonlocal done
            done += count
            pipe.send(("progress", done))

        try:
            run_job(job, advance)
        except Exception as error:
            pipe.send(("failed", _sendable(error)))
            return
        pipe.send(("done", None))


def _sendable(error: Exception) -> Exception:
    """The error as the parent can raise it: a caller's mistake as it is, a bug of ours with its traceback."""
    import traceback

    from domains.core import DomainError

    if type(error) in (UserError, DomainError):
        return type(error)(str(error))
    return RuntimeError("in a worker process:\n" + "".join(traceback.format_exception(error)))
