"""What the suites of `nesy bench` share: their settings, a row of a table, and how a rate is taken."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nesy.run_folder import RunFolder


@dataclass(frozen=True)
class Settings:
    """How a suite is to measure.

    Attributes:
        seconds: per measurement, after a warm-up.
        seed: of everything random.
        folder: the run folder, for suites that need one (`NEEDS`).
    """

    seconds: float
    seed: int
    folder: Path

    @property
    def run(self) -> RunFolder:
        """The run that suites with `NEEDS` measure."""
        return RunFolder(self.folder)


@dataclass(frozen=True)
class Row:
    """One measurement.

    Attributes:
        what: what was measured, with sizes and batch.
        figure: how much of it, in `unit`.
        unit: `.../s` for rates; for times, such as `ms`.
        peer: the name of what it is compared with, measured in the same run.
        ratio: how many times as fast as the peer; 1 for the peer itself.
    """

    what: str
    figure: float
    unit: str
    peer: str
    ratio: float


def rate(
    work: Callable[[], int], seconds: float, warm_up: int = 1, clock: Callable[[], float] = time.process_time
) -> float:
    """Units of `work` done per second.

    Args:
        work: does some units and returns how many.
        seconds: how long to go on; at least one call is measured.
        warm_up: calls before the clock starts.
        clock: processor time by default, so that other processes do not count; `time.perf_counter` where the work
            is done elsewhere (on a GPU).
    """
    for _ in range(warm_up):
        work()
    done, started = 0, clock()
    while True:
        done += work()
        if (spent := clock() - started) >= seconds:
            return done / spent


def ranked(unit: str, peer: str, rates: dict[str, float]) -> list[Row]:
    """Rows of rates, each with its ratio to that of `peer`, which is one of them."""
    return [Row(what, figure, unit, peer, figure / rates[peer]) for what, figure in rates.items()]
