"""Train the discrete world model (encoder, decoder, forward and inverse model)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from nesy.cli import pipeline, tables
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
    with pipeline.opened(options, "train", train=options.settings) as steps:
        return steps.train()


def show(result: dict[str, Any]) -> None:
    """Print the gates."""
    tables.print_figures("world model", result)
