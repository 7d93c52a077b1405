"""Online tree search in explicit POMDPs: PO-UCT in compiled kernels, with leaf values from the model.

    plan(b) -> (argmax_a Q(b, a), info); Q estimated by simulations s ~ b through a tree of (action, observation)

Values are backed up as maxima (Bellman) rather than as averages of what was tried. A leaf is worth what the model
says of the sampled state: between always doing the best single action (lower) and the fully observed process
(upper), never a uniform rollout. The person-following model has a search of its own (planners.ialm_search) on the
same tree. Source: Silver and Veness 2010.
"""

from __future__ import annotations

import time
import warnings
from typing import Any, Literal, NamedTuple

import numpy as np

from nesy.compiled import njit
from planners.pomdp import TabularPOMDP
from planners.random_bits import stream, uniform
from planners.tree import Tree, allocate, backup_best, best_by_ucb, clear, find_child

_CHUNK = 256  # simulations between two looks at the clock


class PackedPOMDP(NamedTuple):
    """A `TabularPOMDP` in flat arrays; successors of (a, s) lie at begin[a, s] : begin[a, s + 1]."""

    begin: np.ndarray
    successor: np.ndarray
    cumulative: np.ndarray
    observation: np.ndarray  # float64 [A, S', O], cumulative
    reward: np.ndarray
    terminal: np.ndarray
    leaf: np.ndarray


def leaf_values(model: TabularPOMDP) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper value of every state, float64 [S] each: best blind policy, fully observed optimum."""
    lower = np.full(len(model.states), -np.inf)
    for matrix, reward in zip(model.transition, model.reward, strict=True):
        value = np.zeros(len(model.states))
        for _ in range(2000):
            after = reward + model.discount * (matrix @ value)
            done = np.abs(after - value).max() < 1e-9
            value = after
            if done:
                break
        lower = np.maximum(lower, value)
    return lower, model.fully_observed.max(axis=0)


def pack(model: TabularPOMDP, leaf: np.ndarray) -> PackedPOMDP:
    """The arrays of `model` for kernels; `leaf` float64 [S]."""
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
        np.ascontiguousarray(model.reward),
        np.ascontiguousarray(model.terminal),
        np.ascontiguousarray(leaf),
    )


class TreeSearch:
    """Anytime search in an explicit POMDP.

    Args:
        model: the POMDP.
        rng: seeds the search's own stream.
        simulations: per decision.
        depth: deepest step looked ahead.
        exploration: weight of UCB1's bonus; the range of the rewards by default.
        time_limit: seconds per decision after which to stop early; 0 for none.
        leaf: value of leaves: `lower`, `upper`, or the `middle` of the two.
    """

    def __init__(
        self,
        model: TabularPOMDP,
        rng: np.random.Generator,
        simulations: int = 2000,
        depth: int = 40,
        exploration: float | None = None,
        time_limit: float = 0.0,
        leaf: Literal["lower", "middle", "upper"] = "middle",
    ) -> None:
        lower, upper = leaf_values(model)
        if (lower > upper + 1e-6).any():
            worst = int((lower - upper).argmax())
            warnings.warn(
                f"lower bound above upper bound in state '{model.states[worst]}'", RuntimeWarning, stacklevel=2
            )
        weight = {"lower": 0.0, "middle": 0.5, "upper": 1.0}[leaf]
        self.model, self.packed = model, pack(model, (1 - weight) * lower + weight * upper)
        self.simulations, self.depth, self.time_limit = simulations, depth, time_limit
        self.exploration = float(np.ptp(model.reward)) if exploration is None else exploration
        self.tree = allocate(simulations + 2, len(model.actions))
        self._bits = stream(rng)

    def plan(self, belief: np.ndarray, allowed: np.ndarray | None = None) -> tuple[int, dict[str, Any]]:
        """Choose an action.

        Args:
            belief: float64 [S], sums to 1.
            allowed: bool [A], actions that a shield leaves; all by default.

        Returns:
            The action, and what the search saw: values, visits, simulations, nodes, mean and greatest depth.
        """
        mask = np.ones(len(self.model.actions), np.bool_) if allowed is None else np.asarray(allowed, np.bool_)
        if not mask.any():
            raise ValueError("a search needs at least one allowed action")
        clear(self.tree)
        support = np.flatnonzero(belief > 0)
        cumulative = np.cumsum(belief[support])
        cumulative /= cumulative[-1]
        depths = np.zeros(2, np.int64)
        started, done = time.perf_counter(), 0
        chunk = _CHUNK if self.time_limit > 0 else self.simulations
        while done < self.simulations:
            if self.time_limit > 0 and done and time.perf_counter() - started >= self.time_limit:
                break
            count = min(chunk, self.simulations - done)
            _simulate(
                self.packed,
                self.tree,
                support,
                cumulative,
                count,
                self.depth,
                self.model.discount,
                self.exploration,
                mask,
                self._bits,
                depths,
            )
            done += count
        visits, values = self.tree.q_visits[0].copy(), self.tree.q_value[0].copy()
        action = int(np.where(visits > 0, values, -np.inf).argmax())
        return action, {
            "values": values.tolist(),
            "visits": visits.tolist(),
            "simulations": done,
            "nodes": int(self.tree.size[0]),
            "mean_depth": float(depths[0] / max(done, 1)),
            "max_depth": int(depths[1]),
        }


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
    return total


@njit(cache=True)
def _simulate(
    model: PackedPOMDP,
    tree: Tree,
    support: np.ndarray,
    cumulative: np.ndarray,
    count: int,
    depth: int,
    discount: float,
    exploration: float,
    allowed: np.ndarray,
    bits: np.ndarray,
    depths: np.ndarray,
) -> None:
    nodes = np.zeros(depth, np.int64)
    actions = np.zeros(depth, np.int64)
    rewards = np.zeros(depth)
    everything = np.ones(allowed.shape[0], np.bool_)
    last = model.observation.shape[2] - 1
    for _ in range(count):
        number = uniform(bits)
        low, high = 0, support.shape[0] - 1
        while low < high:
            half = (low + high) // 2
            if number < cumulative[half]:
                high = half
            else:
                low = half + 1
        state = support[low]
        node, length, value = 0, 0, 0.0
        while length < depth and not model.terminal[state]:
            action = best_by_ucb(tree, node, exploration, allowed if node == 0 else everything)
            nodes[length], actions[length], rewards[length] = node, action, model.reward[action, state]
            length += 1
            entry, end = model.begin[action, state], model.begin[action, state + 1]
            number = uniform(bits)
            while entry < end - 1 and number >= model.cumulative[entry]:
                entry += 1
            state = model.successor[entry]
            number = uniform(bits)
            seen = 0
            while seen < last and number >= model.observation[action, state, seen]:
                seen += 1
            value = model.leaf[state]
            node = find_child(tree, node, action, seen, True)
            if node < 0:
                break
        if model.terminal[state]:
            value = 0.0
        leaf = -node - 1 if -tree.size[0] <= node < 0 else -1
        backup_best(tree, nodes, actions, rewards, length, leaf, value, discount)
        depths[0] += length
        depths[1] = max(depths[1], length)
