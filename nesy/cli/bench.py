"""Measure speeds, each as a ratio to a named peer in the same run, and store the table.

env       environment steps, beside Minigrid's SimpleCrossingS9N1
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.table import Table

from nesy.cli.tables import print_wide
from nesy.run_folder import read_json, write_json

Row = dict[str, Any]
"""`what`, `figure` with its `unit`, `peer` and the `ratio` to it."""


@dataclass(frozen=True)
class Arguments:
    """Options of `nesy bench`."""

    suite: Annotated[Literal["all", "env"], tyro.conf.Positional] = "all"
    """What to measure."""
    seconds: float = 1.0
    """Seconds per measurement, after a warm-up."""
    seed: int = 0
    """Seed of everything random."""
    to: Path = Path("runs/bench.json")
    """Where the figures are stored; suites measured earlier are kept."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the result as one JSON object on standard output."""


def _env(options: Arguments) -> list[Row]:
    from domains.person_following.speed import benchmark

    rows = benchmark(seconds=options.seconds, seed=options.seed)
    peer = next(row["what"] for row in rows)
    return [
        {
            "what": f"{row['what']}, size {row['size']}, {row['num_crossings']} crossings, batch {row['batch']}, "
            f"{row['player']} play",
            "figure": round(row["steps_per_second"]),
            "unit": "steps/s",
            "peer": peer,
            "ratio": round(row["minigrid_ratio"], 2),
        }
        for row in rows
    ]


SUITES: dict[str, Callable[[Arguments], list[Row]]] = {"env": _env}


def run(options: Arguments) -> dict[str, Any]:
    """Measure, and store beside what was measured earlier."""
    suites = list(SUITES) if options.suite == "all" else [options.suite]
    measured = {suite: SUITES[suite](options) for suite in suites}
    kept = read_json(options.to).get("suites", {}) if options.to.exists() else {}
    machine = {"processor": platform.machine(), "python": platform.python_version()}
    write_json(options.to, {"machine": machine, "suites": {**kept, **measured}})
    return {"suites": measured, "stored": str(options.to)}


def show(result: dict[str, Any]) -> None:
    """Print the table."""
    for suite, rows in result["suites"].items():
        table = Table(title=f"{suite}: on one core", title_justify="left")
        for column in ("what", "figure", "unit", "ratio", "peer"):
            table.add_column(column, justify="right" if column in ("figure", "ratio") else "left", no_wrap=True)
        for row in rows:
            table.add_row(row["what"], f"{row['figure']:,}", row["unit"], f"{row['ratio']:g} x", row["peer"])
        print_wide(table)
    print(f"stored: {result['stored']}")
