"""Transitions in codes, and what learning counts of them; what a network of conditionals offers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from nesy.checked_arrays import integers
from nesy.dbn.codebook import distinct_views
from nesy.dbn.learning.checked_steps import Steps
from nesy.dbn.model import Parents, TwoSliceDBN
from nesy.dbn.rows import unique_rows
from nesy.errors import UserError

Marginals = Callable[[np.ndarray, int], np.ndarray]
"""Codes uint8 [n, N] and an action -> marginals of the next factors, float64 [n, N, K]."""


class Structure(Protocol):
    """Who depends on whom, in the words of `TwoSliceDBN`."""

    @property
    def parents_now(self) -> Parents:
        """[a][i]: parents in slice t."""
        ...

    @property
    def parents_next(self) -> Parents:
        """[a][i]: parents in slice t+1."""
        ...

    @property
    def order(self) -> tuple[int, ...]:
        """The order in which the factors of slice t+1 are decided."""
        ...


@runtime_checkable
class Conditionals(Protocol):
    """A network that decides each next factor from few parents."""

    def structure(self) -> Structure:
        """Who depends on whom."""
        ...

    def conditional(self, action: int, factor: int) -> np.ndarray:
        """One conditional, float64 [rows, K]: parents of slice t first, first parent most significant."""
        ...


class Transitions:
    """Experience in codes.

    Attributes: `codes`, `next_codes` uint8 [n, N]; `actions` int64 [n]; `views` uint8 [V, v, v] distinct
    views met, `view_codes` uint8 [V, N], `view_counts` int64 [V]; `view_index`, `next_view_index` int64 [n].
    """

    def __init__(self, views: np.ndarray, actions: np.ndarray, next_views: np.ndarray, encode_views: Any) -> None:
        both = np.concatenate([views, next_views])
        self.views, index, self.view_counts = distinct_views(both)
        self.view_codes = np.asarray(encode_views(self.views), dtype=np.uint8)
        self.view_index, self.next_view_index = index[: len(views)], index[len(views) :]
        self.codes = self.view_codes[self.view_index]
        self.next_codes = self.view_codes[self.next_view_index]
        self.actions = np.asarray(actions, dtype=np.int64)

    def distinct(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Distinct transitions: codes uint8 [D, N], actions int64 [D], next codes uint8 [D, N], counts int64 [D]."""
        codes, actions, next_codes, index = self.numbered()
        return codes, actions, next_codes, np.bincount(index)

    def numbered(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Distinct transitions as in `distinct`, and which of them every transition is, int64 [n]."""
        first, code_of_view, _ = unique_rows(self.view_codes)
        codes, number = self.view_codes[first], len(first)
        base = int(self.actions.max(initial=0)) + 1
        key = (code_of_view[self.view_index] * base + self.actions) * number + code_of_view[self.next_view_index]
        kinds, index = _numbered(key, number * base * number)
        before, after = kinds // number, kinds % number
        return codes[before // base], before % base, codes[after], index


def _numbered(keys: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Distinct keys in order, and the number of each; without sorting where their limit allows it."""
    if limit > 1 << 24:
        kinds, index = np.unique(keys, return_inverse=True)
        return kinds, index.reshape(-1)
    met = np.zeros(limit, dtype=bool)
    met[keys] = True
    kinds = np.flatnonzero(met)
    rank = np.zeros(limit, dtype=np.int64)
    rank[kinds] = np.arange(len(kinds))
    return kinds, rank[keys]


def with_counts(
    dbn: TwoSliceDBN,
    codes: np.ndarray,
    actions: np.ndarray,
    next_codes: np.ndarray,
    weights: np.ndarray | None = None,
) -> TwoSliceDBN:
    """The same model with the number of the given transitions behind every row.

    Also sets the tables `codes` [C, N] (of `code_type`), the distinct codes met, `taken` int64 [A], how often each
    action was taken, and `changed` int64 [A, N], in how many of its transitions each factor changed its value.

    Raises:
        UserError: the transitions are none of this model.
    """
    steps = Steps.of(codes, actions, next_codes, weights, num_values=dbn.num_values, action_names=dbn.action_names)
    if steps.codes.shape[1] != dbn.num_factors:
        raise UserError(f"a code of this model has {dbn.num_factors} factors, not {steps.codes.shape[1]}")
    counts = np.zeros(len(dbn.probabilities), dtype=np.int64)
    taken = np.zeros(dbn.num_actions, dtype=np.int64)
    changed = np.zeros((dbn.num_actions, dbn.num_factors), dtype=np.int64)
    for a in range(dbn.num_actions):
        before, after, often = steps.under(a)
        now, later = before.astype(np.int64), after.astype(np.int64)
        taken[a] = often.sum()
        changed[a] = often @ (now != later)
        for i in range(dbn.num_factors):
            start = dbn.offsets[a, i]
            rows = dbn.num_rows(a, i)
            # weights are far below 2^53, so the floats that bincount adds up are exact
            counts[start : start + rows] = np.bincount(dbn.rows(a, i, now, later), weights=often, minlength=rows)
    every = np.concatenate([steps.codes, steps.next_codes])
    met = every[unique_rows(every)[0]]
    tables = {**dbn.tables, "codes": met, "taken": taken, "changed": changed}
    return replace(dbn, row_counts=counts, tables=tables)


def marginals(codes: ArrayLike, num_values: int, num_factors: int) -> np.ndarray:
    """The marginal distribution of every factor over some codes [m, N]: float64 [N, K]."""
    known = integers(codes, "initial codes", (None, num_factors), num_values)
    if not len(known):
        raise UserError("no codes to take an initial distribution from")
    return np.stack([np.bincount(column, minlength=num_values) / len(known) for column in known.T])
