"""Compare DQN, POMDP planners and references on the same maps: return, success, time per decision."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import tyro

from nesy.cli import pipeline, tables
from planners.config import CompareConfig


@dataclass(frozen=True)
class Arguments(pipeline.CommonArguments):
    """Options of `nesy compare`."""

    settings: Annotated[CompareConfig, tyro.conf.arg(name="")] = CompareConfig()


def defaults(arguments: list[str]) -> Arguments:
    """The options' values where the command line says nothing."""
    return Arguments(settings=pipeline.base_config(arguments).compare)


def run(options: Arguments) -> dict[str, Any]:
    """Run the cells of the grid that the run folder does not hold yet."""
    base = pipeline.common_config(options, pipeline.config_of(options))
    work = pipeline.Pipeline(options.run, replace(base, compare=options.settings), options.jobs)
    with work.run.lock():
        work.configure(redo_from="compare" if options.redo else None)
        return work.compare()


def show(result: dict[str, Any]) -> None:
    """Print the comparison table."""
    tables.print_comparison(result["comparison"])
