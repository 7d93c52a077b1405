"""Observation, reward and termination of a model, counted from experience; parents are chosen by score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nesy.dbn.codebook import Codebook
from nesy.dbn.learning.structure import Candidates, Search, learn_parents
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.rows import distinct_values
from nesy.dbn.step_tables import Parents, StepTable

OBSERVATION = Search(max_parents=4, exhaustive=2)
STEPS = Search(max_parents=4, max_next=1, exhaustive=1)
PRIOR = 1e-3
"""Observations that the mean of a table counts as in each of its rows."""
LEVELS = 8
"""So many levels of reward are told apart when parents are chosen; the rows hold exact means."""


def with_observation(dbn: TwoSliceDBN, codebook: Codebook, search: Search = OBSERVATION) -> TwoSliceDBN:
    """The model with P(cell | code) for every cell of a view, counted from the views met."""
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
    steps: Sequence[np.ndarray],
    kind: np.ndarray,
    rewards: np.ndarray,
    terminated: np.ndarray,
    search: Search = STEPS,
) -> TwoSliceDBN:
    """The model with the mean reward and the probability that the episode ends, given a step.

    Args:
        dbn: the model.
        steps: distinct steps: codes uint8 [D, N], actions integers [D], next codes uint8 [D, N].
        kind: int64 [n]: which of them each observation belongs to.
        rewards: float [n].
        terminated: bool [n].
        search: how parents are chosen.
    """
    codes, actions, next_codes = steps
    number = len(actions)
    met = np.bincount(kind, minlength=number) > 0
    both = np.column_stack([codes, next_codes])[met]
    ended = _histogram(kind, np.asarray(terminated, dtype=np.int64), 2, number)[met]
    sums = np.bincount(kind, weights=rewards, minlength=number)[met]
    levels = _histogram(kind, *_levels(np.asarray(rewards, dtype=np.float64)), number)[met]
    where = (both, np.asarray(actions)[met], dbn)
    termination = _table(where, ("done",), ("goes_on", "ends"), ended, ended, search)
    moments = np.column_stack([sums, levels.sum(axis=1)])
    reward = _table(where, ("reward",), (), levels, moments, search)
    return replace(dbn, step_tables={**dbn.step_tables, "reward": reward, "termination": termination})


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
    steps: tuple[np.ndarray, np.ndarray, TwoSliceDBN],
    targets: tuple[str, ...],
    outcomes: tuple[str, ...],
    histogram: np.ndarray,
    sums: np.ndarray,
    search: Search,
) -> StepTable:
    """One target per action: parents by the histogram's score; rows are shares of it, or means of (sum, count)."""
    both, action, dbn = steps
    n, k = dbn.num_factors, dbn.num_values
    parents: list[tuple[int, ...]] = []
    rows, counts = [], []
    whole = sums.sum(axis=0)
    for a in range(dbn.num_actions):
        here = action == a
        weights = histogram[here].sum(axis=1)
        child = histogram[here] / weights[:, None]
        varies = (histogram[here].sum(axis=0) > 0).sum() > 1
        chosen = learn_parents(both[here], child, weights, k, (n, 2 * n), search) if varies else ()
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
