"""Observation, reward and termination of a model, counted from experience; parents are chosen by score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from nesy.checked_arrays import integers
from nesy.dbn.codebook import Codebook
from nesy.dbn.learning.checked_steps import Steps
from nesy.dbn.learning.structure import Candidates, Search, learn_parents
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.rows import distinct_values
from nesy.dbn.step_tables import MAX_ENTRIES, Parents, StepTable
from nesy.errors import UserError

OBSERVATION = Search(max_parents=4, exhaustive=2)
STEPS = Search(max_parents=4, max_next=4, exhaustive=2, both=True, lean=True)
PRIOR = 1e-3
"""Observations that the mean of a table counts as in each of its rows."""
LEVELS = 8
"""So many levels of reward are told apart when parents are chosen; the rows hold exact means."""


def with_observation(dbn: TwoSliceDBN, codebook: Codebook, search: Search = OBSERVATION) -> TwoSliceDBN:
    """The model with P(cell | code) for every cell of a view, counted from the views met.

    Raises:
        UserError: the codebook is of another model.
    """
    integers(codebook.codes, "codes of the codebook", (None, dbn.num_factors), dbn.num_values)
    flat = codebook.views.reshape(len(codebook), -1)
    kinds = len(codebook.cell_kinds)
    weights = np.maximum(codebook.counts, 1).astype(np.float64)
    n, k = codebook.codes.shape[1], dbn.num_values
    parents, rows, counts = [], [], []
    candidates = Candidates(codebook.codes)
    for cell in flat.T:
        child = np.eye(kinds)[cell]
        chosen = learn_parents(candidates, child, weights, k, (n, n), search)
        parents.append(chosen)
        table, met = _rows(codebook.codes[:, list(chosen)], weights[:, None] * child, k)
        rows.append((table + PRIOR * table.sum(axis=0) / table.sum()) / (met + PRIOR)[:, None])
        counts.append(met)
    _, width, height = codebook.views.shape
    observation = StepTable(
        targets=tuple(f"cell_{x}_{y}" for x in range(width) for y in range(height)),
        outcomes=codebook.cell_kinds,
        num_values=k,
        parents_now=(((),) * flat.shape[1],),
        parents_next=(tuple(parents),),
        values=np.concatenate(rows),
        row_counts=np.rint(np.concatenate(counts)).astype(np.int64),
    )
    return replace(dbn, step_tables={**dbn.step_tables, "observation": observation})


def with_outcomes(
    dbn: TwoSliceDBN,
    steps: Sequence[ArrayLike],
    kind: ArrayLike,
    rewards: ArrayLike,
    terminated: ArrayLike,
    search: Search = STEPS,
) -> TwoSliceDBN:
    """The model with the mean reward and the probability that the episode ends, given a step.

    Args:
        dbn: the model.
        steps: distinct steps: codes [D, N], actions [D], next codes [D, N].
        kind: int64 [n]: which of them each observation belongs to.
        rewards: float [n].
        terminated: bool [n].
        search: how parents are chosen; by default up to 4 from each slice, as far as the score rises, and every pair
            of the two slices is tried: an end may depend on two factors neither of which tells anything alone.

    Raises:
        UserError: the columns do not fit the model or each other.
    """
    codes, actions, next_codes, kind, rewards, terminated = _checked(dbn, steps, kind, rewards, terminated)
    number = len(actions)
    met = np.bincount(kind, minlength=number) > 0
    both = np.column_stack([codes, next_codes])[met]
    ended = _histogram(kind, terminated, 2, number)[met]
    sums = np.bincount(kind, weights=rewards, minlength=number)[met]
    levels = _histogram(kind, *_levels(rewards), number)[met]
    taken = actions[met]
    # the candidates are the same for both tables: what is computed of them alone is computed once
    candidates = [Candidates(both[taken == a]) for a in range(dbn.num_actions)]
    where = (both, taken, dbn, candidates)
    termination = _table(where, ("done",), ("goes_on", "ends"), ended, ended, search)
    moments = np.column_stack([sums, levels.sum(axis=1)])
    reward = _table(where, ("reward",), (), levels, moments, search)
    return replace(dbn, step_tables={**dbn.step_tables, "reward": reward, "termination": termination})


def _checked(
    dbn: TwoSliceDBN, steps: Sequence[ArrayLike], kind: ArrayLike, rewards: ArrayLike, terminated: ArrayLike
) -> tuple[np.ndarray, ...]:
    known = Steps.of(*steps, num_values=dbn.num_values, action_names=dbn.action_names)
    if known.codes.shape[1] != dbn.num_factors:
        raise UserError(f"a code of this model has {dbn.num_factors} factors, not {known.codes.shape[1]}")
    which = integers(kind, "kinds of steps", (None,), len(known.actions))
    if not len(which):
        raise UserError("no steps to learn rewards and ends from")
    ends = integers(terminated, "`terminated`", (len(which),), 2)
    try:
        gained = np.asarray(rewards, dtype=np.float64)
    except (TypeError, ValueError):
        gained = np.full(len(which), np.nan)
    if gained.shape != (len(which),) or not np.isfinite(gained).all():
        raise UserError(f"rewards must be {len(which)} finite numbers, one per step")
    return known.codes, known.actions, known.next_codes, which, gained, ends


def _levels(rewards: np.ndarray) -> tuple[np.ndarray, int]:
    """Every reward as one of a few levels, and how many there are: its own value, or a bin of equal shares."""
    distinct, index = distinct_values(rewards)
    if len(distinct) > LEVELS:
        counts = np.bincount(index).astype(float)
        common = int(counts.argmax())
        counts[common] = 0.0
        share = np.cumsum(counts) / counts.sum()
        bins = np.minimum((share * (LEVELS - 1)).astype(np.int64), LEVELS - 2)
        bins[common] = LEVELS - 1
        return bins[index], LEVELS
    return index, len(distinct)


def _histogram(kind: np.ndarray, outcome: np.ndarray, size: int, number: int) -> np.ndarray:
    return np.bincount(kind * size + outcome, minlength=number * size).reshape(number, size).astype(np.float64)


def _table(
    steps: tuple[np.ndarray, np.ndarray, TwoSliceDBN, list[Candidates]],
    targets: tuple[str, ...],
    outcomes: tuple[str, ...],
    histogram: np.ndarray,
    sums: np.ndarray,
    search: Search,
) -> StepTable:
    """One target per action: parents by the histogram's score; rows are shares of it, or means of (sum, count)."""
    both, action, dbn, candidates = steps
    n, k = dbn.num_factors, dbn.num_values
    parents: list[tuple[int, ...]] = []
    rows, counts = [], []
    whole = sums.sum(axis=0)
    room = MAX_ENTRIES // (dbn.num_actions * max(1, len(outcomes)))
    search = replace(search, max_rows=min(search.max_rows, room))
    for a in range(dbn.num_actions):
        here = action == a
        weights = histogram[here].sum(axis=1)
        child = histogram[here] / weights[:, None]
        varies = (histogram[here].sum(axis=0) > 0).sum() > 1
        chosen = learn_parents(candidates[a], child, weights, k, (n, 2 * n), search) if varies else ()
        parents.append(chosen)
        table, met = _rows(both[here][:, list(chosen)], sums[here], k)
        total = table.sum(axis=0) if here.any() else whole
        if outcomes:
            prior = total / total.sum()
            table, met = table + PRIOR * prior, table.sum(axis=1)
            rows.append(table / table.sum(axis=1, keepdims=True))
        else:
            mean, met = total[0] / max(total[1], 1.0), table[:, 1]
            rows.append((table[:, :1] + PRIOR * mean) / (table[:, 1:] + PRIOR))
        counts.append(met)
    return StepTable(
        targets=targets,
        outcomes=outcomes,
        num_values=k,
        parents_now=_slice(parents, 0, n),
        parents_next=_slice(parents, n, 2 * n),
        values=np.concatenate(rows),
        row_counts=np.rint(np.concatenate(counts)).astype(np.int64),
    )


def _slice(parents: Sequence[tuple[int, ...]], low: int, high: int) -> Parents:
    return tuple((tuple(p - low for p in ps if low <= p < high),) for ps in parents)


def _rows(values: np.ndarray, weights: np.ndarray, num_values: int) -> tuple[np.ndarray, np.ndarray]:
    """Sums of weights [n, M] by row of a table over `values` [n, P]: float64 [rows, M], and their totals [rows]."""
    row = np.zeros(len(values), dtype=np.int64)
    for column in values.T:
        row = row * num_values + column
    size = num_values ** values.shape[1]
    table = np.stack([np.bincount(row, column, size) for column in weights.T], axis=1)
    return table, table.sum(axis=1)
