"""Extract the symbolic 2DBN from the trained world model; print it, or write it in another format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from nesy.cli import pipeline, tables
from nesy.cli.show import selection
from nesy.config import ExtractConfig
from nesy.run_folder import RunFolder


@dataclass(frozen=True)
class Arguments(pipeline.CommonArguments):
    """Options of `nesy extract`."""

    table: bool = False
    """Print the extracted table for reading (all of it, or what --factor and --action select)."""
    factor: int | None = None
    """Print the table of this factor only."""
    action: str | None = None
    """Print the table of this action only."""
    to: Path | None = None
    """Write the 2DBN to this file; the suffix tells the format unless --format does."""
    format: str | None = None
    """Format of --to."""
    settings: Annotated[ExtractConfig, tyro.conf.arg(name="")] = ExtractConfig()


def defaults(arguments: list[str]) -> Arguments:
    """The options' values where the command line says nothing."""
    return Arguments(settings=pipeline.base_config(arguments).extract)


def run(options: Arguments) -> dict[str, Any]:
    """Extract inside the run folder, then print and export as asked."""
    with pipeline.opened(options, "extract", extract=options.settings) as steps:
        result = steps.extract()
    if options.to is not None:
        result["exported"] = str(_export(RunFolder(options.run), options))
    if options.table or options.factor is not None or options.action is not None:
        result["table"] = _table(RunFolder(options.run), options)
    return result


def _export(run: RunFolder, options: Arguments) -> Path:
    from nesy import formats
    from nesy.dbn import TwoSliceDBN

    assert options.to is not None
    formats.export(TwoSliceDBN.load(run.dbn), options.to, format=options.format)
    return options.to


def _table(run: RunFolder, options: Arguments) -> str:
    from nesy.dbn import TwoSliceDBN, describe

    dbn = TwoSliceDBN.load(run.dbn)
    factor, action = selection(dbn, options.factor, options.action)
    return describe(dbn, factor=factor, action=action)


def show(result: dict[str, Any]) -> None:
    """Print the table where asked for, the figures otherwise."""
    table = result.pop("table", None)
    if table is not None:
        print(table)
    else:
        tables.print_figures("2DBN", result)
