"""Extract the symbolic 2DBN from the trained world model; print it, or write it in another format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from nesy.cli import pipeline, tables
from nesy.cli.commands.show import selection
from nesy.config import ExtractConfig
from nesy.errors import UserError
from nesy.run_folder import RunFolder

if TYPE_CHECKING:
    from nesy.dbn import TwoSliceDBN


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
    goal: str | None = None
    """Export only what this goal depends on, such as X3=5,X0=1; PRISM and PDDL state it too."""
    cone: str | None = None
    """Export only these factors and what they depend on, such as X0,X3."""
    known: float | None = None
    """Export only rows met in experience and their entries from this probability on; the rest is one more value."""
    start: str | None = None
    """Code that an exported process starts in, as digits (3,1,0,...) or as the number of a view met (view:17)."""
    plan: str | None = None
    """Actions, such as forward,left: with --to FILE.prism the chain over this plan, only what it can reach."""
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
    dbn = TwoSliceDBN.load(run.dbn)
    chosen: dict[str, Any] = {}
    goal = None if options.goal is None else _goal(dbn, options.goal)
    cone = None if options.cone is None else [_factor(dbn, name, "--cone") for name in options.cone.split(",")]
    name = formats.format_of(options.to, options.format)
    if goal is not None:
        cone = sorted({*goal, *(cone or ())})
        if name in ("prism", "pddl"):
            chosen["goal"] = goal
    if options.start is not None:
        chosen["start"] = _start(run, dbn, options.start)
    if options.plan is not None:
        chosen["plan"] = [_action(dbn, action) for action in options.plan.split(",")]
    formats.export(dbn, options.to, format=name, cone=cone, known=options.known, **chosen)
    return options.to


def _factor(dbn: TwoSliceDBN, name: str, option: str) -> int:
    if name.strip() not in dbn.factor_names:
        raise UserError(f"{option}: no factor '{name.strip()}'; the factors are {', '.join(dbn.factor_names)}")
    return dbn.factor_names.index(name.strip())


def _goal(dbn: TwoSliceDBN, text: str) -> dict[int, int]:
    goal: dict[int, int] = {}
    for part in text.split(","):
        name, equals, value = part.partition("=")
        if not equals or not value.strip().isdigit() or int(value) >= dbn.num_values:
            raise UserError(f"--goal {text}: expected FACTOR=VALUE, with values 0 to {dbn.num_values - 1}")
        goal[_factor(dbn, name, "--goal")] = int(value)
    return goal


def _action(dbn: TwoSliceDBN, name: str) -> int:
    if name.strip() not in dbn.action_names:
        raise UserError(f"--plan: no action '{name.strip()}'; the actions are {', '.join(dbn.action_names)}")
    return dbn.action_names.index(name.strip())


def _start(run: RunFolder, dbn: TwoSliceDBN, text: str) -> np.ndarray:
    from nesy.dbn import Codebook

    head, colon, number = text.partition(":")
    digits = (number if colon else text).split(",")
    if not all(digit.strip().isdigit() for digit in digits) or (colon and head != "view"):
        raise UserError(f"--start {text}: expected digits such as 3,1,0,... or view:NUMBER")
    if colon:
        codes = Codebook.load(run.dbn).codes
        if int(number) >= len(codes):
            raise UserError(f"--start {text}: the views are 0 to {len(codes) - 1}")
        return codes[int(number)].astype(np.int64)
    code = np.array([int(digit) for digit in digits])
    if len(code) != dbn.num_factors or code.max() >= dbn.num_values:
        raise UserError(f"--start {text}: a code has {dbn.num_factors} values from 0 to {dbn.num_values - 1}")
    return code


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
