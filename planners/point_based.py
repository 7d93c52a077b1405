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

from planners.pomdp import TabularPOMDP

_FEW = 2000  # points x actions x observations


@dataclass(frozen=True)
class Certificate:
    """Bounds at the start belief and the policy behind the lower one.

    Attributes:
        lower, upper: bounds of the optimal discounted value.
        alphas: float64 [M, S], the lower bound's vectors.
        alpha_actions: int64 [M], the action that each stands for.
        trials: searches from the start belief.
        seconds: time spent.
    """

    lower: float
    upper: float
    alphas: np.ndarray
    alpha_actions: np.ndarray
    trials: int
    seconds: float

    def action(self, belief: np.ndarray) -> int:
        """The action of the vector that is best at `belief`."""
        return int(self.alpha_actions[(self.alphas @ belief).argmax()])


def solve(model: TabularPOMDP, gap: float = 1e-3, time_limit: float = 60.0, max_trials: int = 100_000) -> Certificate:
    """Narrow the bounds at the model's start belief.

    Args:
        model: with a discount below 1.
        gap: absolute difference of the bounds at which to stop.
        time_limit: seconds after which to stop with the bounds so far.
        max_trials: searches after which to stop.

    Raises:
        ValueError: a discount of 1, for which the bounds need not converge.
    """
    if not model.discount < 1:
        raise ValueError("the solver needs a discount below 1")
    bounds = _Bounds(model)
    started = time.perf_counter()
    trials = 0
    while trials < max_trials and time.perf_counter() - started < time_limit:
        lower, upper = bounds.lower(model.start), bounds.upper(model.start)
        if lower > upper + 1e-6:
            warnings.warn(f"lower bound {lower:.6g} above upper bound {upper:.6g}", RuntimeWarning, stacklevel=2)
        if upper - lower <= gap:
            break
        bounds.explore(model.start, gap, started + time_limit)
        bounds.sweep(gap)
        trials += 1
    return Certificate(
        lower=bounds.lower(model.start),
        upper=bounds.upper(model.start),
        alphas=bounds.alphas[: bounds.count].copy(),
        alpha_actions=bounds.alpha_actions[: bounds.count].copy(),
        trials=trials,
        seconds=time.perf_counter() - started,
    )


