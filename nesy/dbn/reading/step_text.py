"""Observation, reward and termination tables of the 2DBN as text for people."""

from __future__ import annotations

import numpy as np

from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.step_tables import NAMES, StepTable
from nesy.errors import UserError

MOST_ROWS = 12


def describe_step_table(
    dbn: TwoSliceDBN, name: str, action: int | None = None, target: str | None = None, most_rows: int = MOST_ROWS
) -> str:
    """What decides each target of a step table, and the rows of a target met most often.

    Args:
        dbn: the model.
        name: `observation`, `reward` or `termination`.
        action: the action; all without it.
        target: a target, such as `cell_2_3`; without it an overview, with the rows too where there is one target.
        most_rows: rows printed per table.

    Raises:
        UserError: the model has no such table, or the table no such target.
    """
    table = dbn.step_tables.get(name)
    if table is None:
        known = ", ".join(n for n in NAMES if n in dbn.step_tables) or "none"
        raise UserError(f"the model has no {name} table; it has {known}")
    if target is not None and target not in table.targets:
        raise UserError(f"the {name} table has no target '{target}'; it has {', '.join(table.targets)}")
    groups = range(len(table.parents_now))
    if action is not None:
        groups = range(table.group(action), table.group(action) + 1)
    chosen = range(len(table.targets)) if target is None else (table.targets.index(target),)
    what = f"one of {', '.join(table.outcomes)}" if table.outcomes else "a mean"
    met = int((table.row_counts > 0).sum())
    lines = [f"{name}: {what} for {len(table.targets)} targets, {len(table.values)} rows, {met} met in experience"]
    for a in groups:
        label = dbn.action_names[a] if len(table.parents_now) > 1 else "every action"
        lines += ["", f"{label}:"]
        lines += [_parents(dbn, table, a, t) for t in chosen]
        if len(chosen) == 1:
            lines += _rows(dbn, table, a, chosen[0], most_rows)
    return "\n".join(lines)


def _names(dbn: TwoSliceDBN, table: StepTable, action: int, target: int) -> list[str]:
    return [dbn.factor_names[p] + ("'" if where else "") for where, p in table.parents(action, target)]


def _parents(dbn: TwoSliceDBN, table: StepTable, action: int, target: int) -> str:
    counts = table.counts(action, target)
    parents = ", ".join(_names(dbn, table, action, target)) or "nothing"
    return f"  {table.targets[target]} <- {parents}   ({len(counts)} rows, {int((counts > 0).sum())} met)"


def _rows(dbn: TwoSliceDBN, table: StepTable, action: int, target: int, most_rows: int) -> list[str]:
    names, counts, values = (
        _names(dbn, table, action, target),
        table.counts(action, target),
        table.table(action, target),
    )
    chosen = np.argsort(-counts, kind="stable")[:most_rows]
    chosen = chosen[counts[chosen] > 0]
    digits = dbn.num_values ** np.arange(len(names) - 1, -1, -1, dtype=np.int64)
    cells = [[*names, "count"]]
    cells += [[*(str(v) for v in (row // digits) % dbn.num_values if names), str(counts[row])] for row in chosen]
    widths = [max(len(line[c]) for line in cells) for c in range(len(cells[0]))]
    said = ["", *(_outcome(table, values[row]) for row in chosen)]
    lines = [
        "    " + "  ".join(c.rjust(w) for c, w in zip(line, widths, strict=True)) + (f"  {text}" if text else "")
        for line, text in zip(cells, said, strict=True)
    ]
    left = int((counts > 0).sum()) - len(chosen)
    return [*lines, f"    ... and {left} rows more that were met"] if left else lines


def _outcome(table: StepTable, row: np.ndarray) -> str:
    if not table.outcomes:
        return f"{row[0]:.4g}"
    order = np.argsort(-row, kind="stable")
    return "  ".join(f"{table.outcomes[m]}: {row[m]:.4f}" for m in order if row[m] >= 0.0005)
