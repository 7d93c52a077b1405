"""Which codes can follow a code: exact enumeration over the factored tables, for compiled loops.

A forward model is packed into flat arrays, so that one kernel serves the world model and the extracted 2DBN.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from nesy.compiled import njit

CAPACITY = 4096


class Factored(Protocol):
    """What can be packed: parents per action and factor, an order, and conditional tables."""

    @property
    def parents_now(self) -> tuple[tuple[tuple[int, ...], ...], ...]:
        """[a][i]: parents in slice t."""
        ...

    @property
    def parents_next(self) -> tuple[tuple[tuple[int, ...], ...], ...]:
        """[a][i]: parents in slice t+1."""
        ...

    @property
    def order(self) -> tuple[int, ...]:
        """The order in which the factors of slice t+1 are decided."""
        ...


@dataclass(frozen=True)
class PackedModel:
    """A factored transition as arrays; family f = action * N + factor."""

    probabilities: np.ndarray
    """float64 [rows, K], all tables one after the other."""
    offset: np.ndarray
    """int64 [F]: first row of each family."""
    count: np.ndarray
    """int64 [F]: number of parents."""
    which: np.ndarray
    """int64 [F, P]: 0 for a parent of slice t, 1 for one of slice t+1."""
    factor: np.ndarray
    """int64 [F, P]: the parent."""
    order: np.ndarray
    """int64 [N]."""

    @property
    def num_values(self) -> int:
        """K."""
        return int(self.probabilities.shape[1])

    @property
    def num_factors(self) -> int:
        """N."""
        return len(self.order)

    @property
    def num_actions(self) -> int:
        """A."""
        return len(self.offset) // len(self.order)


def pack(structure: Factored, tables: list[list[np.ndarray]]) -> PackedModel:
    """Pack tables `[A][N]` of float64 [rows, K] with their structure."""
    families = [
        [(0, j) for j in now] + [(1, j) for j in then]
        for a in range(len(tables))
        for now, then in zip(structure.parents_now[a], structure.parents_next[a], strict=True)
    ]
    width = max(1, max(len(family) for family in families))
    which = np.zeros((len(families), width), dtype=np.int64)
    factor = np.zeros((len(families), width), dtype=np.int64)
    for f, family in enumerate(families):
        for position, (kind, j) in enumerate(family):
            which[f, position], factor[f, position] = kind, j
    flat = [table for per_action in tables for table in per_action]
    sizes = np.array([len(table) for table in flat], dtype=np.int64)
    return PackedModel(
        probabilities=np.ascontiguousarray(np.concatenate(flat), dtype=np.float64),
        offset=np.cumsum(sizes) - sizes,
        count=np.array([len(family) for family in families], dtype=np.int64),
        which=which,
        factor=factor,
        order=np.array(structure.order, dtype=np.int64),
    )


@njit(cache=True)
def _expand(
    code: np.ndarray,
    action: int,
    threshold: float,
    probabilities: np.ndarray,
    offset: np.ndarray,
    count: np.ndarray,
    which: np.ndarray,
    factor: np.ndarray,
    order: np.ndarray,
    codes: np.ndarray,
    mass: np.ndarray,
) -> int:
    """Fill `codes` and `mass` with the successors more probable than `threshold`; returns how many.

    Where there is no room for all branches, the less probable values of a factor are dropped.
    """
    num_factors, num_values = len(order), probabilities.shape[1]
    capacity = len(codes) // 2
    used, base, other = 1, 0, capacity
    mass[0] = 1.0
    for position in range(num_factors):
        i = order[position]
        f = action * num_factors + i
        found = 0
        for b in range(base, base + used):
            row = 0
            for p in range(count[f]):
                row = row * num_values + (code[factor[f, p]] if which[f, p] == 0 else codes[b, factor[f, p]])
            row += offset[f]
            for value in range(num_values):
                joint = mass[b] * probabilities[row, value]
                if joint <= threshold or found >= capacity:
                    continue
                for earlier in range(position):
                    codes[other + found, order[earlier]] = codes[b, order[earlier]]
                codes[other + found, i] = value
                mass[other + found] = joint
                found += 1
        base, other, used = other, base, found
    for b in range(used):
        for i in range(num_factors):
            codes[b, i] = codes[base + b, i]
        mass[b] = mass[base + b]
    return used


@njit(cache=True)
def _expand_all(
    start: np.ndarray,
    actions: np.ndarray,
    threshold: float,
    probabilities: np.ndarray,
    offset: np.ndarray,
    count: np.ndarray,
    which: np.ndarray,
    factor: np.ndarray,
    order: np.ndarray,
    capacity: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    num_factors = len(order)
    codes = np.zeros((2 * capacity, num_factors), dtype=np.int64)
    mass = np.zeros(2 * capacity)
    ends = np.zeros(len(start) + 1, dtype=np.int64)
    room = 16 * len(start) + 16
    all_codes, all_mass = np.empty((room, num_factors), dtype=np.uint8), np.empty(room)
    for s in range(len(start)):
        used = _expand(start[s], actions[s], threshold, probabilities, offset, count, which, factor, order, codes, mass)
        first, last = ends[s], ends[s] + used
        if last > room:
            room = 2 * last
            grown_codes, grown_mass = np.empty((room, num_factors), dtype=np.uint8), np.empty(room)
            grown_codes[:first], grown_mass[:first] = all_codes[:first], all_mass[:first]
            all_codes, all_mass = grown_codes, grown_mass
        total = 0.0
        for b in range(used):
            total += mass[b]
        for b in range(used):
            for i in range(num_factors):
                all_codes[first + b, i] = codes[b, i]
            all_mass[first + b] = mass[b] / total
        ends[s + 1] = last
    return ends, all_codes[: ends[-1]], all_mass[: ends[-1]]


def successors(
    model: PackedModel, codes: np.ndarray, actions: np.ndarray, threshold: float = 1e-4
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Successor codes of each (code, action), those more probable than `threshold`, with mass rescaled to 1.

    Args:
        model: the packed forward model.
        codes: int [S, N].
        actions: int [S].
        threshold: in [0, 1); an expansion ends where a branch becomes less probable than this.

    Returns:
        `ends` int64 [S + 1], successor codes uint8 [T, N] and their probabilities float64 [T]; those of entry s
        are `ends[s]:ends[s + 1]`.
    """
    return _expand_all(
        np.ascontiguousarray(codes, dtype=np.int64), np.ascontiguousarray(actions, dtype=np.int64), threshold,
        model.probabilities, model.offset, model.count, model.which, model.factor, model.order, CAPACITY,
    )  # fmt: skip


def most_probable(model: PackedModel, codes: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """The most probable successor of each (code, action): uint8 [S, N]."""
    ends, then, mass = successors(model, codes, actions)
    best = np.array([first + mass[first:last].argmax() for first, last in pairwise(ends)])
    return then[best.astype(np.int64)] if len(best) else np.zeros((0, model.num_factors), np.uint8)