class _Bounds:
    """Both bounds, as growing arrays."""

    def __init__(self, model: TabularPOMDP) -> None:
        self.model = model
        num_states, num_actions = len(model.states), len(model.actions)
        self.alphas = np.zeros((256, num_states))
        self.alpha_actions = np.zeros(256, np.int64)
        self.count, self.prune_at = 0, 64
        self.point_of: dict[bytes, int] = {}
        for a in range(num_actions):
            self._add_alpha(self._blind(a), a)
        self.corner = self._fast_informed()
        self.points = np.zeros((256, num_states))
        self.point_values = np.zeros(256)
        self.num_points = 0

    def _blind(self, action: int) -> np.ndarray:
        """Value of always doing `action`: iterated from below, so it stays a lower bound."""
        worst = min(float(self.model.reward[action].min()), 0.0) / (1 - self.model.discount)
        value = np.full(len(self.model.states), worst)
        value[self.model.terminal] = 0.0
        for _ in range(2000):
            after = self.model.reward[action] + self.model.discount * (self.model.transition[action] @ value)
            if np.abs(after - value).max() < 1e-9:
                break
            value = after
        return value

    def _fast_informed(self) -> np.ndarray:
        """Fast informed bound: float64 [S], iterated from above."""
        model = self.model
        q = model.fully_observed + 1e-9
        for _ in range(300):
            after = np.empty_like(q)
            for a, matrix in enumerate(model.transition):
                best = np.full(len(model.states), 0.0)
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

    def _add_alpha(self, alpha: np.ndarray, action: int) -> None:
        if self.count == len(self.alphas):
            self.alphas = np.concatenate([self.alphas, np.zeros_like(self.alphas)])
            self.alpha_actions = np.concatenate([self.alpha_actions, np.zeros_like(self.alpha_actions)])
        self.alphas[self.count], self.alpha_actions[self.count] = alpha, action
        self.count += 1

    def _prune(self) -> None:
        """Drop vectors that another one is at least as good as everywhere."""
        vectors = self.alphas[: self.count]
        kept: list[int] = []
        for i in np.argsort(-vectors.sum(axis=1), kind="stable"):
            if not kept or not (vectors[kept] >= vectors[i] - 1e-12).all(axis=1).any():
                kept.append(int(i))
        kept.sort()
        self.alphas[: len(kept)], self.alpha_actions[: len(kept)] = vectors[kept], self.alpha_actions[kept]
        self.count = len(kept)
        self.prune_at = 2 * self.count + 64

    def lower(self, belief: np.ndarray) -> float:
        return float((self.alphas[: self.count] @ belief).max())

    def upper(self, belief: np.ndarray) -> float:
        base = float(self.corner @ belief)
        if not self.num_points:
            return base
        support = np.flatnonzero(belief > 0)
        points = self.points[: self.num_points]
        # A point with weight outside the belief's support has ratio 0 and says nothing.
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = np.where(points[:, support] > 0, belief[support] / points[:, support], np.inf)
        inside = points[:, support].sum(axis=1) > 1 - 1e-9
        ratio = np.where(inside, ratios.min(axis=1), 0.0)
        gains = (self.point_values[: self.num_points] - points @ self.corner) * ratio
        return base + min(float(gains.min()), 0.0)

    def explore(self, start: np.ndarray, gap: float, deadline: float) -> None:
        """One trial: down to where the bounds are close enough for their depth, and back up with updates."""
        model = self.model
        path = [start]
        belief, allowed = start, gap
        while time.perf_counter() < deadline and len(path) < 400:
            if self.upper(belief) - self.lower(belief) <= allowed:
                break
            values, followers = zip(*(self._outlook(belief, a) for a in range(len(model.actions))), strict=True)
            allowed /= model.discount
            excess = [
                (chance * (self.upper(after) - self.lower(after) - allowed), -o, after)
                for o, (chance, after) in enumerate(followers[int(np.argmax(values))])
                if chance > 0
            ]
            most = max(excess, key=lambda item: item[:2])
            if most[0] <= 0:
                break
            belief = most[2]
            path.append(belief)
        for visited in reversed(path):
            self._improve(visited)

    def sweep(self, gap: float) -> None:
        """Where the points are few, improve all of them until little changes: values then travel round cycles."""
        if self.num_points * len(self.model.actions) * len(self.model.observations) > _FEW:
            return
        before = np.inf
        for _ in range(50):
            for i in range(self.num_points):
                self._improve(self.points[i])
            now = self.upper(self.model.start) - self.lower(self.model.start)
            if before - now < 0.01 * gap:
                break
            before = now

    def _outlook(self, belief: np.ndarray, action: int) -> tuple[float, list[tuple[float, np.ndarray]]]:
        """Upper bound of Q(b, a), and (chance, next belief) per observation."""
        model = self.model
        predicted = model.predict(belief, action)
        value = float(model.reward[action] @ belief)
        followers = []
        for o in range(len(model.observations)):
            joint = predicted * model.observation[action][:, o]
            chance = float(joint.sum())
            if chance <= 1e-12:
                followers.append((0.0, belief))
                continue
            after = joint / chance
            value += model.discount * chance * self.upper(after)
            followers.append((chance, after))
        return value, followers

    def _improve(self, belief: np.ndarray) -> None:
        """Backups of both bounds at one belief."""
        model = self.model
        best_value, best_alpha, best_action, best_upper = -np.inf, None, 0, -np.inf
        for a, matrix in enumerate(model.transition):
            predicted = model.predict(belief, a)
            weighted = predicted[:, None] * model.observation[a]
            chosen = (self.alphas[: self.count] @ weighted).argmax(axis=0)
            future = (model.observation[a] * self.alphas[chosen].T).sum(axis=1)
            alpha = model.reward[a] + model.discount * (matrix @ future)
            value = float(alpha @ belief)
            if value > best_value:
                best_value, best_alpha, best_action = value, alpha, a
            best_upper = max(best_upper, self._outlook(belief, a)[0])
        assert best_alpha is not None
        if best_value > self.lower(belief) + 1e-10:
            self._add_alpha(best_alpha, best_action)
            if self.count >= self.prune_at:
                self._prune()
        if best_upper < self.upper(belief) - 1e-10:
            key = np.round(belief, 10).tobytes()
            if key in self.point_of:
                self.point_values[self.point_of[key]] = best_upper
                return
            self.point_of[key] = self.num_points
            if self.num_points == len(self.points):
                self.points = np.concatenate([self.points, np.zeros_like(self.points)])
                self.point_values = np.concatenate([self.point_values, np.zeros_like(self.point_values)])
            self.points[self.num_points], self.point_values[self.num_points] = belief, best_upper
            self.num_points += 1
