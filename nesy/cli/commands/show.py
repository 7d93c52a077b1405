"""Print or draw the 2DBN: its graph, a factor's table with what its values look like, its trees, its fidelity."""

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

    what: Annotated[Literal["dbn", "fidelity", "figure3"], tyro.conf.Positional] = "dbn"
    """What to show: the model, the report of how far it can be trusted, or figure 3 of the paper (with --to)."""
    run: Path = Path("runs/default")
    """The run folder."""
    factor: int | None = None
    """Show this factor: its tables, and a picture of what each of its values looks like."""
    action: str | None = None
    """Show this action only."""
    step_table: Literal["observation", "reward", "termination"] | None = None
    """Show this table instead of those of the factors: what decides each of its targets, and its rows."""
    target: str | None = None
    """Of --step-table, show the rows of this target, such as cell_2_3."""
    tree: bool = False
    """Print the tables of --factor as decision trees over the parents: only what was met, equal values together."""
    tolerance: float = 0.0
    """Total variation up to which --tree puts rows together; the error made is stated."""
    to: Path | None = None
    """Draw into this file, .png or .svg: the graph, or the values and tables of --factor."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the result as one JSON object on standard output."""


def run(options: Arguments) -> dict[str, Any]:
    """Print the table; draw the picture where --to is given."""
    folder = RunFolder.open(options.run)
    if options.what == "figure3":
        return _figure3(folder, options)
    folder.require("extract")
    if options.what == "fidelity":
        return _fidelity(folder, options)
    from nesy.dbn import Codebook, TwoSliceDBN, describe

    dbn = TwoSliceDBN.load(folder.dbn)
    factor, action = selection(dbn, options.factor, options.action)
    if options.target is not None and options.step_table is None:
        raise UserError("--target: names a target of --step-table")
    if options.step_table is not None:
        from nesy.dbn.reading.step_text import describe_step_table

        return {"table": describe_step_table(dbn, options.step_table, action, options.target)}
    if options.tree:
        return {"table": _trees(dbn, factor, action, options.tolerance)}
    parts = [describe(dbn, factor=factor, action=action)]
    if factor is not None:
        from nesy.dbn.reading.thumbnails import thumbnails

        parts.insert(0, thumbnails(dbn, Codebook.load(folder.dbn), factor))
    result = {"table": "\n\n".join(parts)}
    if options.to is not None:
        from nesy.dbn.reading.drawing import draw_factor, draw_graph

        if factor is None:
            draw_graph(dbn, options.to, action)
        else:
            draw_factor(dbn, Codebook.load(folder.dbn), factor, options.to, action)
        result["drawn"] = str(options.to)
    return result


def _figure3(folder: RunFolder, options: Arguments) -> dict[str, Any]:
    if options.to is None or options.to.suffix not in (".png", ".svg"):
        raise UserError("figure3: name the picture, .png or .svg, with --to")
    folder.require("train")
    from nesy.report import figure3
    from nesy.run_folder import atomic_path

    figure = figure3.draw(figure3.moments(folder, count=6))
    with atomic_path(options.to) as temporary:
        figure.savefig(temporary, dpi=110)
    return {"drawn": str(options.to)}


def _trees(dbn: TwoSliceDBN, factor: int | None, action: int | None, tolerance: float) -> str:
    from nesy.dbn.reading.trees import conditional_tree, describe_tree

    if factor is None:
        raise UserError("--tree: name the factor with --factor")
    if not 0 <= tolerance < 1:
        raise UserError(f"--tolerance {tolerance}: a total variation lies in [0, 1)")
    actions = range(dbn.num_actions) if action is None else (action,)
    trees = [(a, conditional_tree(dbn, a, factor, tolerance, met_only=True)) for a in actions]
    return "\n\n".join(describe_tree(dbn, a, factor, tree) for a, tree in trees)


def _fidelity(folder: RunFolder, options: Arguments) -> dict[str, Any]:
    from nesy.report.text import flat, number

    report = folder.read_summary().get("dbn", {}).get("fidelity")
    if report is None:
        raise UserError(f"{folder.path}: has no fidelity report; make it with: nesy extract --run {folder.path} --redo")
    rows = flat(report)
    width = max(len(name) for name, _ in rows)
    result: dict[str, Any] = {"table": "\n".join(f"{name.ljust(width)}  {number(value)}" for name, value in rows)}
    if options.to is not None:
        from nesy.dbn.reading.fidelity_drawing import draw_fidelity

        draw_fidelity(report, options.to)
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
