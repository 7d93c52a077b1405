"""Measure speeds, each as a ratio to a named peer in the same run, and store the tables."""

from __future__ import annotations

import dataclasses
import importlib
import platform
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import tyro
from rich.table import Table

from nesy.cli.benches import SUITES
from nesy.cli.benches.measuring import Settings
from nesy.cli.pipeline import say
from nesy.cli.tables import print_wide
from nesy.errors import UserError
from nesy.run_folder import RunFolder, read_json, write_json


@dataclass(frozen=True)
class Arguments:
    """Options of `nesy bench`."""

    suite: Annotated[str, tyro.conf.Positional, tyro.conf.arg(help=f"What to measure: all, {', '.join(SUITES)}.")] = (
        "all"
    )
    run: Path = Path("runs/default")
    """The run folder whose models are measured, for suites that need one."""
    seconds: float = 1.0
    """Seconds per measurement, after a warm-up."""
    seed: int = 0
    """Seed of everything random."""
    out: Path = Path("runs/bench.json")
    """Where the figures are stored; suites measured earlier are kept."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the result as one JSON object on standard output."""


def run(options: Arguments) -> dict[str, Any]:
    """Measure, and store beside what was measured earlier.

    Raises:
        UserError: an unknown suite, no time to measure, or a run folder that lacks what the suite measures.
    """
    if options.suite not in ("all", *SUITES):
        raise UserError(f"no suite '{options.suite}' to measure; the suites are all, {', '.join(SUITES)}")
    if not options.seconds > 0:
        raise UserError(f"--seconds {options.seconds:g}: must be positive")
    settings = Settings(options.seconds, options.seed, options.run)
    measured = {}
    for name in SUITES if options.suite == "all" else (options.suite,):
        suite = importlib.import_module(f"nesy.cli.benches.{name}")
        if options.suite == "all" and (reason := _lacking(suite, options.run)):
            say(f"{name}: not measured, {reason}")
            continue
        if suite.NEEDS:
            RunFolder.open(options.run).require(*suite.NEEDS)
        measured[name] = [dataclasses.asdict(row) for row in suite.measure(settings)]
    kept = read_json(options.out).get("suites", {}) if options.out.exists() else {}
    machine = {"processor": platform.machine(), "python": platform.python_version()}
    write_json(options.out, {"machine": machine, "suites": {**kept, **measured}})
    return {"suites": measured, "stored": str(options.out)}


def _lacking(suite: ModuleType, folder: Path) -> str:
    """Why the suite cannot be measured on the run; empty if it can."""
    if not suite.NEEDS:
        return ""
    try:
        RunFolder.open(folder).require(*suite.NEEDS)
    except UserError as error:
        return str(error)
    return ""


def show(result: dict[str, Any]) -> None:
    """Print one table of everything measured."""
    table = Table(title="speeds on one core, each beside a named peer in the same run", title_justify="left")
    for column in ("suite", "what", "figure", "unit", "ratio", "peer"):
        number = column in ("figure", "ratio")
        table.add_column(column, justify="right" if number else "left", no_wrap=column not in ("what", "peer"))
    for suite, rows in result["suites"].items():
        for row in rows:
            figure, ratio = _short(row["figure"]), f"{row['ratio']:.3g} x"
            table.add_row(suite, row["what"], figure, row["unit"], ratio, row["peer"])
        table.add_section()
    print_wide(table)
    print(f"stored: {result['stored']}")


def _short(figure: float) -> str:
    return f"{figure:,.0f}" if figure >= 100 else f"{figure:.3g}"
