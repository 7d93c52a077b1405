"""Train the discrete world model (encoder, decoder, forward and inverse model)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import tyro

from nesy.cli import pipeline, tables
from nesy.cli.configuration import RunConfig
from nesy.config import TrainConfig


@dataclass(frozen=True)
class Arguments(pipeline.CommonArguments):
    """Options of `nesy train`."""

    settings: Annotated[TrainConfig, tyro.conf.arg(name="")] = TrainConfig()


def defaults(arguments: list[str]) -> Arguments:
    """The options' values where the command line says nothing."""
    return Arguments(settings=pipeline.base_config(arguments).train)


def run(options: Arguments) -> dict[str, Any]:
    """Train inside the run folder."""
    base: RunConfig = pipeline.common_config(options, pipeline.config_of(options))
    work = pipeline.Pipeline(options.run, replace(base, train=options.settings), options.jobs)
    with work.run.lock():
        work.configure(redo_from="train" if options.redo else None)
        return work.train()


def show(result: dict[str, Any]) -> None:
    """Print the gates."""
    tables.print_figures("world model", result)
