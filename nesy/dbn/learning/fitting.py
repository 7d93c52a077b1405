"""2DBNs fitted to experience or to any p(x' | x, a): parents by a score, rows by counting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nesy.dbn.learning.extraction import Marginals, marginals, with_counts
from nesy.dbn.learning.structure import Search, learn_parents
from nesy.dbn.model import TwoSliceDBN, topological_order
from nesy.dbn.rows import unique_rows
from nesy.errors import UserError


def from_experience(
    codes: np.ndarray,
    actions: np.ndarray,
    next_codes: np.ndarray,
    *,
    num_values: int,
    num_actions: int | None = None,
    weights: np.ndarray | None = None,
    search: Search | None = None,
    prior_count: float = 1.0,
    **described: Any,
) -> TwoSliceDBN:
    """Count a 2DBN from transitions.

    Args:
        codes: uint8 [n, N].
        actions: integers [n].
        next_codes: uint8 [n, N].
        num_values: K.
        num_actions: A; by default the largest action met, plus one.
        weights: int64 [n], how often each transition was met; once each by default.
        search: how parents are chosen; by default BDeu, up to 4 parents from slice t and 1 from slice t+1.
        prior_count: transitions that each row's prior counts as; the prior is the factor's distribution under
            the action, so a row never met is that.
        described: `action_names`, `factor_names`, `initial_codes`, `meanings`, `provenance` as in `extract`.

    Raises:
        UserError: no transitions, or an unknown score.
    """
    search = search or Search(max_next=1)
    codes, next_codes = np.asarray(codes), np.asarray(next_codes)
    often = np.ones(len(codes), dtype=np.int64) if weights is None else weights
    _check(codes, num_values)
    number = num_actions or int(np.max(actions)) + 1
    n = codes.shape[1]
    eye = np.eye(num_values)
    parents: list[list[tuple[int, ...]]] = []
    tables: list[list[np.ndarray]] = []
    for a in range(number):
        here = np.asarray(actions) == a
        both = np.column_stack([codes, next_codes])[here]
        first, index, _ = unique_rows(both)
        kinds, visits = both[first], np.bincount(index, often[here], len(first))
        parents.append([])
        tables.append([])
        for i in range(n):
            # within slice t+1 the order is that of the factors: factor i may look at those before it
            columns = kinds[:, : n + i]
            child = eye[kinds[:, n + i]]
            chosen = learn_parents(columns, child, visits, num_values, (n, n + i), search)
            parents[-1].append(chosen)
            tables[-1].append(_count(columns[:, list(chosen)], child, visits, num_values, prior_count))
    taken = (codes, np.asarray(actions), next_codes, often)
    return _assemble(tables, parents, n, taken, num_values, described)


def from_callable(
    predict: Marginals,
    codes: np.ndarray,
    actions: np.ndarray,
    next_codes: np.ndarray,
    *,
    num_values: int,
    weights: np.ndarray | None = None,
    search: Search | None = None,
    prior_count: float = 1e-3,
    action_names: Sequence[str] | None = None,
    num_actions: int | None = None,
    **described: Any,
) -> TwoSliceDBN:
    """Fit a 2DBN to p(x'_i | x, a), weighted by how often codes are met.

    The next factors are taken to be independent given the code, as such networks predict them. A row is the mean of
    the network's predictions over the codes met that fit it; a row that no code fits is the mean over all codes.

    Args:
        predict: the network.
        codes: uint8 [n, N], codes met in experience.
        actions: integers [n], what was done there (for the counts).
        next_codes: uint8 [n, N] (for the counts).
        num_values: K.
        weights: int64 [n], how often each transition was met; once each by default.
        search: how parents are chosen; by default BDeu and up to 4 parents.
        prior_count: transitions that each row's prior counts as.
        action_names: A names.
        num_actions: A, where there are no names.
        described: `factor_names`, `initial_codes`, `meanings`, `provenance` as in `extract`.

    Raises:
        UserError: no transitions, or an unknown score.
    """
    search = search or Search()
    _check(np.asarray(codes), num_values)
    often = np.ones(len(codes), dtype=np.int64) if weights is None else weights
    first, index, _ = unique_rows(codes)
    kinds, visits = np.asarray(codes)[first], np.bincount(index, often)
    n = kinds.shape[1]
    number = len(action_names) if action_names is not None else num_actions or int(np.max(actions)) + 1
    parents: list[list[tuple[int, ...]]] = []
    tables: list[list[np.ndarray]] = []
    for a in range(number):
        predicted = predict(kinds, a)
        parents.append([])
        tables.append([])
        for i in range(n):
            child = predicted[:, i] / predicted[:, i].sum(axis=1, keepdims=True)
            chosen = learn_parents(kinds, child, visits, num_values, (n, n), search)
            parents[-1].append(chosen)
            tables[-1].append(_count(kinds[:, list(chosen)], child, visits, num_values, prior_count))
    described["action_names"] = action_names
    taken = (np.asarray(codes), np.asarray(actions), np.asarray(next_codes), often)
    return _assemble(tables, parents, n, taken, num_values, described)


def _check(codes: np.ndarray, num_values: int) -> None:
    if codes.ndim != 2 or not len(codes):
        raise UserError("a 2DBN needs at least one transition to be counted from")
    if codes.max() >= num_values:
        raise UserError(f"the codes hold the value {codes.max()}; the values are 0 to {num_values - 1}")


def _count(
    values: np.ndarray, child: np.ndarray, weights: np.ndarray, num_values: int, prior_count: float
) -> np.ndarray:
    """Table float64 [rows, K] of counted distributions, with a Dirichlet prior around the mean row."""
    rows = num_values ** values.shape[1]
    row = np.zeros(len(values), dtype=np.int64)
    for column in range(values.shape[1]):
        row = row * num_values + values[:, column]
    counts = np.stack([np.bincount(row, weights * child[:, k], rows) for k in range(num_values)], axis=1)
    total = counts.sum()
    mean = counts.sum(axis=0) / total if total > 0 else np.full(num_values, 1.0 / num_values)
    table = counts + prior_count * mean
    empty = table.sum(axis=1) == 0
    table[empty] = mean
    return np.asarray(table / table.sum(axis=1, keepdims=True))


def _assemble(
    tables: list[list[np.ndarray]],
    parents: list[list[tuple[int, ...]]],
    num_factors: int,
    taken: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    num_values: int,
    described: dict[str, Any],
) -> TwoSliceDBN:
    later = tuple(tuple(tuple(p - num_factors for p in ps if p >= num_factors) for ps in row) for row in parents)
    initial = described.get("initial_codes")
    dbn = TwoSliceDBN.from_tables(
        tables,
        [[[p for p in ps if p < num_factors] for ps in row] for row in parents],
        later,
        order=topological_order(later, num_factors),
        action_names=described.get("action_names"),
        factor_names=described.get("factor_names"),
        initial=None if initial is None else marginals(initial, num_values),
        value_meanings=described.get("meanings", ()),
        provenance=described.get("provenance"),
    )
    return with_counts(dbn, *taken)
