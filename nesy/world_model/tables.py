"""Conditional tables of the forward model: counted under a structure, with back-off for rows never seen.

A row of a table is one combination of parent values in mixed radix, first parent most significant. With
counts c(r, k) of row r and the table p' of the same family without its last parent,

    p(k | r) = (c(r, k) + strength * p'(k | r without last parent)) / (c(r) + strength)

so a row never seen falls back to fewer parents, and at last to the (add-one) marginal: every row is a proper
distribution with no zeros.
"""

from __future__ import annotations

import numpy as np

from nesy.world_model.structure import Structure

STRENGTH = 0.02
"""Weight of the back-off distribution, in transitions."""


def row_index(values: np.ndarray, num_values: int) -> np.ndarray:
    """Row of each combination `[n, P]` of parent values, first parent most significant: int64 `[n]`."""
    row = np.zeros(len(values), dtype=np.int64)
    for column in range(values.shape[1]):
        row = row * num_values + values[:, column]
    return row


def conditional_table(
    parents: np.ndarray, child: np.ndarray, weight: np.ndarray, num_values: int, strength: float = STRENGTH
) -> np.ndarray:
    """A conditional table with back-off.

    Args:
        parents: int [E, P] values of the parents.
        child: int [E] values of the child.
        weight: [E].
        num_values: K.
        strength: weight of the back-off distribution.

    Returns:
        float64 [K ** P, K]; rows sum to 1.
    """
    counts = np.bincount(child, weights=weight, minlength=num_values)
    table = ((counts + 1.0 / num_values) / (counts.sum() + 1.0))[None]
    for depth in range(1, parents.shape[1] + 1):
        cell = row_index(parents[:, :depth], num_values) * num_values + child
        counts = np.bincount(cell, weights=weight, minlength=num_values ** (depth + 1)).reshape(-1, num_values)
        table = counts + strength * np.repeat(table, num_values, axis=0)
        table /= table.sum(axis=1, keepdims=True)
    return table


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
