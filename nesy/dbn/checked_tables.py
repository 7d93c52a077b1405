"""Tables given from outside: what does not fit a 2DBN is refused before it is laid out as another one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nesy.dbn.step_tables import Parents
from nesy.errors import UserError


def flat_tables(cpts: Sequence[Sequence[np.ndarray]]) -> tuple[np.ndarray, int]:
    """All rows float64 [rows, K] of tables [A][N], and K.

    Raises:
        UserError: they are none of one model.
    """
    num_factors = len(cpts[0])
    tables: list[np.ndarray] = []
    for a, per_action in enumerate(cpts):
        if len(per_action) != num_factors:
            raise UserError(f"action {a} has {len(per_action)} tables, action 0 has {num_factors}: one per factor")
        for i, table in enumerate(per_action):
            where = f"the table of factor {i} under action {a}"
            try:
                rows = np.asarray(table, dtype=np.float64)
            except (TypeError, ValueError):
                raise UserError(f"{where} must be numbers [rows, K]") from None
            if rows.ndim != 2 or not rows.shape[1]:
                raise UserError(f"{where} must have the shape [rows, K], found {list(rows.shape)}")
            if tables and rows.shape[1] != tables[0].shape[1]:
                raise UserError(
                    f"{where} is of {rows.shape[1]} values and those before of {tables[0].shape[1]}: all factors of "
                    "a 2DBN have as many; pad the smaller ones with values that never occur"
                )
            tables.append(rows)
    return np.concatenate(tables), tables[0].shape[1]


def check_rows(
    tables: Sequence[Sequence[np.ndarray]], what: str, now: Parents, later: Parents, num_values: int
) -> None:
    """Whether every table has a row per combination of its parents' values: too many in one would shift the others."""
    for a, per_action in enumerate(tables):
        for i, table in enumerate(per_action):
            try:
                wanted = num_values ** (len(now[a][i]) + len(later[a][i]))
            except IndexError:
                raise UserError("parents_now and parents_next must have one entry per action and factor") from None
            if len(table) != wanted:
                raise UserError(
                    f"the table of factor {i} under action {a} must have {wanted} {what} for its parents, "
                    f"found {len(table)}"
                )
