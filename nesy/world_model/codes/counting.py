"""Counts of parent and child values over weighted transitions, kept up to date while codes change.

Family f = action * N + factor counts, for every combination of its parents' values, the values of its factor in
slice t+1. The total conditional entropy in nats times weight follows each change exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nesy.compiled import njit
from nesy.world_model.distinct import Transitions
from nesy.world_model.structure import Structure


class Edges(NamedTuple):
    """Transitions as arrays of one length."""

    source: np.ndarray
    """int64 [E]: view before."""
    action: np.ndarray
    """int64 [E]."""
    target: np.ndarray
    """int64 [E]: view after."""
    weight: np.ndarray
    """int64 [E], positive."""


class Families(NamedTuple):
    """A structure for kernels."""

    size: np.ndarray
    """int64 [F]: number of parents."""
    which: np.ndarray
    """int64 [F, P]: 0 for a parent of slice t, 1 for one of slice t+1."""
    factor: np.ndarray
    """int64 [F, P]: the parent."""
    as_now: np.ndarray
    """bool [F, N]: whether the family looks at the factor in slice t."""
    as_next: np.ndarray
    """bool [F, N]: whether it looks at the factor in slice t+1, as parent or as child."""


class Counts(NamedTuple):
    """Weighted counts of the families."""

    cells: np.ndarray
    """int32 [F, K ** (P + 1)]: of parents and child; int64 where the weights add up to more."""
    rows: np.ndarray
    """[F, K ** P] of that type: of parents."""
    logs: np.ndarray
    """float64 [L]: n log n for n < L."""


def edges_of(transitions: Transitions) -> Edges:
    """The transitions as arrays."""
    return Edges(transitions.source, transitions.action, transitions.target, transitions.weight)


def families_of(structure: Structure) -> Families:
    """The families of a structure."""
    count, which, factor = structure.arrays()
    num_factors = structure.num_factors
    as_now = np.zeros((len(count), num_factors), dtype=np.bool_)
    as_next = np.zeros((len(count), num_factors), dtype=np.bool_)
    for f in range(len(count)):
        as_next[f, f % num_factors] = True
        for p in range(count[f]):
            (as_now if which[f, p] == 0 else as_next)[f, factor[f, p]] = True
    return Families(count, which, factor, as_now, as_next)


def logs_up_to(total: int) -> np.ndarray:
    """N log n for n up to `total`, a million at most."""
    counts = np.arange(min(total + 1, 1 << 20), dtype=np.float64)
    return counts * np.log(np.maximum(counts, 1.0))


def count_type(weight: np.ndarray) -> type[np.generic]:
    """The narrower of two types that holds the sum of some weights."""
    return np.int32 if int(weight.sum()) <= np.iinfo(np.int32).max else np.int64


def count(codes: np.ndarray, edges: Edges, families: Families, num_values: int, logs: np.ndarray) -> Counts:
    """Count all transitions under codes int64 [V, N]."""
    widest = int(families.size.max())
    kind = count_type(edges.weight)
    rows = np.zeros((len(families.size), num_values**widest), dtype=kind)
    cells = np.zeros((len(families.size), num_values ** (widest + 1)), dtype=kind)
    counts = Counts(cells, rows, logs)
    _count(codes, edges, families, counts, num_values)
    return counts


@njit(cache=True)
def x_log_x(count: int, logs: np.ndarray) -> float:
    """N log n, 0 for 0."""
    if count < len(logs):
        return logs[count]
    return count * np.log(count)


@njit(cache=True)
def _add(
    sign: int, f: int, e: int, child: int, codes: np.ndarray, edges: Edges, families: Families, counts: Counts,
    num_values: int,
) -> float:  # fmt: skip
    """Add or remove one transition in one family; returns the change of entropy."""
    row = 0
    for p in range(families.size[f]):
        view = edges.source[e] if families.which[f, p] == 0 else edges.target[e]
        row = row * num_values + codes[view, families.factor[f, p]]
    key = row * num_values + codes[edges.target[e], child]
    weight = sign * edges.weight[e]
    cell, mass = counts.cells[f, key], counts.rows[f, row]
    counts.cells[f, key] = cell + weight
    counts.rows[f, row] = mass + weight
    return (
        x_log_x(cell, counts.logs)
        - x_log_x(cell + weight, counts.logs)
        + x_log_x(mass + weight, counts.logs)
        - x_log_x(mass, counts.logs)
    )


@njit(cache=True)
def _count(codes: np.ndarray, edges: Edges, families: Families, counts: Counts, num_values: int) -> None:
    num_factors = codes.shape[1]
    for e in range(len(edges.source)):
        for child in range(num_factors):
            _add(1, edges.action[e] * num_factors + child, e, child, codes, edges, families, counts, num_values)


@njit(cache=True)
def shift_edge(
    sign: int, e: int, before: bool, after: bool, changed: int, codes: np.ndarray, edges: Edges, families: Families,
    counts: Counts, num_values: int,
) -> float:  # fmt: skip
    """Add (sign 1) or remove (-1) a transition wherever a family looks at the changed entries of the code book.

    Args:
        sign: 1 or -1.
        e: the transition.
        before: whether its view before changes.
        after: whether its view after changes.
        changed: the factor that changes.
        codes: int64 [V, N].
        edges: all transitions.
        families: the structure.
        counts: gets the change.
        num_values: K.

    Returns:
        The change of the conditional entropy, nats times weight.
    """
    num_factors = codes.shape[1]
    change = 0.0
    for child in range(num_factors):
        f = edges.action[e] * num_factors + child
        if (before and families.as_now[f, changed]) or (after and families.as_next[f, changed]):
            change += _add(sign, f, e, child, codes, edges, families, counts, num_values)
    return change
