"""Draw the 2DBN: its graph per action, or what the values of one factor look like; and print its tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from nesy.errors import UserError
from nesy.run_folder import RunFolder

if TYPE_CHECKING:
    from nesy.dbn import TwoSliceDBN


@dataclass(frozen=True)
class Arguments:
    """Options of `nesy show`."""

    what: Annotated[Literal["dbn"], tyro.conf.Positional] = "dbn"
    """What to show."""
    run: Path = Path("runs/default")
    """The run folder."""
    factor: int | None = None
    """Show this factor: its tables, and a picture of what each of its values looks like."""
    action: str | None = None
    """Show this action only."""
    to: Path | None = None
    """Draw into this file, .png or .svg: the graph, or the values of --factor."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the result as one JSON object on standard output."""


def run(options: Arguments) -> dict[str, Any]:
    """Print the table; draw the picture where --to is given."""
    folder = RunFolder.open(options.run)
    folder.require("extract")
    from nesy.dbn import Codebook, TwoSliceDBN, describe

    dbn = TwoSliceDBN.load(folder.dbn)
    factor, action = selection(dbn, options.factor, options.action)
    result = {"table": describe(dbn, factor=factor, action=action)}
    if options.to is not None:
        from nesy.dbn.drawing import draw_factor, draw_graph

        if factor is None:
            draw_graph(dbn, options.to, action)
        else:
            draw_factor(dbn, Codebook.load(folder.dbn), factor, options.to)
        result["drawn"] = str(options.to)
    return result


def selection(dbn: TwoSliceDBN, factor: int | None, action: str | None) -> tuple[int | None, int | None]:
    """The numbers of the factor and the action that the options name.

    Raises:
        UserError: there is no such factor or action.
    """
    if factor is not None and not 0 <= factor < len(dbn.factor_names):
        last = len(dbn.factor_names) - 1
        raise UserError(f"--factor {factor}: no such factor; the factors are 0 to {last}")
    if action is not None and action not in dbn.action_names:
        names = ", ".join(dbn.action_names)
        raise UserError(f"--action {action}: no such action; the actions are {names}")
    return factor, None if action is None else dbn.action_names.index(action)


def show(result: dict[str, Any]) -> None:
    """Print the table, or where the picture is."""
    print(f"drawn: {result['drawn']}" if "drawn" in result else result["table"])
