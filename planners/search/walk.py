"""One simulation kernel for every search by sampled walks (PO-UCT), whatever the model.

    s ~ b;  until a new node, an end or the depth limit:  a by UCB1,  (s', r, o) ~ model,  node <- child (a, o)
    value of the new node: the model's leaf value of s';  then back up

A model says how to start a walk, how to take a step, what a step shows and what a state is worth. Three do: explicit
POMDPs (`PackedPOMDP`), a 2DBN with rewards on its factors (`FactoredModel`, of which some factors are seen) and the
influence-augmented local model (`LocalModel`, branching on the person's pose where it is seen and on whether the
robot moved, not on the 8^8 codes). Which one a compiled walk uses is settled by types.
Sources: Silver and Veness 2010 (PO-UCT); Kocsis and Szepesvari 2006 (UCB1).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from nesy.compiled import njit, overload
from planners.person_following import ialm
from planners.person_following.ialm import SCALARS
from planners.person_following.kernels import Model, step
from planners.person_following.structured.drawn_maps.mapped_walk import mapped_advance, mapped_begin, mapped_room
from planners.person_following.structured.known_maps.mind_walk import mind_advance, mind_begin, mind_room
from planners.search.code_sampling import CodeSampler, next_code
from planners.search.random_bits import drawn, uniform
from planners.search.tree import NO_CHILD, Tree, backup, backup_best, best_by_ucb, find_child

_FIRST = 16
"""Simulations, where time is limited, before it is known how many fit."""


class PackedPOMDP(NamedTuple):
    """A `TabularPOMDP` in flat arrays; successors of (a, s) lie at begin[a, s] : begin[a, s + 1]."""

    begin: np.ndarray
    successor: np.ndarray
    cumulative: np.ndarray
    observation: np.ndarray  # float64 [A, S', O], cumulative
    reward: np.ndarray
    terminal: np.ndarray
    leaf: np.ndarray


class TabularBelief(NamedTuple):
    """A belief over states: those it allows, int64 [n], and their cumulative probabilities."""

    support: np.ndarray
    cumulative: np.ndarray


class FactoredModel(NamedTuple):
    """A 2DBN as a decision problem; beliefs are particles int16 [P, N]. Leaves are worth nothing.

    Attributes:
        codes: the 2DBN, for drawing.
        reward: float64 [N, K], what each value of each factor earns in the state reached.
        paid: int64 [R], the factors that earn anything.
        seen: int64 [M], the factors that the robot observes.
    """

    codes: CodeSampler
    reward: np.ndarray
    paid: np.ndarray
    seen: np.ndarray

    @classmethod
    def of(cls, codes: CodeSampler, reward: np.ndarray, seen: np.ndarray) -> FactoredModel:
        """The model of a sampler with these rewards and these observed factors."""
        return cls(codes, reward, np.flatnonzero(reward.any(axis=1)), seen)


class LocalModel(NamedTuple):
    """The influence-augmented local model, and what its leaves are worth; beliefs are particles int16 [P, 2N + 5]."""

    model: Model
    leaf_values: np.ndarray  # float64 [2W + 1, 2W + 1, 4, L]


def room(model: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arrays for one walk: a state, the next one, and scratch."""
    return _room_of(model)(model)


def begin(model: Any, belief: Any, state: np.ndarray, bits: np.ndarray) -> bool:
    """Draw a start into `state`; false where that state is an end."""
    return _begin_of(model)(model, belief, state, bits)


def advance(
    model: Any, state: np.ndarray, action: int, after: np.ndarray, scratch: np.ndarray, bits: np.ndarray
) -> tuple[float, bool, int, float]:
    """Draw a step: (reward, whether it ended, what is seen as one integer, what the state reached is worth)."""
    return _advance_of(model)(model, state, action, after, scratch, bits)


def _tabular_room(model: PackedPOMDP) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1, np.int64)


def _tabular_begin(model: PackedPOMDP, belief: TabularBelief, state: np.ndarray, bits: np.ndarray) -> bool:
    state[0] = belief.support[drawn(belief.cumulative, bits)]
    return not model.terminal[state[0]]


