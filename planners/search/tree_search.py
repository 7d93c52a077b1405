"""Online tree search in explicit POMDPs.

    plan(b) -> (argmax_a Q(b, a), info); update(a, o) keeps what the search knows of the belief that follows

Two methods over the same tables:

- `bounds` (the default): a tree of exact beliefs with a lower and an upper bound at every node, always widened where
  the root's bounds gain most (planners.search.bound_search). Its bounds come from an offline solver stopped early.
- `po-uct`: simulations s ~ b through a tree of (action, observation) by UCB1 (walk), with Bellman's backup.
  A leaf is worth what the model says of the sampled state: always doing the best single action (lower), the fully
  observed process (upper), or between, never a uniform rollout. All but the lower one value leaves as if the state
  were known there, so that looking is never worth its price. Sources: Silver and Veness 2010; Kocsis and Szepesvari
  2006.
"""

from __future__ import annotations

import math
import time
from typing import Any, Literal, get_args

import numpy as np

from nesy.errors import UserError
from planners.explicit.point_based import ordered, precision, solve, sparse_belief
from planners.explicit.pomdp import TabularPOMDP, check_solvable
from planners.explicit.state_bounds import blind_policies
from planners.search import bound_search
from planners.search.drawing import drawing_of
from planners.search.random_bits import stream
from planners.search.tree import allocate, clear, reroot
from planners.search.walk import best_tried, walks
from planners.search.walked_models import PackedPOMDP, TabularBelief

_TOLERANCE, _START_GAP = 1e-8, 1e-4  # relative to the values: when a decision is certain, and for the offline solver
_FEW, _MOST_NODES, _MOST_ENTRIES = 256, 4_000_000, 8_000_000  # room of a tree, at first and at most
_LEAF_WEIGHTS = {"lower": 0.0, "middle": 0.5, "upper": 1.0}
Method = Literal["bounds", "po-uct"]


