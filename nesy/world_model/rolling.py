"""Distributions over codes, rolled through the forward model's tables for many starts at once.

A distribution is sparse: a list of (start, code, mass). It is exact up to branches less probable than a
threshold, which are dropped; what is left is rescaled to mass 1.
"""

from __future__ import annotations

import numpy as np

from nesy.world_model.codec import code_keys
from nesy.world_model.successors import PackedModel, successors

THRESHOLD = 1e-3


class Rollout:
    """Rolls sparse distributions; successors of a (code, action) are computed once and remembered."""

    def __init__(self, model: PackedModel, threshold: float = THRESHOLD) -> None:
        self.model, self.threshold = model, threshold
        self._keys = np.zeros(0, dtype=np.int64)  # sorted: code * A + action
        self._first = np.zeros(0, dtype=np.int64)
        self._count = np.zeros(0, dtype=np.int64)
        self._codes = np.zeros(0, dtype=np.int64)
        self._mass = np.zeros(0, dtype=np.float64)

    def codes(self, keys: np.ndarray) -> np.ndarray:
        """Codes uint8 [n, N] of code keys [n]."""
        powers = self.model.num_values ** np.arange(self.model.num_factors - 1, -1, -1)
        return (keys[:, None] // powers % self.model.num_values).astype(np.uint8)

    def keys(self, codes: np.ndarray) -> np.ndarray:
        """Code keys int64 [n] of codes [n, N]."""
        return code_keys(codes, self.model.num_values)

    def step(
        self, start: np.ndarray, code: np.ndarray, mass: np.ndarray, action: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One step of every distribution.

        Args:
            start: int64 [n], ascending: which distribution an entry belongs to.
            code: int64 [n] code keys.
            mass: float64 [n].
            action: int64 [n], the same for all entries of a start.

        Returns:
            `start`, `code`, `mass` after the step, sorted, entries distinct.
        """
        index = self._lookup(code * self.model.num_actions + action)
        first, count = self._first[index], self._count[index]
        entry = np.repeat(np.arange(len(code)), count)
        offset = np.arange(len(entry)) - np.repeat(np.cumsum(count) - count, count)
        successor = first[entry] + offset
        size = self.model.num_values**self.model.num_factors
        combined, place = np.unique(start[entry] * size + self._codes[successor], return_inverse=True)
        joint = np.bincount(place, mass[entry] * self._mass[successor], minlength=len(combined))
        return self.pruned(combined // size, combined % size, joint)

    def pruned(
        self, start: np.ndarray, code: np.ndarray, mass: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distributions without their least probable entries, rescaled to mass 1; each keeps its likeliest one."""
        total = np.bincount(start, mass)
        peak = np.zeros(len(total))
        np.maximum.at(peak, start, mass)
        kept = (mass > self.threshold * total[start]) | (mass == peak[start])
        start, code, mass = start[kept], code[kept], mass[kept]
        return start, code, mass / np.bincount(start, mass)[start]

    def _lookup(self, wanted: np.ndarray) -> np.ndarray:
        distinct = np.unique(wanted)
        new = distinct[~np.isin(distinct, self._keys, assume_unique=True)]
        if len(new):
            ends, codes, mass = successors(
                self.model, self.codes(new // self.model.num_actions), new % self.model.num_actions, self.threshold
            )
            keys = np.concatenate([self._keys, new])
            first = np.concatenate([self._first, ends[:-1] + len(self._codes)])
            count = np.concatenate([self._count, np.diff(ends)])
            order = np.argsort(keys)
            self._keys, self._first, self._count = keys[order], first[order], count[order]
            self._codes = np.concatenate([self._codes, self.keys(codes)])
            self._mass = np.concatenate([self._mass, mass])
        return np.searchsorted(self._keys, wanted)

    def spread(self, beliefs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The sparse joint distributions of factored beliefs [S, N, K]: `start`, `code`, `mass`."""
        start = np.arange(len(beliefs))
        code, mass = np.zeros(len(beliefs), dtype=np.int64), np.ones(len(beliefs))
        values = np.arange(self.model.num_values)
        for factor in range(self.model.num_factors):
            joint = (mass[:, None] * beliefs[start, factor]).reshape(-1)
            code = (code[:, None] * self.model.num_values + values).reshape(-1)
            kept = joint > self.threshold
            start, code, mass = np.repeat(start, len(values))[kept], code[kept], joint[kept]
        return self.pruned(start, code, mass)

    def marginals(self, start: np.ndarray, code: np.ndarray, mass: np.ndarray, size: int) -> np.ndarray:
        """Factored marginals float32 [size, N, K] of sparse distributions."""
        num_factors, num_values = self.model.num_factors, self.model.num_values
        cell = start[:, None] * num_factors + np.arange(num_factors)
        cell = cell * num_values + self.codes(code)
        total = np.bincount(cell.reshape(-1), np.repeat(mass, num_factors), minlength=size * num_factors * num_values)
        return total.reshape(size, num_factors, num_values).astype(np.float32)
