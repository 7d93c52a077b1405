"""Bounds of the value of every state, true at every discount below 1, whenever the work is stopped.

    F(x) = max over policies of r + discount P x       monotone, and F(x + c) = F(x) + discount c
    low = F(x) + k min(F(x) - x)  <=  fixed point  <=  F(x) + k max(F(x) - x) = high,     k = discount / (1 - discount)

These hold for any x (MacQueen 1966; Puterman 1994, section 6.6), so how x was found does not matter. Sweeps x <- F(x)
find it where they converge; elsewhere policy iteration does, whose linear systems are solved by sparse LU or GMRES.
What rounding can add to a sweep is counted in.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph, linalg

if TYPE_CHECKING:
    from planners.explicit.pomdp import TabularPOMDP

_PACE, _MOST_PACE = 20, 640  # sweeps between two linear systems, or looks at whether one is needed; it doubles
_PATIENCE = 500  # sweeps still to go above which a linear system is solved instead
_MOST_SWEEPS, _MOST_SYSTEMS = 20_000, 60
_FLOPS = 5e8  # of a sparse LU decomposition, per second
_CHEAP, _MOST_SECONDS, _MOST_FILL = 0.3, 60.0, 1e8


class Process(Protocol):
    """A discounted maximum over policies.

    Attributes:
        discount: below 1.
        gains: float64 [N], the least and the greatest reward of each entry's policies: [2, N].
        terms: most terms that one entry sums up.
    """

    discount: float
    gains: np.ndarray
    terms: int

    def apply(self, x: np.ndarray, deadline: float) -> tuple[np.ndarray, np.ndarray] | None:
        """F(x), float64 [N], and numbers that tell the policy behind it; None where the deadline came first."""
        ...

    def system(self) -> tuple[sparse.csr_array, np.ndarray] | None:
        """P [N, N] and r [N] of the policy behind the last `apply`; None where they would be too large."""
        ...


@dataclass
class Chosen:
    """A fully observed process whose policy picks one of these actions in every state; of one, a Markov chain."""

    matrix: sparse.csr_array  # [A * S, S]
    reward: np.ndarray  # float64 [A, S]
    discount: float

    def __post_init__(self) -> None:
        self.gains = np.stack([self.reward.min(axis=0), self.reward.max(axis=0)])
        self.terms = int(np.diff(self.matrix.indptr).max(initial=1))

    def action_values(self, x: np.ndarray) -> np.ndarray:
        """R + discount T x, float64 [A, S]."""
        values: np.ndarray = self.reward + self.discount * (self.matrix @ x).reshape(self.reward.shape)
        return values

    def apply(self, x: np.ndarray, deadline: float = math.inf) -> tuple[np.ndarray, np.ndarray]:
        """See `Process`; the policy is int64 [S]."""
        values = self.action_values(x)
        self.policy = values.argmax(axis=0)
        return values.max(axis=0), self.policy

    def system(self) -> tuple[sparse.csr_array, np.ndarray]:
        """See `Process`."""
        states = np.arange(len(self.policy))
        return self.matrix[self.policy * len(states) + states], self.reward[self.policy, states]


def process_of(model: TabularPOMDP, actions: Sequence[int] | None = None) -> Chosen:
    """The fully observed process of a model, with some of its actions; all by default."""
    chosen = range(len(model.actions)) if actions is None else actions
    stacked = sparse.csr_array(sparse.vstack([model.transition[a] for a in chosen], format="csr"))
    return Chosen(stacked, model.reward[list(chosen)], model.discount)


def rounding(process: Process, scale: float) -> float:
    """What rounding in a sweep over values up to `scale` can move the fixed point."""
    return 4 * (process.terms + 4) * float(np.finfo(float).eps) * scale / (1 - process.discount)


def bracket(
    process: Process,
    ends: np.ndarray,
    deadline: float = math.inf,
    tolerance: float = 1e-11,
    guess: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of the fixed point of F, float64 [N] each.

    Args:
        process: what F is of.
        ends: bool [N], entries that are worth 0 for ever.
        deadline: of `time.perf_counter`, after which to stop with the bounds so far; they hold all the same.
        tolerance: greatest distance of the bounds at which to stop, relative to the values.
        guess: float64 [N] to begin with; 0 by default.
    """
    share = process.discount / (1 - process.discount)
    least, most = process.gains[0].min(), process.gains[1].max()
    slack = rounding(process, float(np.abs(process.gains).max()) / (1 - process.discount))
    floor, ceiling = (0.0, 0.0) if ends.any() else (least, most)
    low = np.where(ends, 0.0, process.gains[0] + share * min(least, floor) - slack)
    high = np.where(ends, 0.0, process.gains[1] + share * max(most, ceiling) + slack)
    x = np.zeros(len(low)) if guess is None else guess
    systems, pace, due, before = 0, _PACE, _PACE - 1, math.inf
    known: np.ndarray | None = None  # the policy that x is worth, while it is
    for sweep in range(_MOST_SWEEPS):
        if time.perf_counter() >= deadline or (applied := process.apply(x, deadline)) is None:
            break
        after, policy = applied
        change = after - x
        scale = float(max(np.abs(x).max(), share * np.abs(change).max(), np.abs(process.gains).max()))
        slack = rounding(process, scale)
        np.minimum(high, np.where(ends, 0.0, after + share * change.max() + slack), out=high)
        np.maximum(low, np.where(ends, 0.0, after + share * change.min() - slack), out=low)
        width = float((high - low).max())
        if width <= tolerance * scale + 3 * slack:
            break
        if known is not None and np.array_equal(policy, known):
            break  # what is left is rounding
        x, known = after, None
        if sweep < due:
            continue
        quick, before = _to_go(before, width, tolerance * scale) <= _PATIENCE, width
        due = sweep + pace
        if (quick and not systems) or systems == _MOST_SYSTEMS:
            continue
        solved = _evaluated(process, x, deadline)
        if solved is None:
            continue  # too large for now: sweeps go on
        if systems and np.abs(solved - x).max() <= tolerance * scale:
            break
        systems, known, x, pace = systems + 1, policy.copy(), solved, min(2 * pace, _MOST_PACE)
        due = sweep + pace
    return low, high


