"""Exact inference in the 2DBN by variable elimination.

Beliefs are products of marginals, float [N, K]. One step from such a belief is computed exactly, including
the arcs within slice t+1; only the next belief's factorisation is an approximation when steps are chained
(Boyen and Koller 1998). `plan_marginals` chains steps exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.dbn.inference.reachable import ancestors, reachable_values
from nesy.errors import UserError

if TYPE_CHECKING:
    from nesy.dbn.model import TwoSliceDBN

Potential = tuple[tuple[int, ...], np.ndarray]
"""Variables and a table with one axis per variable."""

MAX_ENTRIES = 1 << 26


def predict(dbn: TwoSliceDBN, belief: np.ndarray, action: int) -> np.ndarray:
    """Exact marginals of the next factors.

    Args:
        dbn: the model.
        belief: [N, K], rows sum to 1: the factors' independent distributions now.
        action: the action.

    Returns:
        float64 [N, K].

    Raises:
        UserError: a wrong shape or action, or a model too densely connected for exact inference.
    """
    belief = check_belief(dbn, belief)
    action = dbn.action_index(action)
    supports = [np.flatnonzero(row) for row in belief]
    result = np.empty(belief.shape)
    for i in range(dbn.num_factors):
        potentials = _step(dbn, belief, supports, action, ancestors(dbn, action, (i,)))
        result[i] = contract(potentials, (dbn.num_factors + i,))
    return result / result.sum(axis=1, keepdims=True)


def update(dbn: TwoSliceDBN, belief: np.ndarray, action: int, likelihood: np.ndarray) -> np.ndarray:
    """Exact posterior marginals after an action and an observation with independent likelihoods per factor.

    An observation that the model holds impossible must not leave the filter without a belief: then the
    observation is believed (its normalised likelihood), and where that is zero as well, the prediction.

    Args:
        dbn: the model.
        belief: [N, K], rows sum to 1.
        action: the action.
        likelihood: [N, K] >= 0, P(observation | X'_i = k) up to a factor.

    Returns:
        float64 [N, K], rows sum to 1.

    Raises:
        UserError: a wrong shape or action, or a model too densely connected for exact inference.
    """
    belief = check_belief(dbn, belief)
    action = dbn.action_index(action)
    likelihood = np.asarray(likelihood, dtype=np.float64)
    if likelihood.shape != belief.shape or not (likelihood >= 0).all():
        raise UserError(f"a likelihood has the shape {list(belief.shape)} and no negative entries")
    supports = [np.flatnonzero(row) for row in belief]
    # a constant likelihood says nothing: its factor is left out unless another one needs it
    informative = tuple(i for i in range(dbn.num_factors) if np.ptp(likelihood[i]) > 0)
    n = dbn.num_factors
    result = np.empty(belief.shape)
    for i in range(n):
        potentials = _step(dbn, belief, supports, action, ancestors(dbn, action, (*informative, i)))
        potentials += [((n + j,), likelihood[j]) for j in informative]
        result[i] = contract(potentials, (n + i,))
    totals = result.sum(axis=1, keepdims=True)
    if (totals > 0).all() and all(likelihood[i].any() for i in range(n)):
        return result / totals
    sums = likelihood.sum(axis=1, keepdims=True)
    return np.where(sums > 0, likelihood / np.where(sums > 0, sums, 1.0), predict(dbn, belief, action))


def plan_marginals(
    dbn: TwoSliceDBN,
    start: np.ndarray,
    plan: Sequence[int],
    factors: Sequence[int],
    evidence: dict[tuple[int, int], int] | None = None,
) -> np.ndarray:
    """Exact joint distribution of some factors after a plan, by elimination over the unrolled network.

    Args:
        dbn: the model.
        start: a code, integers [N], or a belief, float [N, K].
        plan: the actions, T of them.
        factors: the factors asked for in slice T, F of them.
        evidence: values of further variables, {(slice, factor): value}, slice 1..T; the result is then
            the joint probability with the evidence.

    Returns:
        float64 [K] * F; sums to 1 without evidence.

    Raises:
        UserError: a wrong shape or action, or a model too densely connected for exact inference.
    """
    n, k = dbn.num_factors, dbn.num_values
    start = np.asarray(start)
    belief = check_belief(dbn, np.eye(k)[dbn._codes(start)] if start.ndim == 1 else start)
    plan = dbn.action_indices(plan).tolist()
    evidence = evidence or {}
    needed: list[set[int]] = [set() for _ in range(len(plan) + 1)]
    needed[-1] = set(factors)
    for step, factor in evidence:
        needed[step].add(factor)
    for step in range(len(plan), 0, -1):
        needed[step] = set(ancestors(dbn, plan[step - 1], tuple(needed[step])))
        needed[step - 1] |= {p for i in needed[step] for p in dbn.parents_now[plan[step - 1]][i]}
    # values that the start rules out are cut away: from a code, slice 0 disappears altogether
    values = reachable_values(dbn, belief, plan)
    for (step, factor), value in evidence.items():
        values[step] = tuple(np.intersect1d(v, [value]) if i == factor else v for i, v in enumerate(values[step]))
    result = np.zeros((k,) * len(factors))
    if any(not len(values[step][i]) for step, i in evidence):
        return result
    potentials: list[Potential] = [((i,), belief[i][values[0][i]]) for i in sorted(needed[0])]
    for step, action in enumerate(plan):
        for i in sorted(needed[step + 1]):
            parents = dbn.parents(action, i)
            index = np.ix_(*(values[step + where][p] for where, p in parents), values[step + 1][i])
            scope = tuple((step + where) * n + p for where, p in parents) + ((step + 1) * n + i,)
            potentials.append((scope, dbn.tensor(action, i)[index]))
    place = np.ix_(*(values[-1][i] for i in factors))
    result[place] = contract(potentials, tuple(len(plan) * n + i for i in factors))
    return result


def joint_next(dbn: TwoSliceDBN, code: np.ndarray, action: int, drop: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """All next codes of one code with their probabilities, most probable first.

    Args:
        dbn: the model.
        code: integers [N].
        action: the action.
        drop: branches whose probability so far is at most this are cut; 0 keeps everything possible.

    Returns:
        uint8 [M, N] and float64 [M]; the probabilities sum to 1 less the mass that was cut.

    Raises:
        UserError: there are more than 4 million of them.
    """
    now = dbn._codes(code)
    action = dbn.action_index(action)
    later = np.zeros((1, dbn.num_factors), dtype=np.int64)
    weights = np.ones(1)
    for i in dbn.order:
        rows = dbn.rows(action, i, np.broadcast_to(now, later.shape), later)
        branches = weights[:, None] * dbn.cpt(action, i)[rows]
        kept, values = np.nonzero(branches > drop)
        if len(kept) > 1 << 22:
            raise UserError("more than 4 million next codes; raise `drop` or ask for marginals")
        later = later[kept]
        later[:, i] = values
        weights = branches[kept, values]
    best_first = np.argsort(-weights, kind="stable")
    return later[best_first].astype(dbn.code_type), weights[best_first]


def likely_next(dbn: TwoSliceDBN, codes: np.ndarray, action: int, beam: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """The most probable next codes of every code, by beam search over the factors in `order`.

    Exact where a code has at most `beam` next codes, or the next factors are independent given slice t and
    `beam` is 1; otherwise a candidate that is improbable for long may be lost (the probabilities are exact).

    Args:
        dbn: the model.
        codes: integers [B, N].
        action: the action.
        beam: how many candidates are kept.

    Returns:
        uint8 [B, W, N] with W <= beam, most probable first, and their probabilities float64 [B, W].
    """
    now = dbn._codes(codes)
    action = dbn.action_index(action)
    later = np.zeros((len(now), 1, dbn.num_factors), dtype=np.int64)
    weights = np.ones((len(now), 1))
    row_number = np.arange(len(now))[:, None]
    for i in dbn.order:
        before = np.broadcast_to(now[:, None], later.shape)
        branches = (weights[:, :, None] * dbn.cpt(action, i)[dbn.rows(action, i, before, later)]).reshape(len(now), -1)
        width = min(beam, branches.shape[1])
        # stable, so that of equally probable candidates the one with smaller values comes first
        best = np.argsort(-branches, axis=1, kind="stable")[:, :width]
        later = later[row_number, best // dbn.num_values]
        later[:, :, i] = best % dbn.num_values
        weights = branches[row_number, best]
    return later.astype(dbn.code_type), weights


def most_probable_next(
    dbn: TwoSliceDBN, codes: np.ndarray, action: int, beam: int = 16
) -> tuple[np.ndarray, np.ndarray]:
    """The most probable next code of every code (see `likely_next`).

    Returns:
        uint8 [B, N] and the probability of each, float64 [B].
    """
    later, weights = likely_next(dbn, codes, action, beam)
    return later[:, 0], weights[:, 0]


def contract(potentials: Sequence[Potential], keep: tuple[int, ...]) -> np.ndarray:
    """Multiply the potentials and sum out every variable but `keep`, in a greedily chosen order.

    Returns:
        A table with the axes of `keep`.

    Raises:
        UserError: an intermediate table would have more than `MAX_ENTRIES` entries.
    """
    pool = list(potentials)
    sizes = {v: table.shape[axis] for scope, table in pool for axis, v in enumerate(scope)}
    waiting = set(sizes) - set(keep)
    while waiting:
        variable = min(waiting, key=lambda v: (_union_size(pool, v, sizes), v))
        chosen = [p for p in pool if variable in p[0]]
        pool = [p for p in pool if variable not in p[0]]
        scope = tuple(sorted({v for s, _ in chosen for v in s} - {variable}))
        pool.append((scope, _product(chosen, scope, sizes)))
        waiting.remove(variable)
    return _product(pool, keep, sizes)


def _union_size(pool: Sequence[Potential], variable: int, sizes: dict[int, int]) -> int:
    size = 1
    for v in {v for scope, _ in pool if variable in scope for v in scope}:
        size *= sizes[v]
    return size


def _product(chosen: Sequence[Potential], scope: tuple[int, ...], sizes: dict[int, int]) -> np.ndarray:
    entries = 1
    for v in {v for s, _ in chosen for v in s}:
        entries *= sizes[v]
    if entries > MAX_ENTRIES:
        raise UserError(
            f"exact inference would need a table of {entries} entries: this model is too densely connected; "
            "use the particle filter or sampling"
        )
    # einsum takes labels below 52 only
    labels = {v: label for label, v in enumerate(sorted({v for s, _ in chosen for v in s}))}
    operands: list[Any] = []
    for s, table in sorted(chosen, key=lambda p: p[1].size):
        operands += [table, [labels[v] for v in s]]
    return np.asarray(np.einsum(*operands, [labels[v] for v in scope], optimize=len(chosen) > 2))


def _step(
    dbn: TwoSliceDBN, belief: np.ndarray, supports: list[np.ndarray], action: int, factors: tuple[int, ...]
) -> list[Potential]:
    """Potentials of one step for some factors of slice t+1; variables 0..N-1 now, N..2N-1 next."""
    n = dbn.num_factors
    full = np.arange(dbn.num_values)
    potentials: list[Potential] = []
    used: set[int] = set()
    for i in factors:
        parents = dbn.parents(action, i)
        index = np.ix_(*(supports[p] if where == 0 else full for where, p in parents), full)
        potentials.append((tuple(where * n + p for where, p in parents) + (n + i,), dbn.tensor(action, i)[index]))
        used |= set(dbn.parents_now[action][i])
    return potentials + [((p,), belief[p][supports[p]]) for p in sorted(used)]


def check_belief(dbn: TwoSliceDBN, belief: np.ndarray) -> np.ndarray:
    """The belief as float64 [N, K] with rows that sum to 1.

    Raises:
        UserError: it is no belief of this model.
    """
    result = np.asarray(belief, dtype=np.float64)
    if result.shape != (dbn.num_factors, dbn.num_values):
        raise UserError(f"a belief has the shape [{dbn.num_factors}, {dbn.num_values}], found {list(result.shape)}")
    sums = result.sum(axis=1, keepdims=True)
    if not ((result >= 0).all() and np.abs(sums - 1).max() <= 1e-3):
        raise UserError("each row of a belief is a probability distribution (numbers >= 0 that sum to 1)")
    return np.asarray(result / sums)
