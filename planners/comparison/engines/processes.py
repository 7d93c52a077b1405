"""The engine `local`: cells in several processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from multiprocessing.connection import Connection, wait
from typing import Any

from nesy.errors import UserError
from planners.comparison.engines.jobs import ATTEMPTS, CellJob, Tally, give_up, run_job


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


def run_in_processes(jobs_of: list[CellJob], jobs: int, tally: Tally) -> None:
    """Run every cell, at most `jobs` at a time; a cell whose process dies is run again."""
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
