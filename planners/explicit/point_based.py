"""An offline point-based solver with bounds: heuristic search value iteration (HSVI2).

    lower bound   L(b) = max_alpha alpha . b, started with blind policies, improved by point backups
    upper bound   U(b), a sawtooth interpolation of points, started with the fast informed bound
    search        from the start belief along argmax_a U and the observation with most excess uncertainty

What it returns is a certificate: the optimal value lies between the bounds, whenever the search was stopped.
Sources: Smith and Simmons 2005 (HSVI2); Hauskrecht 2000 (fast informed bound).
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from nesy.errors import UserError
from planners.explicit import bound_kernels as kernels
from planners.explicit.bound_kernels import BoundSet
from planners.explicit.informed_bound import Informed, fast_informed_bound
from planners.explicit.pomdp import CrossedBounds, TabularPOMDP, check_solvable
from planners.explicit.state_bounds import blind_policies, optimum

_BEGINNING = 0.5  # share of the time that the bounds to start from may take
_FINE = 1e-13  # improvements smaller than this, relative to the values, are not kept
_OVERHEAD = 100_000  # of a backup outside of the kernels, in products
_LITTLE = 0.01  # share of the gap by which a sweep has to improve to be repeated
_DEEPEST = 400
_ROOM = 256
Belief = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Certificate:
    """Bounds at the start belief and the policy behind the lower one.

    Attributes:
        lower, upper: bounds of the optimal discounted value.
        vectors: of the lower bound, blind policies not counted.
        trials: searches from the start belief.
        seconds: time spent, all in all.
        bounds: both bounds at any belief, for a search to go on from.
    """

    lower: float
    upper: float
    vectors: int
    trials: int
    seconds: float
    bounds: PointBounds

    def action(self, belief: np.ndarray) -> int:
        """The action of the vector that is best at `belief`."""
        return self.bounds.policy(sparse_belief(self.bounds.model.check_belief(belief)))

    def at(self, belief: np.ndarray) -> tuple[float, float]:
        """Lower and upper bound at `belief`, float64 [S]."""
        return self.bounds.at(sparse_belief(self.bounds.model.check_belief(belief)))


def solve(model: TabularPOMDP, gap: float = 1e-3, time_limit: float = 60.0, max_trials: int = 100_000) -> Certificate:
    """Narrow the bounds at the model's start belief.

    Args:
        model: with a discount below 1.
        gap: absolute difference of the bounds at which to stop. Where rounding does not allow it, the solver stops
            at what rounding allows.
        time_limit: seconds after which to stop with the bounds so far, which hold however early that is.
        max_trials: searches after which to stop.

    Raises:
        UserError: a discount of 1, for which the bounds need not converge; limits that cannot be met.
        CrossedBounds: a lower bound above an upper one.
    """
    check_solvable(model, "the solver")
    if not (gap >= 0 and time_limit >= 0 and max_trials >= 0):
        raise UserError("the gap, the time limit and the number of trials must not be negative")
    started = time.perf_counter()
    deadline = started + time_limit
    bounds = PointBounds(model, started + _BEGINNING * time_limit)
    start = sparse_belief(model.start)
    trials = 0
    while trials < max_trials and time.perf_counter() < deadline:
        lower, upper = bounds.at(start)
        if upper - lower <= max(gap, bounds.precision):
            break
        backups = bounds.explore(start, gap, deadline)
        bounds.sweep(start, gap, deadline, backups)
        trials += 1
    lower, upper = bounds.at(start)
    return Certificate(
        lower=lower,
        upper=upper,
        vectors=int(bounds.arrays.used[0]),
        trials=trials,
        seconds=time.perf_counter() - started,
        bounds=bounds,
    )


def sparse_belief(belief: np.ndarray) -> Belief:
    """A belief float64 [S] as (states it allows, their probabilities)."""
    index = np.flatnonzero(belief > 0).astype(np.int64)
    return index, np.ascontiguousarray(belief[index], np.float64)


class PointBounds:
    """Both bounds, as growing arrays (planners.explicit.bound_kernels).

    Attributes:
        flat: the model for the kernels.
        arrays: the bounds for the kernels; replaced when they grow.
        scale: greatest value or reward, without its sign.
        precision: what rounding can make of a value.
        ahead: the last step ahead.
    """

    def __init__(self, model: TabularPOMDP, deadline: float = math.inf) -> None:
        self.model, self.flat = model, kernels.flatten(model)
        fully_observed = optimum(model, deadline)
        self.arrays = BoundSet(
            blind_policies(model, deadline),
            np.zeros(_ROOM + 1, np.int64),
            np.zeros(0, np.int64),
            np.zeros(0),
            np.zeros(_ROOM, np.int64),
            fast_informed_bound(model, self.flat, fully_observed, deadline),
            np.zeros(_ROOM + 1, np.int64),
            np.zeros(0, np.int64),
            np.zeros(0),
            np.zeros(_ROOM),
            np.zeros(2, np.int64),
        )
        self.scale = float(max(np.abs(table).max() for table in (self.arrays.blind, self.arrays.corner, model.reward)))
        self.precision = precision(model, self.scale)
        self.prune_at = _ROOM
        self.point_of: dict[bytes, int] = {}
        self.ahead = kernels.room_ahead(self.flat)
        self.dense = self.ahead.dense
        self.inner = np.flatnonzero(~model.terminal)

    def lower(self, belief: Belief) -> float:
        """L at a sparse belief."""
        return float(kernels.lower_at(self.arrays, *belief, self.dense)[0])

    def policy(self, belief: Belief) -> int:
        """The action behind L at a sparse belief."""
        which = int(kernels.lower_at(self.arrays, *belief, self.dense)[1]) - len(self.arrays.blind)
        return int(self.arrays.alpha_action[which]) if which >= 0 else which + len(self.arrays.blind)

    def upper(self, belief: Belief) -> float:
        """U at a sparse belief."""
        return float(kernels.upper_at(self.arrays, *belief, self.dense))

    def at(self, belief: Belief) -> tuple[float, float]:
        """Both bounds at a sparse belief, in order.

        Raises:
            CrossedBounds: they are not, by more than rounding explains.
        """
        return ordered(self.lower(belief), self.upper(belief), self.precision)

    def explore(self, start: Belief, gap: float, deadline: float) -> int:
        """One trial: down to where the bounds are close enough for their depth, and back up; how many backups."""
        path, belief, allowed = [start], start, gap
        while time.perf_counter() < deadline and len(path) < _DEEPEST:
            self._look(belief)
            if self.upper(belief) - self.lower(belief) <= allowed:
                break
            if not self.model.discount:
                break
            allowed /= self.model.discount
            a = int(self.ahead.q_upper.argmax())
            excess = self.ahead.chances[a] * (self.ahead.uppers[a] - self.ahead.lowers[a] - allowed)
            excess[self.ahead.chances[a] <= 0] = -np.inf
            o = int(excess.argmax())
            if excess[o] <= 0:
                break
            index, value, _ = kernels.follow(self.flat, *belief, a, o, self.dense)
            belief = (index, value)
            path.append(belief)
        for visited in reversed(path):
            self.improve(visited)
            if time.perf_counter() >= deadline:
                break
        return len(path)

    def sweep(self, start: Belief, gap: float, deadline: float, backups: int) -> None:
        """Improve all points until little changes, as values travel round cycles; at most the work of the trial before.

        Work is counted, not timed, so that results repeat.
        """
        left = backups * (2 * _OVERHEAD + self._work())
        before, little = math.inf, max(_LITTLE * gap, _FINE * self.scale)
        while True:
            points = int(self.arrays.used[1])
            work = self._work()
            while (cost := (points + len(self.inner)) * work) <= left:
                left -= cost
                gained = kernels.tighten(self.flat, self.arrays, self.inner, self.ahead)
                if gained <= little or time.perf_counter() >= deadline:
                    break
            left -= points * (_OVERHEAD + work)
            if left < 0:
                return
            for p in range(points):
                begin, end = self.arrays.point_begin[p : p + 2]
                self.improve((self.arrays.point_index[begin:end].copy(), self.arrays.point_value[begin:end].copy()))
            now = self.upper(start) - self.lower(start)
            if before - now <= little or time.perf_counter() >= deadline:
                return
            before = now

    def _work(self) -> int:
        """About how many products one backup of the upper bound takes."""
        return int(self.ahead.chances.size * (1 + self.arrays.point_begin[self.arrays.used[1]]))

    def improve(self, belief: Belief) -> None:
        """Backups of both bounds at one belief."""
        self._look(belief)
        action = int(self.ahead.q_lower.argmax())
        if self.ahead.q_lower[action] > self.lower(belief) + _FINE * self.scale:
            self._add_alpha(belief[0], action)
        upper = float(self.ahead.q_upper.max())
        if upper < self.upper(belief) - _FINE * self.scale:
            self._add_point(belief, upper)

    def _look(self, belief: Belief) -> None:
        kernels.look(self.flat, self.arrays, *belief, self.ahead)

    def _add_alpha(self, index: np.ndarray, action: int) -> None:
        made = kernels.backed_up(self.flat, self.arrays, action, self.ahead.chosen[action], index)
        if self.arrays.used[0] == self.prune_at:
            self.prune()
        count = int(self.arrays.used[0])
        begin = int(self.arrays.alpha_begin[count])
        end = begin + len(index)
        self.arrays = self.arrays._replace(
            alpha_begin=_with_room(self.arrays.alpha_begin, count + 2),
            alpha_action=_with_room(self.arrays.alpha_action, count + 1),
            alpha_index=_with_room(self.arrays.alpha_index, end),
            alpha_value=_with_room(self.arrays.alpha_value, end),
        )
        self.arrays.alpha_index[begin:end], self.arrays.alpha_value[begin:end] = index, made
        self.arrays.alpha_begin[count + 1], self.arrays.alpha_action[count] = end, action
        self.arrays.used[0] = count + 1

    def prune(self) -> None:
        """Drop vectors that another one over the same states is at least as good as."""
        arrays, count = self.arrays, int(self.arrays.used[0])
        spans = list(zip(arrays.alpha_begin[:count], arrays.alpha_begin[1 : count + 1], strict=True))
        groups: dict[bytes, int] = {}
        group = np.array([groups.setdefault(arrays.alpha_index[i:j].tobytes(), len(groups)) for i, j in spans])
        kept = np.flatnonzero(kernels.undominated(arrays, group))
        entries = np.concatenate([np.arange(*spans[m]) for m in kept])
        sizes = np.array([spans[m][1] - spans[m][0] for m in kept])
        arrays.alpha_index[: len(entries)] = arrays.alpha_index[entries]
        arrays.alpha_value[: len(entries)] = arrays.alpha_value[entries]
        arrays.alpha_begin[1 : len(kept) + 1] = np.cumsum(sizes)
        arrays.alpha_action[: len(kept)] = arrays.alpha_action[kept]
        arrays.used[0] = len(kept)
        self.prune_at = 2 * len(kept) + _ROOM

    def _add_point(self, belief: Belief, value: float) -> None:
        index, mass = belief
        if len(index) == 1:
            kernels.lower_corner(self.arrays, index[0], value / mass[0])
            return
        gain = value - float(self.arrays.corner[index] @ mass)
        key = index.tobytes() + np.round(mass, 10).tobytes()
        if key in self.point_of:
            known = self.point_of[key]  # equal to ten digits: the gain is that of this one
            begin = int(self.arrays.point_begin[known])
            self.arrays.point_gain[known], self.arrays.point_value[begin : begin + len(mass)] = gain, mass
            return
        count = int(self.arrays.used[1])
        begin = int(self.arrays.point_begin[count])
        end = begin + len(index)
        self.arrays = self.arrays._replace(
            point_begin=_with_room(self.arrays.point_begin, count + 2),
            point_gain=_with_room(self.arrays.point_gain, count + 1),
            point_index=_with_room(self.arrays.point_index, end),
            point_value=_with_room(self.arrays.point_value, end),
        )
        self.point_of[key] = count
        self.arrays.point_index[begin:end], self.arrays.point_value[begin:end] = index, mass
        self.arrays.point_begin[count + 1], self.arrays.point_gain[count] = end, gain
        self.arrays.used[1] = count + 1


def precision(model: TabularPOMDP, scale: float) -> float:
    """What rounding can make of values up to `scale`; bounds may cross by no more."""
    return scale * (1e-9 + 64 * float(np.finfo(float).eps) / (1 - model.discount))


def ordered(lower: float, upper: float, tolerance: float) -> tuple[float, float]:
    """Bounds that cross by no more than `tolerance`, in order.

    Raises:
        CrossedBounds: they cross by more.
    """
    if not lower <= upper + tolerance:
        raise CrossedBounds(
            f"the lower bound {lower:.9g} is above the upper bound {upper:.9g}: a bug, please report it"
        )
    return min(lower, upper), max(lower, upper)


def _with_room(array: np.ndarray, size: int) -> np.ndarray:
    """The array itself if it holds `size` entries, else a copy with room for twice as many."""
    if len(array) >= size:
        return array
    return np.concatenate([array, np.zeros(2 * size - len(array), array.dtype)])


def _load_kernels() -> None:
    """Solve a model of one state: kernels are loaded with this module, so that time limits are those of solving."""
    one = np.ones((1, 1))
    model = TabularPOMDP(["s"], ["a"], ["o"], [sparse.csr_array(one)], one[None], one, 0.5, one[0], one[0] < 1)
    bounds, start = PointBounds(model), sparse_belief(model.start)
    bounds.arrays.corner[:] += 1.0
    bounds.arrays.blind[:] -= 1.0
    bounds.explore(start, 0.0, math.inf)
    bounds.sweep(start, 0.0, math.inf, 1)
    bounds.prune()
    process = Informed(bounds.flat)
    process.apply(np.ones(1), math.inf)
    process.system()


_load_kernels()
