"""What happens along a plan: what it depends on, and the exact distribution over codes.

For models with impossible transitions the reachable codes are few, and a forward pass over them is exact where
elimination would need a table over all factors. `pruned` makes such a model out of one that rules nothing out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from nesy.dbn.inference.reachable import ancestors
from nesy.dbn.rows import code_type, unique_rows
from nesy.errors import UserError

if TYPE_CHECKING:
    from nesy.dbn.model import TwoSliceDBN

MAX_CODES = 1 << 21


def cone(dbn: TwoSliceDBN, plan: Sequence[int], factors: Sequence[int]) -> list[tuple[int, ...]]:
    """Cone of influence: the factors of every slice 0..T that the given factors of slice T depend on."""
    needed: list[set[int]] = [set() for _ in range(len(plan) + 1)]
    needed[-1] = set(factors)
    for step in range(len(plan), 0, -1):
        action = plan[step - 1]
        needed[step] = set(ancestors(dbn, action, tuple(needed[step])))
        needed[step - 1] = {p for i in needed[step] for p in dbn.parents_now[action][i]}
    return [tuple(sorted(slice_)) for slice_ in needed]


def follow(
    dbn: TwoSliceDBN,
    code: np.ndarray,
    plan: Sequence[int],
    factors: Sequence[int] | None = None,
    most: int = MAX_CODES,
    drop: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Exact distribution over the codes that a plan can lead to.

    With `drop`, branches are cut whose probability so far is at most that: every probability returned is then a
    lower bound, and what they lack to 1 is how far the truth can be above.

    Args:
        dbn: the model.
        code: integers [N], where the plan starts.
        plan: the actions.
        factors: the factors asked for; only what they depend on is followed, other entries of the codes are 0.
            All by default.
        most: most codes followed at once.
        drop: least probability of a branch, from the start of the plan; 0 keeps everything possible.

    Returns:
        uint8 [M, N], each once, and their probabilities float64 [M]; they sum to 1 less what was cut.

    Raises:
        UserError: more than `most` codes are reachable.
    """
    needed = cone(dbn, plan, range(dbn.num_factors) if factors is None else factors)
    keep = np.zeros(dbn.num_factors, dtype=bool)
    keep[list(needed[0])] = True
    codes = np.where(keep, dbn._codes(code), 0)[None]
    weights = np.ones(1)
    for step, action in enumerate(plan):
        codes, weights = step_codes(dbn, codes, weights, int(action), needed[step + 1], most, drop)
    return codes.astype(dbn.code_type), weights


def step_codes(
    dbn: TwoSliceDBN,
    codes: np.ndarray,
    weights: np.ndarray,
    action: int,
    factors: Sequence[int],
    most: int = MAX_CODES,
    drop: float = 0.0,
    visit: Callable[[int, np.ndarray], None] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """One step of `follow`: from weighted codes int64 [M, N] to those of some factors after an action.

    `visit` is told of every factor and the rows of its table that are used.
    """
    now, later = codes, np.zeros_like(codes)
    # factors of slice t are dropped as soon as nobody asks for them any more, so that codes merge early
    order = [i for i in dbn.order if i in factors]
    for position, i in enumerate(order):
        rows = dbn.rows(action, i, now, later)
        if visit is not None:
            visit(i, rows)
        table = dbn.cpt(action, i)[rows] * weights[:, None]
        source, values = np.nonzero(table > drop)
        now, later, weights = now[source], later[source], table[source, values]
        later[:, i] = values
        waiting = order[position + 1 :]
        still = {p for j in waiting for p in dbn.parents_now[action][j]}
        now[:, [p for p in range(dbn.num_factors) if p not in still]] = 0
        now, later, weights = _merged(now, later, weights, dbn.num_values)
        if len(weights) > most:
            raise UserError(f"more than {most} codes are reachable; prune the model or ask for fewer factors")
    return later, weights


@dataclass(frozen=True)
class Reached:
    """The part of a model that a plan from a code really uses: all else has probability 0 there."""

    slices: list[tuple[int, ...]]
    """[T + 1]: factors of every slice that the ones asked for depend on (see `cone`)."""
    values: list[dict[int, np.ndarray]]
    """[T + 1]: values that each of them can have."""
    rows: list[dict[int, np.ndarray]]
    """[T]: rows of each factor's table that are used in the step."""
    codes: np.ndarray
    """uint8 [M, N]: codes after the plan; factors not asked for are 0."""
    weights: np.ndarray
    """float64 [M]: their probabilities."""


def reached(
    dbn: TwoSliceDBN, code: np.ndarray, plan: Sequence[int], factors: Sequence[int], most: int = MAX_CODES
) -> Reached:
    """What a plan uses of a model, exactly: rows and values that can be met together, not factor by factor.

    Raises:
        UserError: more than `most` codes are reachable.
    """
    slices = cone(dbn, plan, factors)
    keep = np.zeros(dbn.num_factors, dtype=bool)
    keep[list(slices[0])] = True
    codes, weights = np.where(keep, dbn._codes(code), 0)[None], np.ones(1)
    values = [{i: np.array([int(code[i])]) for i in slices[0]}]
    rows: list[dict[int, np.ndarray]] = []
    for step, action in enumerate(plan):
        used: dict[int, np.ndarray] = {}
        found: dict[int, np.ndarray] = {}

        def visit(
            i: int,
            met: np.ndarray,
            action: int = int(action),
            used: dict[int, np.ndarray] = used,
            found: dict[int, np.ndarray] = found,
        ) -> None:
            used[i] = np.unique(met)
            found[i] = np.flatnonzero((dbn.cpt(action, i)[used[i]] > 0).any(axis=0))

        codes, weights = step_codes(dbn, codes, weights, int(action), slices[step + 1], most, visit=visit)
        rows.append(used)
        values.append(found)
    return Reached(slices, values, rows, codes.astype(dbn.code_type), weights)


def _merged(
    now: np.ndarray, later: np.ndarray, weights: np.ndarray, num_values: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    both = np.column_stack([now, later]).astype(code_type(num_values))
    first, index, _ = unique_rows(both)
    return now[first], later[first], np.bincount(index, weights)


def pruned(dbn: TwoSliceDBN, least: float) -> tuple[TwoSliceDBN, float]:
    """The model without values less probable than `least`, its rows renormalised.

    Returns:
        The model, and the largest probability mass that a row has lost.

    Raises:
        UserError: `least` would empty a row.
    """
    if not 0 <= least < 1.0 / dbn.num_values:
        raise UserError(f"the least probability must lie in [0, 1/{dbn.num_values}), found {least}")
    kept = np.where(dbn.probabilities >= least, dbn.probabilities, 0.0)
    totals = kept.sum(axis=1, keepdims=True)
    return replace(dbn, probabilities=kept / totals), float(1.0 - totals.min())
