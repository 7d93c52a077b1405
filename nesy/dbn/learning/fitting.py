"""2DBNs fitted to experience or to any p(x' | x, a): parents by a score, rows by counting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from nesy.dbn.learning.checked_steps import Steps
from nesy.dbn.learning.structure import Search, learn_parents
from nesy.dbn.learning.transitions import Marginals, marginals, with_counts
from nesy.dbn.model import TwoSliceDBN, topological_order
from nesy.dbn.rows import unique_rows


def from_experience(
    codes: ArrayLike,
    actions: ArrayLike,
    next_codes: ArrayLike,
    *,
    num_values: int,
    num_actions: int | None = None,
    weights: ArrayLike | None = None,
    search: Search | None = None,
    prior_count: float = 1.0,
    action_names: Sequence[str] | None = None,
    factor_names: Sequence[str] | None = None,
    initial_codes: ArrayLike | None = None,
    meanings: Sequence[Sequence[str]] = (),
    provenance: dict[str, Any] | None = None,
) -> TwoSliceDBN:
    """Count a 2DBN from transitions, each as often as it was met.

    Columns may be arrays, lists or data frames of whole numbers (see `Steps.of`). An action that was never taken has
    rows never met: each factor's distribution under all actions together, with a count of 0.

    Args:
        codes: integers [n, N], values 0 to K - 1.
        actions: integers [n], or names of `action_names`.
        next_codes: integers [n, N].
        num_values: K.
        num_actions: A; by default as many as there are names, or the largest action met, plus one.
        weights: integers [n], how often each transition was met; once each by default.
        search: how parents are chosen; by default BDeu, up to 4 parents from slice t and 1 from slice t+1.
        prior_count: transitions that each row's prior counts as; the prior is the factor's distribution under
            the action, so a row never met is that.
        action_names: A names.
        factor_names: N names; `X0`, `X1`, ... by default.
        initial_codes: integers [m, N], codes at the start of episodes; the initial distribution is theirs.
        meanings: [N][K] texts.
        provenance: where the model comes from, JSON values.

    Raises:
        UserError: no transitions, columns that are none of a 2DBN of these sizes, or an unknown score.
    """
    steps = Steps.of(
        codes, actions, next_codes, weights, num_values=num_values, num_actions=num_actions, action_names=action_names
    )
    search = search or Search(max_next=1)
    n, k = steps.codes.shape[1], steps.num_values
    everywhere = [np.bincount(column, steps.weights, k) for column in steps.next_codes.T]
    parents: list[list[tuple[int, ...]]] = []
    tables: list[list[np.ndarray]] = []
    for a in range(steps.num_actions):
        before, after, often = steps.under(a)
        both = np.column_stack([before, after])
        first, index, _ = unique_rows(both)
        kinds, visits = both[first], np.bincount(index, often, len(first))
        parents.append([])
        tables.append([])
        for i in range(n):
            # within slice t+1 the order is that of the factors: factor i may look at those before it
            columns = kinds[:, : n + i]
            child = _certain(kinds[:, n + i], k)
            chosen = learn_parents(columns, child, visits, k, (n, n + i), search)
            parents[-1].append(chosen)
            tables[-1].append(_count(columns[:, list(chosen)], child, visits, k, prior_count, everywhere[i]))
    described = _Described(action_names, factor_names, initial_codes, meanings, provenance)
    return _assemble(tables, parents, steps, described)


def from_callable(
    predict: Marginals,
    codes: ArrayLike,
    actions: ArrayLike,
    next_codes: ArrayLike,
    *,
    num_values: int,
    num_actions: int | None = None,
    weights: ArrayLike | None = None,
    search: Search | None = None,
    prior_count: float = 1e-3,
    action_names: Sequence[str] | None = None,
    factor_names: Sequence[str] | None = None,
    initial_codes: ArrayLike | None = None,
    meanings: Sequence[Sequence[str]] = (),
    provenance: dict[str, Any] | None = None,
) -> TwoSliceDBN:
    """Fit a 2DBN to p(x'_i | x, a), weighted by how often codes are met.

    The next factors are taken to be independent given the code, as such networks predict them. A row is the mean of
    the network's predictions over the codes met that fit it; a row that no code fits is the mean over all codes.

    Args:
        predict: the network.
        codes: integers [n, N], codes met in experience.
        actions: integers [n], what was done there (for the counts), or names of `action_names`.
        next_codes: integers [n, N] (for the counts).
        num_values: K.
        num_actions: A; by default as many as there are names, or the largest action met, plus one.
        weights: integers [n], how often each transition was met; once each by default.
        search: how parents are chosen; by default BDeu and up to 4 parents.
        prior_count: transitions that each row's prior counts as.
        action_names: A names.
        factor_names: N names; `X0`, `X1`, ... by default.
        initial_codes: integers [m, N], codes at the start of episodes; the initial distribution is theirs.
        meanings: [N][K] texts.
        provenance: where the model comes from, JSON values.

    Raises:
        UserError: as `from_experience`.
    """
    steps = Steps.of(
        codes, actions, next_codes, weights, num_values=num_values, num_actions=num_actions, action_names=action_names
    )
    search = search or Search()
    first, index, _ = unique_rows(steps.codes)
    kinds, visits = steps.codes[first], np.bincount(index, steps.weights)
    n = kinds.shape[1]
    parents: list[list[tuple[int, ...]]] = []
    tables: list[list[np.ndarray]] = []
    for a in range(steps.num_actions):
        predicted = predict(kinds, a)
        parents.append([])
        tables.append([])
        for i in range(n):
            child = predicted[:, i] / predicted[:, i].sum(axis=1, keepdims=True)
            chosen = learn_parents(kinds, child, visits, num_values, (n, n), search)
            parents[-1].append(chosen)
            tables[-1].append(_count(kinds[:, list(chosen)], child, visits, num_values, prior_count))
    described = _Described(action_names, factor_names, initial_codes, meanings, provenance)
    return _assemble(tables, parents, steps, described)


def _certain(values: np.ndarray, num_values: int) -> np.ndarray:
    """Distributions float64 [n, K] that are certain of values [n]."""
    rows = np.zeros((len(values), num_values))
    rows[np.arange(len(values)), values] = 1.0
    return rows


def _count(
    values: np.ndarray,
    child: np.ndarray,
    weights: np.ndarray,
    num_values: int,
    prior_count: float,
    otherwise: np.ndarray | None = None,
) -> np.ndarray:
    """Table float64 [rows, K] of counted distributions, with a Dirichlet prior around the mean row.

    Without any transition every row is that of the counts `otherwise` [K].
    """
    rows = num_values ** values.shape[1]
    row = np.zeros(len(values), dtype=np.int64)
    for column in range(values.shape[1]):
        row = row * num_values + values[:, column]
    counts = np.stack([np.bincount(row, weights * child[:, k], rows) for k in range(num_values)], axis=1)
    known = counts.sum(axis=0) if counts.any() or otherwise is None else otherwise
    total = known.sum()
    mean = known / total if total > 0 else np.full(num_values, 1.0 / num_values)
    table = counts + prior_count * mean
    empty = table.sum(axis=1) == 0
    table[empty] = mean
    return np.asarray(table / table.sum(axis=1, keepdims=True))


class _Described(NamedTuple):
    """What a caller says of a model."""

    action_names: Sequence[str] | None
    factor_names: Sequence[str] | None
    initial_codes: ArrayLike | None
    meanings: Sequence[Sequence[str]]
    provenance: dict[str, Any] | None


def _assemble(
    tables: list[list[np.ndarray]], parents: list[list[tuple[int, ...]]], steps: Steps, described: _Described
) -> TwoSliceDBN:
    num_factors, initial = steps.codes.shape[1], described.initial_codes
    later = tuple(tuple(tuple(p - num_factors for p in ps if p >= num_factors) for ps in row) for row in parents)
    dbn = TwoSliceDBN.from_tables(
        tables,
        [[[p for p in ps if p < num_factors] for ps in row] for row in parents],
        later,
        order=topological_order(later, num_factors),
        action_names=described.action_names,
        factor_names=described.factor_names,
        initial=None if initial is None else marginals(initial, steps.num_values, num_factors),
        value_meanings=described.meanings,
        provenance=described.provenance,
    )
    return with_counts(dbn, steps.codes, steps.actions, steps.next_codes, steps.weights)