def _to_go(before: float, width: float, target: float) -> float:
    """Sweeps until `width` is at `target`, at the rate of the last `_PACE` ones; without end at first."""
    if not width < before < math.inf:
        return 0.0 if before == math.inf else math.inf
    return math.log(max(target, 1e-300) / width) / math.log(width / before) * _PACE


def _evaluated(process: Process, x: np.ndarray, deadline: float) -> np.ndarray | None:
    """What the policy of the last sweep is worth, near enough, from a first guess; None where it takes too long."""
    if (system_of := process.system()) is None:
        return None
    matrix, gain = system_of
    system = sparse.csc_array(sparse.eye_array(len(x), format="csr") - process.discount * matrix)
    seconds = min(deadline - time.perf_counter(), _MOST_SECONDS)
    cost = _decomposition_seconds(system)
    if cost > _CHEAP:
        step = _iterated(system, gain - system @ x, deadline)
        if step is not None:
            return x + step
    if cost > seconds:
        return None
    factors = linalg.splu(system)
    for _ in range(2):
        x = x + factors.solve(gain - system @ x)
    return x


def _decomposition_seconds(system: sparse.csc_array) -> float:
    """About how long a sparse LU decomposition takes, by the bandwidth that reordering leaves; inf for no room."""
    order = csgraph.reverse_cuthill_mckee(sparse.csr_matrix(system))
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    entries = system.tocoo()
    band = int(np.abs(place[entries.row] - place[entries.col]).max(initial=1))
    return 2 * len(order) * band**2 / _FLOPS if len(order) * band <= _MOST_FILL else math.inf


class _Late(Exception):
    """The deadline came while a system was being solved."""


def _iterated(system: sparse.csc_array, rest: np.ndarray, deadline: float) -> np.ndarray | None:
    """The solution of system x = rest by GMRES; None where it does not get there."""

    def watch(_: float) -> None:
        if time.perf_counter() >= deadline:
            raise _Late

    try:
        found, failed = linalg.gmres(
            system, rest, rtol=1e-12, restart=60, maxiter=10, callback=watch, callback_type="pr_norm"
        )
    except _Late:
        return None
    return None if failed else np.asarray(found)


def optimum(model: TabularPOMDP, deadline: float = math.inf) -> np.ndarray:
    """Q of the fully observed process from above, float64 [A, S]: an upper bound for every belief (QMDP)."""
    process = process_of(model)
    high = bracket(process, model.terminal, deadline)[1]
    return process.action_values(high)


def blind_policies(model: TabularPOMDP, deadline: float = math.inf) -> np.ndarray:
    """Value of always doing one action from below, float64 [A, S]: a lower bound for every belief."""
    actions = range(len(model.actions))
    return np.stack([bracket(process_of(model, [a]), model.terminal, deadline)[0] for a in actions])
