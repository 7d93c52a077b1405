"""Conditional tables of the forward model: counted under a structure, with back-off for rows never seen.

A row of a table is one combination of parent values in mixed radix, first parent most significant. With
counts c(r, k) of row r, the number t(r) of distinct values met in it (1 at least) and the table p' of the same
family without one of its parents,

    p(k | r) = (c(r, k) + strength * t(r) * p'(k | r without that parent)) / (c(r) + strength * t(r))

which is Witten and Bell's smoothing with a strength. A row never seen falls back to fewer parents, and at last to
the marginal: every row is a proper distribution with no zeros. The parents of slice t are left out first, the last
one chosen before the others: the arcs inside slice t+1 keep even a guess consistent in itself.
"""

from __future__ import annotations

import numpy as np

from nesy.world_model.structure import Structure

STRENGTH = 0.03
"""Weight of the back-off distribution of the full table, in transitions."""
SHORTENED = 10.0
"""How much stronger the tables of fewer parents are smoothed: they are asked only where the full one is silent."""


def row_index(values: np.ndarray, num_values: int) -> np.ndarray:
    """Row of each combination `[n, P]` of parent values, first parent most significant: int64 `[n]`."""
    row = np.zeros(len(values), dtype=np.int64)
    for column in range(values.shape[1]):
        row = row * num_values + values[:, column]
    return row


def conditional_table(
    parents: np.ndarray,
    num_now: int,
    child: np.ndarray,
    weight: np.ndarray,
    num_values: int,
    strength: float = STRENGTH,
) -> np.ndarray:
    """A conditional table with back-off.

    Args:
        parents: int [E, P] values of the parents, those of slice t first.
        num_now: how many of them are of slice t.
        child: int [E] values of the child.
        weight: [E].
        num_values: K.
        strength: weight of the back-off distribution of the full table.

    Returns:
        float64 [K ** P, K]; rows sum to 1.
    """
    width = parents.shape[1]
    order = [*range(num_now, width), *range(num_now)]
    values = parents[:, order]
    counts = np.bincount(child, weights=weight, minlength=num_values)
    table = ((counts + 1.0 / num_values) / (counts.sum() + 1.0))[None]
    for depth in range(1, width + 1):
        cell = row_index(values[:, :depth], num_values) * num_values + child
        counts = np.bincount(cell, weights=weight, minlength=num_values ** (depth + 1)).reshape(-1, num_values)
        met = np.maximum((counts > 0).sum(axis=1, keepdims=True), 1)
        weight_below = strength * met * (SHORTENED if depth < width else 1.0)
        table = counts + weight_below * np.repeat(table, num_values, axis=0)
        table /= table.sum(axis=1, keepdims=True)
    # Back from the order of the back-off to the order of the parents.
    axes = [order.index(parent) for parent in range(width)]
    table = table.reshape((num_values,) * (width + 1)).transpose([*axes, width])
    return np.ascontiguousarray(table).reshape(-1, num_values)


def all_tables(
    structure: Structure,
    now: np.ndarray,
    action: np.ndarray,
    then: np.ndarray,
    weight: np.ndarray,
    num_values: int,
    strength: float = STRENGTH,
) -> list[list[np.ndarray]]:
    """The table of every action and factor: `[A][N]` arrays float64 `[rows, K]`.

    Args:
        structure: the parents.
        now: int [E, N] codes before.
        action: int [E].
        then: int [E, N] codes after.
        weight: [E].
        num_values: K.
        strength: weight of the back-off distribution.
    """
    tables = []
    for a in range(structure.num_actions):
        rows = action == a
        before, after, mass = now[rows].astype(np.int64), then[rows].astype(np.int64), weight[rows]
        tables.append(
            [
                conditional_table(
                    np.concatenate(
                        [before[:, structure.parents_now[a][i]], after[:, structure.parents_next[a][i]]], axis=1
                    ),
                    len(structure.parents_now[a][i]),
                    after[:, i],
                    mass,
                    num_values,
                    strength,
                )
                for i in range(structure.num_factors)
            ]
        )
    return tables


def log_probability(
    structure: Structure,
    tables: list[list[np.ndarray]],
    now: np.ndarray,
    action: np.ndarray,
    then: np.ndarray,
    num_values: int,
) -> np.ndarray:
    """Log T(x' | x, a) in nats of each transition, float64 `[E]` (arguments as in `all_tables`)."""
    total = np.zeros(len(action))
    for a in range(structure.num_actions):
        rows = np.flatnonzero(action == a)
        before, after = now[rows].astype(np.int64), then[rows].astype(np.int64)
        for i in range(structure.num_factors):
            values = np.concatenate(
                [before[:, structure.parents_now[a][i]], after[:, structure.parents_next[a][i]]], axis=1
            )
            total[rows] += np.log(tables[a][i][row_index(values, num_values), after[:, i]])
    return total
