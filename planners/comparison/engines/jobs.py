"""What every engine shares: the job of one cell, its progress, and when to give up on it."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nesy.errors import UserError
from nesy.progress import Task
from planners.comparison.run_cell import run_cell

if TYPE_CHECKING:
    from collections.abc import Iterator

    from planners.comparison.grid import Cell
    from planners.config import CompareConfig

CellJob = tuple["Cell", Path, "CompareConfig", int, str]
"""What `planners.comparison.run_cell.run_cell` is called with."""

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


def run_job(job: CellJob, advance: Any) -> None:
    """Run one cell here; `advance` is told how many more episodes are done."""
    run_cell(*job, progress=Relay(advance), advance=advance)


def give_up(name: str, remedy: str) -> UserError:
    """The error for a cell that workers keep dying on."""
    return UserError(f"{name}: its worker died {ATTEMPTS} times (out of memory?); {remedy}")
