"""Where the cells of a comparison run: in this process, in several on this machine, or on a Ray cluster.

A cell is a pure function of files and seeds and writes its own result, so an engine only has to see to it that
every cell is run. A cell whose worker dies is run again; other cells do not notice.
"""

from __future__ import annotations

from nesy.errors import UserError
from nesy.progress import Task
from planners.comparison.engines.jobs import CellJob, Tally, run_job

ENGINES = ("local", "ray")


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
        from planners.comparison.engines.ray_engine import run_on_ray

        run_on_ray(jobs_of, task, address)
    elif jobs == 1 or len(jobs_of) == 1:
        for job in jobs_of:
            run_job(job, task.advance)
    else:
        from planners.comparison.engines.processes import run_in_processes

        run_in_processes(jobs_of, jobs, Tally(task))
