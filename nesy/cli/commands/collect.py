"""Collect experience: random and expert episodes of the crossing task, and person-following episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from nesy.cli import pipeline, tables
from nesy.config import CollectConfig


@dataclass(frozen=True)
class Arguments(pipeline.CommonArguments):
    """Options of `nesy collect`."""

    settings: Annotated[CollectConfig, tyro.conf.arg(name="")] = CollectConfig()


def defaults(arguments: list[str]) -> Arguments:
    """The options' values where the command line says nothing."""
    return Arguments(settings=pipeline.base_config(arguments).collect)


def run(options: Arguments) -> dict[str, Any]:
    """Collect into the run folder."""
    with pipeline.opened(options, "collect", collect=options.settings) as steps:
        return steps.collect()


def show(result: dict[str, Any]) -> None:
    """Print what was collected."""
    tables.print_figures("experience", result)
