"""An offline point-based solver with bounds: heuristic search value iteration (HSVI2).

    lower bound   L(b) = max_alpha alpha . b, started with blind policies, improved by point backups
    upper bound   U(b), a sawtooth interpolation of points, started with the fast informed bound
    search        from the start belief along argmax_a U and the observation with most excess uncertainty

What it returns is a certificate: the optimal value lies between the bounds.
Sources: Smith and Simmons 2005 (HSVI2); Hauskrecht 2000 (fast informed bound).
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass

import numpy as np

from nesy.errors import UserError
from planners.explicit import bound_kernels as kernels
from planners.explicit.bound_kernels import BoundSet
from planners.explicit.pomdp import TabularPOMDP, check_solvable

_FEW = 2000  # points x actions x observations
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
        seconds: time spent.
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
        sparse = sparse_belief(self.bounds.model.check_belief(belief))
        return self.bounds.lower(sparse), self.bounds.upper(sparse)


def solve(model: TabularPOMDP, gap: float = 1e-3, time_limit: float = 60.0, max_trials: int = 100_000) -> Certificate:
    """Narrow the bounds at the model's start belief.

    Args:
        model: with a discount below 1.
        gap: absolute difference of the bounds at which to stop.
        time_limit: seconds after which to stop with the bounds so far.
        max_trials: searches after which to stop.

    Raises:
        UserError: a discount of 1, for which the bounds need not converge; limits that cannot be met.
    """
    check_solvable(model, "the solver")
    if not (gap >= 0 and time_limit >= 0 and max_trials >= 0):
        raise UserError("the gap, the time limit and the number of trials must not be negative")
    bounds = PointBounds(model)
    start = sparse_belief(model.start)
    bounds.improve(start)  # compiles the kernels, which is not to count
    started = time.perf_counter()
    trials = 0
    while trials < max_trials and time.perf_counter() - started < time_limit:
        lower, upper = bounds.lower(start), bounds.upper(start)
        if lower > upper + 1e-6:
            warnings.warn(f"lower bound {lower:.6g} above upper bound {upper:.6g}", RuntimeWarning, stacklevel=2)
        if upper - lower <= gap:
            break
        bounds.explore(start, gap, started + time_limit)
        bounds.sweep(start, gap)
        trials += 1
    return Certificate(
        lower=bounds.lower(start),
        upper=bounds.upper(start),
        vectors=int(bounds.arrays.used[0]),
        trials=trials,
        seconds=time.perf_counter() - started,
        bounds=bounds,
    )


def sparse_belief(belief: np.ndarray) -> Belief:
    """A belief float64 [S] as (states it allows, their probabilities)."""
    index = np.flatnonzero(belief > 0).astype(np.int64)
    return index, np.ascontiguousarray(belief[index], np.float64)


def blind_policies(model: TabularPOMDP) -> np.ndarray:
    """Value of always doing one action, float64 [A, S]: iterated from below, so it is a lower bound at any time."""
    out = np.empty_like(model.reward)
    for a, (matrix, reward) in enumerate(zip(model.transition, model.reward, strict=True)):
        value = np.full(len(reward), min(float(reward.min()), 0.0) / (1 - model.discount))
        value[model.terminal] = 0.0
        for _ in range(2000):
            after = reward + model.discount * (matrix @ value)
            done = np.abs(after - value).max() < 1e-9
            value = after
            if done:
                break
        out[a] = value
    return out


def fast_informed_bound(model: TabularPOMDP) -> np.ndarray:
    """Upper bound of the value per state, float64 [S]: iterated from above (Hauskrecht 2000)."""
    q = model.fully_observed + 1e-8
    for _ in range(300):
        after = np.empty_like(q)
        for a, matrix in enumerate(model.transition):
            best = np.zeros(len(model.states))
            for o in range(len(model.observations)):
                weighted = model.observation[a][:, o]
                if weighted.any():
                    best += (matrix @ (weighted[:, None] * q.T)).max(axis=1)
            after[a] = model.reward[a] + model.discount * best
        done = np.abs(after - q).max() < 1e-7
        q = np.minimum(after, q)
        if done:
            break
    return np.asarray(q.max(axis=0))


class PointBounds:
    """Both bounds, as growing arrays (planners.explicit.bound_kernels).

    Attributes:
        flat: the model for the kernels.
        arrays: the bounds for the kernels; replaced when they grow.
    """

    def __init__(self, model: TabularPOMDP) -> None:
        self.model, self.flat = model, kernels.flatten(model)
        num_actions, num_states = model.reward.shape
        num_observations = len(model.observations)
        self.arrays = BoundSet(
            blind_policies(model),
            np.zeros(_ROOM + 1, np.int64),
            np.zeros(0, np.int64),
            np.zeros(0),
            np.zeros(_ROOM, np.int64),
            fast_informed_bound(model),
            np.zeros(_ROOM + 1, np.int64),
            np.zeros(0, np.int64),
            np.zeros(0),
            np.zeros(_ROOM),
            np.zeros(2, np.int64),
        )
        self.prune_at = _ROOM
        self.point_of: dict[bytes, int] = {}
        self.dense, self.other = np.zeros(num_states), np.zeros(num_states)
        self.q_lower, self.q_upper = np.zeros(num_actions), np.zeros(num_actions)
        shape = (num_actions, num_observations)
        self.chosen, self.chances = np.zeros(shape, np.int64), np.zeros(shape)
        self.lowers, self.uppers = np.zeros(shape), np.zeros(shape)

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

    def explore(self, start: Belief, gap: float, deadline: float) -> None:
        """One trial: down to where the bounds are close enough for their depth, and back up with updates."""
        path, belief, allowed = [start], start, gap
        while time.perf_counter() < deadline and len(path) < _DEEPEST:
            self._look(belief)
            if self.upper(belief) - self.lower(belief) <= allowed:
                break
            allowed /= self.model.discount
            a = int(self.q_upper.argmax())
            excess = self.chances[a] * (self.uppers[a] - self.lowers[a] - allowed)
            excess[self.chances[a] <= 0] = -np.inf
            o = int(excess.argmax())
            if excess[o] <= 0:
                break
            index, value, _ = kernels.follow(self.flat, *belief, a, o, self.dense)
            belief = (index, value)
            path.append(belief)
        for visited in reversed(path):
            self.improve(visited)

    def sweep(self, start: Belief, gap: float) -> None:
        """Where the points are few, improve all of them until little changes: values then travel round cycles."""
        points = int(self.arrays.used[1])
        if points * self.chances.size > _FEW:
            return
        before = np.inf
        for _ in range(50):
            for p in range(points):
                begin, end = self.arrays.point_begin[p : p + 2]
                self.improve((self.arrays.point_index[begin:end], self.arrays.point_value[begin:end]))
            now = self.upper(start) - self.lower(start)
            if before - now < 0.01 * gap:
                break
            before = now

    def improve(self, belief: Belief) -> None:
        """Backups of both bounds at one belief."""
        self._look(belief)
        action = int(self.q_lower.argmax())
        if self.q_lower[action] > self.lower(belief) + 1e-10:
            self._add_alpha(belief[0], action)
        upper = float(self.q_upper.max())
        if upper < self.upper(belief) - 1e-10:
            self._add_point(belief, upper)

    def _look(self, belief: Belief) -> None:
        kernels.look(
            self.flat,
            self.arrays,
            *belief,
            self.dense,
            self.other,
            self.q_lower,
            self.q_upper,
            self.chosen,
            self.chances,
            self.lowers,
            self.uppers,
        )

    def _add_alpha(self, index: np.ndarray, action: int) -> None:
        made = kernels.backed_up(self.flat, self.arrays, action, self.chosen[action], index)
        if self.arrays.used[0] == self.prune_at:
            self._prune()
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

    def _prune(self) -> None:
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
        gain = value - float(self.arrays.corner[index] @ mass)
        key = index.tobytes() + np.round(mass, 10).tobytes()
        if key in self.point_of:
            self.arrays.point_gain[self.point_of[key]] = gain
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


def _with_room(array: np.ndarray, size: int) -> np.ndarray:
    """The array itself if it holds `size` entries, else a copy with room for twice as many."""
    if len(array) >= size:
        return array
    return np.concatenate([array, np.zeros(2 * size - len(array), array.dtype)])
