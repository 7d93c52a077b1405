"""Progress of long steps, seen through a small interface so that libraries never print.

A long function takes ``progress: Progress`` and opens one task per stage. The command line passes
`ConsoleProgress` (a bar on standard error, with rate and time left); everyone else the silent default.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Protocol


class Task(Protocol):
    """One stage of known length."""

    def advance(self, steps: int = 1, **metrics: float) -> None:
        """Report `steps` more units done, with the metrics worth showing beside the bar."""
        ...


class Progress(Protocol):
    """Where long functions report."""

    def task(self, description: str, total: int) -> AbstractContextManager[Task]:
        """Open a stage of `total` units."""
        ...


class _SilentTask:
    def advance(self, steps: int = 1, **metrics: float) -> None:
        """Report nothing."""


class SilentProgress:
    """Progress that shows nothing: the default of every library function."""

    @contextmanager
    def task(self, description: str, total: int) -> Iterator[Task]:
        """Open a stage that shows nothing."""
        yield _SilentTask()


SILENT = SilentProgress()


class ConsoleProgress:
    """Progress bars on standard error; one line every ten seconds where that is not a terminal."""

    @contextmanager
    def task(self, description: str, total: int) -> Iterator[Task]:
        """Open a stage with a bar of its own."""
        if sys.stderr.isatty():
            with _bar(description, total) as task:
                yield task
        else:
            line = _LineTask(description, total)
            try:
                yield line
            finally:
                line.close()


@contextmanager
def _bar(description: str, total: int) -> Iterator[Task]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as RichProgress

    columns = (
        TextColumn("{task.description:28}"),
        BarColumn(bar_width=28),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[metrics]}"),
    )
    with RichProgress(*columns, console=Console(stderr=True)) as bars:
        task_id = bars.add_task(description, total=total, rate="", metrics="")
        started = time.monotonic()

        class BarTask:
            done = 0

            def advance(self, steps: int = 1, **metrics: float) -> None:
                """Move the bar."""
                self.done += steps
                rate = self.done / max(time.monotonic() - started, 1e-9)
                fields: dict[str, Any] = {"rate": _rate(rate)}
                if metrics:
                    fields["metrics"] = _metrics(metrics)
                bars.update(task_id, advance=steps, **fields)

        yield BarTask()


class _LineTask:
    """Plain lines for logs: a start, one line every ten seconds, and an end."""

    interval = 10.0

    def __init__(self, description: str, total: int) -> None:
        self.description, self.total, self.done = description, total, 0
        self.started = self.printed = time.monotonic()
        self.metrics: dict[str, float] = {}

    def advance(self, steps: int = 1, **metrics: float) -> None:
        """Report `steps` more units done."""
        self.done += steps
        self.metrics.update(metrics)
        if time.monotonic() - self.printed >= self.interval:
            self._print()

    def _print(self) -> None:
        self.printed = time.monotonic()
        seconds = max(self.printed - self.started, 1e-9)
        rate = self.done / seconds
        left = f", {(self.total - self.done) / rate:.0f} s left" if self.done else ""
        print(
            f"{self.description}: {self.done}/{self.total}  {_rate(rate)}  "
            f"{seconds:.0f} s{left}  {_metrics(self.metrics)}".rstrip(),
            file=sys.stderr,
            flush=True,
        )

    def close(self) -> None:
        """Print the last line."""
        self._print()


def _rate(rate: float) -> str:
    for limit, unit in ((1e6, "M"), (1e3, "k")):
        if rate >= limit:
            return f"{rate / limit:.1f}{unit}/s"
    return f"{rate:.1f}/s"


def _metrics(metrics: dict[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in metrics.items())