def leaf_values(model: TabularPOMDP) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper value of every state, float64 [S] each: best blind policy, fully observed optimum."""
    return blind_policies(model).max(axis=0), model.fully_observed.max(axis=0)


def pack(model: TabularPOMDP, leaf: np.ndarray) -> PackedPOMDP:
    """The arrays of `model` for the walk; `leaf` float64 [S]."""
    begins, successors, cumulatives, offset = [], [], [], 0
    for matrix in model.transition:
        matrix.sum_duplicates()
        begins.append(matrix.indptr.astype(np.int64) + offset)
        successors.append(matrix.indices.astype(np.int64))
        running = np.cumsum(matrix.data)
        before = np.concatenate([[0.0], running])[matrix.indptr[:-1]]
        cumulatives.append(running - np.repeat(before, np.diff(matrix.indptr)))
        offset += len(matrix.data)
    return PackedPOMDP(
        np.stack(begins),
        np.concatenate(successors),
        np.concatenate(cumulatives),
        np.cumsum(model.observation, axis=2),
        np.ascontiguousarray(model.reward, np.float64),
        np.ascontiguousarray(model.terminal),
        np.ascontiguousarray(leaf, np.float64),
    )


class TreeSearch:
    """Anytime search in an explicit POMDP.

    Args:
        model: the POMDP, with a discount below 1.
        rng: seeds the search's own stream (`po-uct`; `bounds` draws nothing).
        simulations: per decision: simulated walks, or leaves expanded.
        depth: deepest step looked ahead (`po-uct`).
        exploration: weight of UCB1's bonus; the range of the rewards by default (`po-uct`).
        time_limit: seconds per decision after which to stop early; 0 for none. With a limit the machine decides how
            far the search gets, so results need not repeat.
        leaf: value of leaves: `lower`, `upper`, or the `middle` of the two (`po-uct`).
        method: see the module's head.
        trials: searches of the offline solver whose bounds the method `bounds` starts from.
        reuse: whether the tree below what happened is kept by `update`.

    Raises:
        UserError: a discount of 1; a number or name that cannot be.
        CrossedBounds: a lower bound above an upper one.
    """

    def __init__(
        self,
        model: TabularPOMDP,
        rng: np.random.Generator,
        simulations: int = 2000,
        depth: int = 40,
        exploration: float | None = None,
        time_limit: float = 0.0,
        leaf: Literal["lower", "middle", "upper"] = "lower",
        method: Method = "bounds",
        trials: int = 20,
        reuse: bool = True,
    ) -> None:
        check_solvable(model, "the search")
        if simulations < 1 or depth < 1 or not time_limit >= 0 or trials < 0:
            raise UserError("a search needs simulations and depth of at least 1, and no negative limits")
        if method not in get_args(Method) or leaf not in _LEAF_WEIGHTS:
            known = f"{' or '.join(get_args(Method))}, leaves {', '.join(_LEAF_WEIGHTS)}"
            raise UserError(f"no search with method '{method}' and leaf '{leaf}'; methods are {known}")
        self.model, self.method, self.reuse = model, method, reuse
        self.simulations, self.depth, self.time_limit = simulations, depth, time_limit
        self._planted: np.ndarray | None = None  # the belief that the tree at hand was grown for
        self._carried = False  # whether that tree is left over from an earlier belief
        if method == "bounds":
            gap = _START_GAP * float(np.abs(model.fully_observed).max())
            self._bounds = solve(model, gap=gap, time_limit=math.inf, max_trials=trials).bounds
            entries = max(_FEW, len(model.states))
            self._beliefs = bound_search.allocate(_FEW, _FEW, entries, len(model.actions))
            return
        lower, upper = leaf_values(model)
        self._precision = precision(model, float(max(np.abs(lower).max(), np.abs(upper).max())))
        for low, high in zip(lower, upper, strict=True):
            ordered(low, high, self._precision)
        weight = _LEAF_WEIGHTS[leaf]
        self._packed, self._blind = pack(model, (1 - weight) * lower + weight * upper), blind_policies(model)
        self.exploration = float(np.ptp(model.reward)) if exploration is None else exploration
        num_actions = len(model.actions)
        self.tree = allocate(2 * simulations + 2, num_actions)
        self._bits = stream(rng)

    def plan(self, belief: np.ndarray, allowed: np.ndarray | None = None) -> tuple[int, dict[str, Any]]:
        """Choose an action.

        Args:
            belief: float64 [S], sums to 1.
            allowed: bool [A], actions that a shield leaves; all by default. The others are not tried at the root.

        Returns:
            The action, and what the search saw: values and visits per action, simulations, nodes, mean and greatest
            depth, `lower` and `upper` bound of the belief's value, and for `bounds` those of each action.

        Raises:
            UserError: no belief of this model, or no action left.
        """
        belief = self.model.check_belief(belief)
        mask = np.ones(len(self.model.actions), np.bool_) if allowed is None else np.asarray(allowed, np.bool_)
        if mask.shape != (len(self.model.actions),) or not mask.any():
            raise UserError("a search needs at least one allowed action")
        if self.method == "bounds":
            return self._plan_with_bounds(belief, mask)
        return self._plan_by_walks(belief, mask)

    def update(self, action: int, observation: int) -> bool:
        """Keep the part of the tree that lies below what happened, for the next `plan`; whether there was any."""
        if not self.reuse or self._planted is None:
            return False
        before, self._planted = self._planted, None
        if self.method == "bounds":
            nodes, rows, entries = (max(int(size), 1) for size in self._beliefs.size[:3])
            below = bound_search.allocate(nodes, rows, entries, len(self.model.actions))
            kept = bound_search.reroot(self._beliefs, action, observation, below)
            if kept:
                self._beliefs = below
        else:
            kept = reroot(self.tree, action, observation)
        if kept:
            self._planted, self._carried = self.model.update(before, action, observation), True
        return bool(kept)

    def draw(self, depth: int = 3, format: Literal["dot", "svg"] = "dot") -> str:
        """The tree of the last `plan`, down to `depth` steps, as DOT or SVG text."""
        names = (list(self.model.actions), list(self.model.observations))
        return drawing_of(self._beliefs if self.method == "bounds" else self.tree, *names, depth, format)

    def _goes_on(self, belief: np.ndarray, mask: np.ndarray) -> bool:
        """Whether the tree at hand is what `update` kept for this belief; notes what the next tree is grown for."""
        kept = self._carried and self._planted is not None and bool(mask.all())
        kept = kept and bool(np.allclose(np.asarray(self._planted), belief, atol=1e-9))
        self._planted, self._carried = (belief if mask.all() else None), False
        return kept

    def _plan_with_bounds(self, belief: np.ndarray, mask: np.ndarray) -> tuple[int, dict[str, Any]]:
        arrays, flat = self._bounds.arrays, self._bounds.flat
        if not self._goes_on(belief, mask):
            bound_search.plant(self._beliefs, arrays, *sparse_belief(belief), self._bounds.dense)
        before = self._beliefs.visits[0]
        started, done = time.perf_counter(), 0
        chunk = 8 if self.time_limit > 0 else self.simulations
        tolerance = max(self._bounds.precision, _TOLERANCE * self._bounds.scale)
        while done < self.simulations:
            if self.time_limit > 0 and done and time.perf_counter() - started >= self.time_limit:
                break
            wanted = min(chunk, self.simulations - done)
            count = bound_search.grow(flat, arrays, self._beliefs, wanted, mask, tolerance, self._bounds.ahead)
            done += count
            if count < wanted:
                larger = bound_search.enlarged(self._beliefs, _MOST_NODES, _MOST_ENTRIES)
                if not self._beliefs.size[3] or larger is None:
                    break
                self._beliefs = larger
        tree = self._beliefs
        if tree.visits[0] == 0:  # an end, where any allowed action will do
            return int(mask.argmax()), {"values": [0.0] * len(mask), "visits": [0] * len(mask), "simulations": 0}
        low, high = tree.q_lower[0].copy(), tree.q_upper[0].copy()
        for a in np.flatnonzero(mask):
            low[a], high[a] = ordered(low[a], high[a], self._bounds.precision)
        action = int(np.where(mask, low, -np.inf).argmax())
        size = int(tree.size[0])
        visits = np.zeros(len(mask), np.int64)
        for a in np.flatnonzero(mask):
            visits[a] = 1 + tree.visits[tree.children[0, a] : tree.children[0, a + 1]].sum()
        expanded = tree.visits[:size] > 0
        return action, {
            "values": low.tolist(),
            "upper_values": high.tolist(),
            "visits": visits.tolist(),
            "simulations": int(tree.visits[0] - before),
            "nodes": size,
            "mean_depth": float(tree.depth[:size][expanded].mean() + 1),
            "max_depth": int(tree.depth[:size].max()),
            "lower": float(low.max()),
            "upper": float(high.max()),
        }

    def _plan_by_walks(self, belief: np.ndarray, mask: np.ndarray) -> tuple[int, dict[str, Any]]:
        if not self._goes_on(belief, mask):
            clear(self.tree)
        support, value = sparse_belief(belief)
        start = TabularBelief(support, np.cumsum(value) / value.sum())
        info = walks(
            self._packed,
            start,
            self.tree,
            self.simulations,
            self.time_limit,
            self.depth,
            self.model.discount,
            self.exploration,
            True,
            mask,
            self._bits,
        )
        lower, upper = float((self._blind @ belief).max()), float((self.model.fully_observed @ belief).max())
        info["lower"], info["upper"] = ordered(lower, upper, self._precision)
        return best_tried(info, mask), info


def closed_loop(search: TreeSearch, steps: int, rng: np.random.Generator) -> float:
    """Discounted return of one episode: plan, act, update the belief by Bayes."""
    model, belief = search.model, search.model.start
    state = int(rng.choice(len(belief), p=belief))
    total, factor = 0.0, 1.0
    for _ in range(steps):
        if model.terminal[state]:
            break
        action, _ = search.plan(belief)
        state, seen, reward = model.step(state, action, rng)
        total += factor * reward
        factor *= model.discount
        belief = model.update(belief, action, seen)
        search.update(action, seen)
    return total


def exact_return(search: TreeSearch, least: float = 1e-6) -> float:
    """Expected discounted return of acting on `search` from the model's start: all that can be observed, weighed.

    Each belief (to 9 digits) is planned for once, so a search that draws nothing is valued exactly; what is worth
    less than `least` of the reward's range is left out.

    Args:
        search: with `reuse` off, or on: beliefs are planned for one by one, nothing is kept from one to another.
        least: discount^depth x chance below which a branch is cut.
    """
    model = search.model
    chosen: dict[bytes, int] = {}
    total, layer = 0.0, {b"": (1.0, model.start)}
    while layer:
        after: dict[bytes, tuple[float, np.ndarray]] = {}
        for weight, belief in layer.values():
            key = np.round(belief, 9).tobytes()
            if key not in chosen:
                chosen[key] = search.plan(belief)[0]
            action = chosen[key]
            total += weight * float(model.reward[action] @ belief)
            for o, chance in enumerate(model.observation_chances(belief, action)):
                if model.discount * weight * chance < least:
                    continue
                then = model.update(belief, action, o)
                if model.terminal[then > 0].all():
                    continue
                name = np.round(then, 9).tobytes()
                share = model.discount * weight * float(chance)
                after[name] = (after[name][0] + share if name in after else share, then)
        layer = after
    return total
