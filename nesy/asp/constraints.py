"""Knowledge from people acting on the tables: impossible entries are removed, rows renormalised, and reported."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nesy.asp.program.names import TERM, encode
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

MOST_EXAMPLES = 20

_ATOM = re.compile(rf"impossible\(({TERM}),(\d+),\(([\d,]*)\),(\d+)\)$")


@dataclass(frozen=True)
class Removal:
    """What rules removed from a model."""

    entries: int
    """Entries set to 0."""
    rows: int
    """Rows changed."""
    largest: float
    """Largest probability that one row lost."""
    visits: float
    """Share of all visits in experience that fall on the rows changed."""
    examples: tuple[tuple[str, str], ...] = ()
    """Some of the atoms that named an entry, each with the row that it changed."""


def remove_entries(dbn: TwoSliceDBN, atoms: Sequence[str]) -> tuple[TwoSliceDBN, Removal]:
    """Remove the entries that atoms impossible(A,F,X,V) name.

    Raises:
        UserError: an atom names no entry, or a row would be left empty.
    """
    actions = [encode(name) for name in dbn.action_names]
    table = np.array(dbn.probabilities)
    touched = set()
    examples: list[tuple[str, str]] = []
    for atom in atoms:
        match = _ATOM.match(atom)
        values = [int(v) for v in match[3].split(",") if v] if match else []
        action = actions.index(match[1]) if match and match[1] in actions else -1
        factor = int(match[2]) if match else -1
        if match is None or action < 0 or factor >= dbn.num_factors or int(match[4]) >= dbn.num_values:
            raise UserError(f"{atom}: no entry of this model (expected impossible(ACTION,FACTOR,(VALUES,),VALUE))")
        if len(values) != len(dbn.parents(action, factor)) or any(v >= dbn.num_values for v in values):
            raise UserError(f"{atom}: the row needs a value for each of {len(dbn.parents(action, factor))} parents")
        row = int(dbn.offsets[action, factor])
        row += int(np.ravel_multi_index(values, (dbn.num_values,) * len(values))) if values else 0
        table[row, int(match[4])] = 0.0
        touched.add(row)
        if len(examples) < MOST_EXAMPLES:
            examples.append((atom, _name(dbn, row)))
    rows = np.array(sorted(touched), dtype=np.int64)
    totals = table[rows].sum(axis=1)
    if (totals <= 0).any():
        raise UserError(f"the rules leave no value possible in {_name(dbn, int(rows[totals.argmin()]))}")
    lost = dbn.probabilities[rows].sum(axis=1) - totals
    table[rows] /= totals[:, None]
    report = Removal(
        entries=len(set(atoms)),
        rows=len(rows),
        largest=float(lost.max(initial=0.0)),
        visits=float(dbn.row_counts[rows].sum() / max(1, dbn.row_counts.sum())),
        examples=tuple(examples),
    )
    return replace(dbn, probabilities=table), report


def _name(dbn: TwoSliceDBN, row: int) -> str:
    action, factor = divmod(int(np.searchsorted(dbn.offsets.reshape(-1), row, side="right")) - 1, dbn.num_factors)
    parents = dbn.parents(action, factor)
    shape = (dbn.num_values,) * len(parents)
    values = np.unravel_index(row - int(dbn.offsets[action, factor]), shape) if parents else ()
    given = ", ".join(
        f"{dbn.factor_names[p]}{chr(39) * where} = {int(v)}" for (where, p), v in zip(parents, values, strict=True)
    )
    name = f"the row {given or 'without parents'}"
    return f"{name} of {dbn.factor_names[factor]} under {dbn.action_names[action]}"
