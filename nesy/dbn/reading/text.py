"""The 2DBN as text for people."""

from __future__ import annotations

import numpy as np

from nesy.dbn.graph import arc_strength
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

MOST_ROWS = 40


def describe(dbn: TwoSliceDBN, factor: int | None = None, action: int | None = None, most_rows: int = MOST_ROWS) -> str:
    """A readable table of one factor and action, of one of them, or an overview of all.

    Args:
        dbn: the model.
        factor: the factor; all without it.
        action: the action; all without it.
        most_rows: rows printed per table, the most frequently met first.

    Raises:
        UserError: there is no such factor or action.
    """
    if factor is not None and not 0 <= factor < dbn.num_factors:
        raise UserError(f"no factor {factor}; the factors are 0 to {dbn.num_factors - 1}")
    if action is not None and not 0 <= action < dbn.num_actions:
        raise UserError(f"no action {action}; the actions are {', '.join(dbn.action_names)}")
    if factor is None:
        return _overview(dbn, range(dbn.num_actions) if action is None else (action,))
    parts = [_meanings(dbn, factor)] if dbn.value_meanings else []
    parts += [_table(dbn, factor, a, most_rows) for a in (range(dbn.num_actions) if action is None else (action,))]
    return "\n\n".join(parts)


def parent_names(dbn: TwoSliceDBN, action: int, factor: int) -> list[str]:
    """Names of a factor's parents, with a stroke for those of slice t+1."""
    return [dbn.factor_names[p] + ("'" if where else "") for where, p in dbn.parents(action, factor)]


def _overview(dbn: TwoSliceDBN, actions: range | tuple[int, ...]) -> str:
    lines = [
        f"2DBN: {dbn.num_factors} factors x {dbn.num_values} values, {dbn.num_actions} actions, "
        f"{len(dbn.probabilities)} rows, {int((dbn.row_counts > 0).sum())} met in experience",
        "A stroke marks slice t+1; the number after a parent says how far its value changes the factor (0 to 1).",
    ]
    for a in actions:
        lines += ["", f"{dbn.action_names[a]}:"]
        for i in range(dbn.num_factors):
            parents = [
                f"{name} {strength:.2f}"
                for name, strength in zip(parent_names(dbn, a, i), arc_strength(dbn, a, i), strict=True)
            ]
            met = int((dbn.counts(a, i) > 0).sum())
            lines.append(
                f"  {dbn.factor_names[i]}' <- {', '.join(parents) or 'nothing'}"
                f"   ({dbn.num_rows(a, i)} rows, {met} met)"
            )
    if dbn.step_tables:
        lines += ["", f"Further tables: {', '.join(dbn.step_tables)} (nesy show dbn --step-table NAME)"]
    return "\n".join(lines)


def _meanings(dbn: TwoSliceDBN, factor: int) -> str:
    lines = [f"{dbn.factor_names[factor]}:"]
    lines += [f"  = {value}  {text}" for value, text in enumerate(dbn.value_meanings[factor])]
    return "\n".join(lines)


def _table(dbn: TwoSliceDBN, factor: int, action: int, most_rows: int) -> str:
    names = parent_names(dbn, action, factor)
    counts, table = dbn.counts(action, factor), dbn.cpt(action, factor)
    met = int((counts > 0).sum())
    name = dbn.factor_names[factor]
    given = f" | {', '.join(names)}" if names else ""
    head = f"P({name}'{given}) under {dbn.action_names[action]}: {len(table)} rows, {met} met in experience"
    chosen = np.argsort(-counts, kind="stable")[:most_rows]
    if met:
        chosen = chosen[counts[chosen] > 0]
    digits = dbn.num_values ** np.arange(len(names) - 1, -1, -1, dtype=np.int64)
    rows = [["", *names, "count", f"{name}' with probability"]]
    for row in chosen:
        values = (row // digits) % dbn.num_values if names else []
        rows.append(["", *(str(v) for v in values), str(counts[row]), distribution(table[row])])
    widths = [max(len(cells[c]) for cells in rows) for c in range(len(rows[0]) - 1)]
    lines = ["  ".join([*(c.rjust(w) for c, w in zip(r[:-1], widths, strict=True)), r[-1]]) for r in rows]
    shown = len(chosen)
    if shown < (met or len(table)):
        lines.append(f"  ... and {(met or len(table)) - shown} rows more")
    return "\n".join([head, *lines])


def distribution(row: np.ndarray, least: float = 0.005) -> str:
    """A row as text: the values with at least that probability, most probable first."""
    order = np.argsort(-row, kind="stable")
    return "  ".join(f"{k}: {row[k]:.3f}" for k in order if row[k] >= least)
