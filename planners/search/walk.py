"""One simulation kernel for every search by sampled walks (PO-UCT), whatever the model.

    s ~ b;  until a new node, an end or the depth limit:  a by UCB1,  (s', r, o) ~ model,  node <- child (a, o)
    value of the new node: the model's leaf value of s';  then back up

A model is a NamedTuple of arrays whose type is registered with three functions that numba can compile (`register`):
how to start a walk, how to take a step with what it shows, and what a state is worth. Which ones a compiled walk uses
is settled by the model's type.
Sources: Silver and Veness 2010 (PO-UCT); Kocsis and Szepesvari 2006 (UCB1).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from nesy.compiled import njit, overload
from planners.search.random_bits import uniform
from planners.search.tree import NO_CHILD, Tree, backup, backup_best, best_by_ucb, find_child

_FIRST = 16
"""Simulations, where time is limited, before it is known how many fit."""


class Kernels(NamedTuple):
    """How a kind of model is walked through.

    Attributes:
        room: (model) -> arrays for one walk: a state, the next one, and scratch.
        begin: (model, belief, state, bits) -> whether the walk goes on; draws a start into `state`.
        advance: (model, state, action, after, scratch, bits) -> a step, as `advance` returns it.
    """

    room: Callable[..., Any]
    begin: Callable[..., Any]
    advance: Callable[..., Any]


_KERNELS: dict[type, Kernels] = {}


def register(kind: type, kernels: Kernels) -> None:
    """Let models of the NamedTuple `kind` be walked through."""
    _KERNELS[kind] = kernels


def _kernels_of(model: Any) -> Kernels:
    """Of a model, or of its numba type."""
    return _KERNELS[getattr(model, "instance_class", type(model))]


def room(model: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arrays for one walk: a state, the next one, and scratch."""
    return _kernels_of(model).room(model)


def begin(model: Any, belief: Any, state: np.ndarray, bits: np.ndarray) -> bool:
    """Draw a start into `state`; false where that state is an end."""
    return _kernels_of(model).begin(model, belief, state, bits)


def advance(
    model: Any, state: np.ndarray, action: int, after: np.ndarray, scratch: np.ndarray, bits: np.ndarray
) -> tuple[float, bool, int, float]:
    """Draw a step: (reward, whether it ended, what is seen as one integer, what the state reached is worth)."""
    return _kernels_of(model).advance(model, state, action, after, scratch, bits)


@overload(room)
def _typed_room(model: Any) -> Any:
    return _kernels_of(model).room


@overload(begin)
def _typed_begin(model: Any, belief: Any, state: Any, bits: Any) -> Any:
    return _kernels_of(model).begin


@overload(advance)
def _typed_advance(model: Any, state: Any, action: Any, after: Any, scratch: Any, bits: Any) -> Any:
    return _kernels_of(model).advance


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
        model: of a registered kind.
        belief: of the kind that the model's `begin` takes.
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