def _tabular_advance(
    model: PackedPOMDP, state: np.ndarray, action: int, after: np.ndarray, scratch: np.ndarray, bits: np.ndarray
) -> tuple[float, bool, int, float]:
    entry, end = model.begin[action, state[0]], model.begin[action, state[0] + 1]
    number = uniform(bits)
    while entry < end - 1 and number >= model.cumulative[entry]:
        entry += 1
    reached = model.successor[entry]
    number = uniform(bits)
    seen, last = 0, model.observation.shape[2] - 1
    while seen < last and number >= model.observation[action, reached, seen]:
        seen += 1
    after[0] = reached
    return model.reward[action, state[0]], model.terminal[reached], seen, model.leaf[reached]


def _factored_room(model: FactoredModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = model.codes.plan.shape[1]
    return np.zeros(n, np.int16), np.zeros(n, np.int16), np.zeros(1, np.int16)


def _factored_begin(model: FactoredModel, belief: np.ndarray, state: np.ndarray, bits: np.ndarray) -> bool:
    particle = np.int64(uniform(bits) * belief.shape[0])
    for i in range(state.shape[0]):
        state[i] = belief[particle, i]
    return True


def _factored_advance(
    model: FactoredModel, state: np.ndarray, action: int, after: np.ndarray, scratch: np.ndarray, bits: np.ndarray
) -> tuple[float, bool, int, float]:
    next_code(model.codes, state, 0, action, after, 0, bits)
    reward, key = 0.0, 0
    for j in range(model.paid.shape[0]):
        reward += model.reward[model.paid[j], after[model.paid[j]]]
    for j in range(model.seen.shape[0]):
        key = key * model.reward.shape[1] + after[model.seen[j]]
    return reward, False, key, 0.0


def _local_room(model: LocalModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = model.model.dbn.order.shape[0]
    return (
        np.zeros(2 * n + ialm.STATE_SCALARS, np.int16),
        np.zeros(2 * n + ialm.STATE_SCALARS, np.int16),
        np.zeros(3 * n + len(SCALARS), np.int16),
    )


def _local_begin(model: LocalModel, belief: np.ndarray, state: np.ndarray, bits: np.ndarray) -> bool:
    particle = np.int64(uniform(bits) * belief.shape[0])
    for i in range(state.shape[0]):
        state[i] = belief[particle, i]
    return True


def _local_advance(
    model: LocalModel, state: np.ndarray, action: int, after: np.ndarray, scratch: np.ndarray, bits: np.ndarray
) -> tuple[float, bool, int, float]:
    n = model.model.dbn.order.shape[0]
    reward, outcome, visible = step(model.model, state, action, after, scratch, bits)
    lost = min(int(after[2 * n + 4]), model.leaf_values.shape[3] - 1)
    leaf = model.leaf_values[after[2 * n], after[2 * n + 1], after[2 * n + 2], lost]
    return reward, outcome != 0, seen_key(scratch, after, n, visible), leaf


@njit(cache=True)
def seen_key(scratch: np.ndarray, after: np.ndarray, n: int, visible: int) -> int:
    """What a step of the local model shows, as one integer: the robot's motion, and the person's pose if in view."""
    key = int(scratch[3 * n + ialm.MOTION])
    if visible != 0:
        key += 4 * ((int(after[2 * n]) * 512 + after[2 * n + 1]) * 4 + after[2 * n + 2] + 1)
    return key


_KINDS: dict[str, tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]] = {
    "PackedPOMDP": (_tabular_room, _tabular_begin, _tabular_advance),
    "FactoredModel": (_factored_room, _factored_begin, _factored_advance),
    "LocalModel": (_local_room, _local_begin, _local_advance),
    "MindTree": (mind_room, mind_begin, mind_advance),
    "MappedTree": (mapped_room, mapped_begin, mapped_advance),
}


def _kind(model: Any) -> str:
    return getattr(model, "instance_class", type(model)).__name__


def _room_of(model: Any) -> Callable[..., Any]:
    return _KINDS[_kind(model)][0]


def _begin_of(model: Any) -> Callable[..., Any]:
    return _KINDS[_kind(model)][1]


def _advance_of(model: Any) -> Callable[..., Any]:
    return _KINDS[_kind(model)][2]


@overload(room)
def _typed_room(model: Any) -> Any:
    return _room_of(model)


@overload(begin)
def _typed_begin(model: Any, belief: Any, state: Any, bits: Any) -> Any:
    return _begin_of(model)


@overload(advance)
def _typed_advance(model: Any, state: Any, action: Any, after: Any, scratch: Any, bits: Any) -> Any:
    return _advance_of(model)


@njit(cache=True)
def walk(
    model: Any,
    belief: Any,
    tree: Tree,
    count: int,
    depth: int,
    discount: float,
    exploration: float,
    bellman: bool,
    rollout: bool,
    allowed: np.ndarray,
    bits: np.ndarray,
    depths: np.ndarray,
) -> None:
    """`count` simulations from the root of `tree`.

    Args:
        model: a `PackedPOMDP`, a `FactoredModel` or a `LocalModel`.
        belief: a `TabularBelief`, or particles.
        tree: grows by at most one node per simulation.
        count: simulations.
        depth: deepest step.
        discount: per step.
        exploration: weight of UCB1's bonus.
        bellman: whether a node is worth its best action; otherwise what was earned on average.
        rollout: whether a new node is valued by random actions down to `depth`, not by the model's leaf value.
        allowed: bool [A], actions at the root.
        bits: the random stream.
        depths: int64 [2], adds the lengths of the walks, and keeps the greatest.
    """
    state, after, scratch = room(model)
    nodes, actions, rewards = np.zeros(depth, np.int64), np.zeros(depth, np.int64), np.zeros(depth)
    everything = np.ones(allowed.shape[0], np.bool_)
    for _ in range(count):
        if not begin(model, belief, state, bits):
            continue
        node, length, value = 0, 0, 0.0
        while length < depth:
            action = best_by_ucb(tree, node, exploration, allowed if node == 0 else everything)
            reward, ended, seen, leaf_value = advance(model, state, action, after, scratch, bits)
            nodes[length], actions[length], rewards[length] = node, action, reward
            length += 1
            state, after = after, state
            value = 0.0 if ended else leaf_value
            if ended:
                node = NO_CHILD
                break
            node = find_child(tree, node, action, seen, True)
            if node < 0:
                break
        steps = length
        if rollout and node != NO_CHILD:
            value, share = 0.0, 1.0
            while steps < depth:
                action = min(int(uniform(bits) * allowed.shape[0]), allowed.shape[0] - 1)
                reward, ended, seen, leaf_value = advance(model, state, action, after, scratch, bits)
                state, after = after, state
                value += share * reward
                share *= discount
                steps += 1
                if ended:
                    break
        if bellman:
            made = -node - 1 if -tree.size[0] <= node < 0 else -1
            backup_best(tree, nodes, actions, rewards, length, made, value, discount)
        else:
            backup(tree, nodes, actions, rewards, length, value, discount)
        depths[0] += steps
        depths[1] = max(depths[1], steps)


def walks(
    model: Any,
    belief: Any,
    tree: Tree,
    simulations: int,
    time_limit: float,
    depth: int,
    discount: float,
    exploration: float,
    bellman: bool,
    allowed: np.ndarray,
    bits: np.ndarray,
    rollout: bool = False,
) -> dict[str, Any]:
    """Simulate up to `simulations` times, for at most `time_limit` seconds (0: no limit); what came of it.

    However short the limit is, a few simulations are made.

    Returns:
        values and visits per action of the root, simulations, nodes, mean and greatest depth, and `full`: whether
        the tree had no room left.
    """
    depths = np.zeros(2, np.int64)
    started, done = time.perf_counter(), 0
    count = min(_FIRST if time_limit > 0 else simulations, simulations)
    while count:
        walk(model, belief, tree, count, depth, discount, exploration, bellman, rollout, allowed, bits, depths)
        done += count
        gone = time.perf_counter() - started
        # As many as should fit into most of what is left, so that the last ones do not outlast it by much.
        fitting = int(0.7 * done / max(gone, 1e-9) * (time_limit - gone)) if time_limit > 0 else simulations
        count = max(min(fitting, simulations - done), 0)
    size = int(tree.size[0])
    return {
        "values": tree.q_value[0].tolist(),
        "visits": tree.q_visits[0].tolist(),
        "simulations": done,
        "nodes": size,
        "mean_depth": float(depths[0] / max(done, 1)),
        "max_depth": int(depths[1]),
        "full": size >= len(tree.visits),
    }


def best_tried(info: dict[str, Any], allowed: np.ndarray) -> int:
    """The allowed action with the highest value among those tried; the first allowed one where none was."""
    tried = np.where(allowed & (np.array(info["visits"]) > 0), info["values"], -np.inf)
    return int(tried.argmax()) if np.isfinite(tried).any() else int(np.argmax(allowed))
