"""Write report.html, one self-contained page, from the run folder alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from nesy.cli import configuration
from nesy.cli.pipeline import Pipeline
from nesy.run_folder import RunFolder


@dataclass(frozen=True)
class Arguments:
    """Options of `nesy report`."""

    run: Path = Path("runs/default")
    """The run folder."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the result as one JSON object on standard output."""


def run(options: Arguments) -> dict[str, Any]:
    """Write the page."""
    folder = RunFolder.open(options.run)
    work = Pipeline(options.run, configuration.load(folder.config), jobs=1)
    with folder.lock():
        return work.report()


def show(result: dict[str, Any]) -> None:
    """Print where the page is."""
    print(f"report: {result['report']}")
