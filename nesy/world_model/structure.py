"""Which parents each factor of the next slice has: penalised-likelihood search over the codes.

For action a and factor i the parents are some factors of slice t and at most a few earlier factors of slice
t+1 in a fixed order. The score of a choice is the conditional entropy of X'_i given its parents over weighted
transitions, plus a penalty per occupied table cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nesy.compiled import njit


@dataclass(frozen=True)
class Limits:
    """What a structure may look like."""

    now: int = 4
    """Most parents from slice t per factor and action."""
    next: int = 2
    """Most parents from slice t+1, at most 2. Two are allowed only if one is a parent of the other, so that the
    arcs inside a slice form a 2-tree and next marginals can be computed exactly, pair by pair."""
    total: int = 5
    """Most parents in all: a table has `values ** total` rows."""
    penalty: float = 0.0
    """Nats per occupied table cell that a parent must save."""


@dataclass(frozen=True)
class Structure:
    """Parents per action and factor; `order` is the order in which the factors of slice t+1 are decided."""

    parents_now: tuple[tuple[tuple[int, ...], ...], ...]
    parents_next: tuple[tuple[tuple[int, ...], ...], ...]
    order: tuple[int, ...]

    @property
    def num_actions(self) -> int:
        """Number of actions."""
        return len(self.parents_now)

    @property
    def num_factors(self) -> int:
        """Number of factors."""
        return len(self.order)

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Parents for kernels; family f = action * num_factors + factor.

        Returns:
            `count` int64 [F], `slice` int64 [F, P] (0: slice t, 1: slice t+1) and `factor` int64 [F, P]; parents
            of slice t come first, each in the order of the tuples.
        """
        families = [
            [(0, j) for j in self.parents_now[a][i]] + [(1, j) for j in self.parents_next[a][i]]
            for a in range(self.num_actions)
            for i in range(self.num_factors)
        ]
        width = max(1, max(len(family) for family in families))
        count = np.array([len(family) for family in families], dtype=np.int64)
        which = np.zeros((len(families), width), dtype=np.int64)
        factor = np.zeros((len(families), width), dtype=np.int64)
        for f, family in enumerate(families):
            for position, (kind, j) in enumerate(family):
                which[f, position], factor[f, position] = kind, j
        return count, which, factor


@njit(cache=True)
def _conditional_entropy(
    rows: np.ndarray, values: np.ndarray, weight: np.ndarray, num_values: int
) -> tuple[float, int]:
    """Summed conditional entropy (nats times weight) of values given rows, and the number of occupied cells."""
    order = np.argsort(rows * num_values + values)
    total, cells, position = 0.0, 0, 0
    while position < len(order):
        row = rows[order[position]]
        mass = 0.0
        while position < len(order) and rows[order[position]] == row:
            value, part = values[order[position]], 0.0
            while position < len(order) and rows[order[position]] == row and values[order[position]] == value:
                part += weight[order[position]]
                position += 1
            total -= part * np.log(part)
            mass += part
            cells += 1
        total += mass * np.log(mass)
    return total, cells


def search(
    now: np.ndarray,
    action: np.ndarray,
    then: np.ndarray,
    weight: np.ndarray,
    *,
    num_values: int,
    num_actions: int,
    limits: Limits,
    order: tuple[int, ...] | None = None,
    start: Structure | None = None,
) -> tuple[Structure, float]:
    """Choose the parents greedily, family by family.

    Args:
        now: int [E, N] codes before.
        action: int [E].
        then: int [E, N] codes after.
        weight: [E], positive.
        num_values: K.
        num_actions: A.
        limits: what a structure may look like.
        order: order of the factors in slice t+1; 0, 1, ... by default.
        start: a structure to keep wherever the search finds no better family.

    Returns:
        The structure and its conditional entropy in nats per transition, all factors together.
    """
    assert now.shape == then.shape and len(now) == len(action) == len(weight) > 0
    num_factors = now.shape[1]
    order = order or tuple(range(num_factors))
    parents_now: list[list[tuple[int, ...]]] = [[()] * num_factors for _ in range(num_actions)]
    parents_next: list[list[tuple[int, ...]]] = [[()] * num_factors for _ in range(num_actions)]
    total = 0.0
    for a in range(num_actions):
        rows = action == a
        columns = (now[rows].astype(np.int64).T.copy(), then[rows].astype(np.int64).T.copy())
        mass = weight[rows].astype(np.float64)
        for position, i in enumerate(order):
            adjacent = {frozenset((j, k)) for j in order[:position] for k in parents_next[a][j]}
            family, entropy, score = _best_family(columns, mass, i, order[:position], adjacent, num_values, limits)
            if start is not None and (
                len(start.parents_next[a][i]) < 2 or frozenset(start.parents_next[a][i]) in adjacent
            ):
                kept = [(0, j) for j in start.parents_now[a][i]] + [(1, j) for j in start.parents_next[a][i]]
                kept_entropy, cells = _entropy_of(columns, mass, i, kept, num_values)
                if kept_entropy + limits.penalty * cells <= score:
                    family, entropy = kept, kept_entropy
            parents_now[a][i] = tuple(j for kind, j in family if kind == 0)
            parents_next[a][i] = tuple(j for kind, j in family if kind == 1)
            total += entropy
    structure = Structure(tuple(map(tuple, parents_now)), tuple(map(tuple, parents_next)), tuple(order))
    return structure, total / float(weight.sum())


def _entropy_of(
    columns: tuple[np.ndarray, np.ndarray],
    mass: np.ndarray,
    factor: int,
    family: list[tuple[int, int]],
    num_values: int,
) -> tuple[float, int]:
    rows = np.zeros(len(mass), dtype=np.int64)
    for kind, j in family:
        rows = rows * num_values + columns[kind][j]
    return _conditional_entropy(rows, columns[1][factor], mass, num_values)


def _best_family(
    columns: tuple[np.ndarray, np.ndarray],
    mass: np.ndarray,
    factor: int,
    earlier: tuple[int, ...],
    adjacent: set[frozenset[int]],
    num_values: int,
    limits: Limits,
) -> tuple[list[tuple[int, int]], float, float]:
    family: list[tuple[int, int]] = []
    entropy, cells = _entropy_of(columns, mass, factor, family, num_values)
    score = entropy + limits.penalty * cells
    while len(family) < limits.total:
        used_next = [j for kind, j in family if kind == 1]
        candidates = [
            (1, j)
            for j in earlier
            if len(used_next) < limits.next and (not used_next or frozenset((j, used_next[0])) in adjacent)
        ]
        if len(family) - len(used_next) < limits.now:
            candidates += [(0, j) for j in range(len(columns[0]))]
        best: tuple[float, float, tuple[int, int]] | None = None
        for candidate in candidates:
            if candidate in family:
                continue
            found, cells = _entropy_of(columns, mass, factor, [*family, candidate], num_values)
            if best is None or found + limits.penalty * cells < best[0] - 1e-9:
                best = (found + limits.penalty * cells, found, candidate)
        if best is None or best[0] >= score - 1e-9:
            break
        score, entropy = best[0], best[1]
        family.append(best[2])
    return family, entropy, score
