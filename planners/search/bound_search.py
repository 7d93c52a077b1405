"""Online search in an explicit POMDP with exact beliefs and two bounds (anytime error minimisation, AEMS2).

    node    a belief b with L(b) <= V(b) <= U(b), from planners.explicit.bound_kernels
    expand  the leaf that most widens the root's bounds: discount^depth x chance of the way there x (U - L), along the
            actions with the highest upper bound
    answer  the action with the highest lower bound

Only possible observations make branches. Where the search may not end before its budget, what it says is still
certain: the optimum lies between the root's bounds. Source: Ross, Pineau, Paquet, Chaib-draa 2008.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nesy.compiled import njit
from planners.explicit.bound_kernels import BoundSet, FlatPOMDP, follow, look, lower_at, upper_at


class BeliefTree(NamedTuple):
    """A tree of beliefs in flat arrays; node 0 is the root, children come after their parents.

    Attributes:
        size: int64 [2], nodes and belief entries in use.
        lower, upper: float64 [capacity].
        error: float64 [capacity], how much the widest leaf below adds to the node's own width.
        best: int64 [capacity], the child on the way to that leaf; -1 at leaves.
        parent, action, seen, depth: int64 [capacity].
        chance: float64 [capacity], of the observation that leads here.
        q_lower, q_upper: float64 [capacity, A]; -inf where an action is not allowed.
        child: int64 [capacity, A, O], -1 where there is none.
        begin: int64 [capacity, 2], where an expanded node's belief lies in `held` and `value`; -1 before.
        visits: int64 [capacity], expansions at and below the node.
    """

    size: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    error: np.ndarray
    best: np.ndarray
    parent: np.ndarray
    action: np.ndarray
    seen: np.ndarray
    depth: np.ndarray
    chance: np.ndarray
    q_lower: np.ndarray
    q_upper: np.ndarray
    child: np.ndarray
    begin: np.ndarray
    visits: np.ndarray
    held: np.ndarray
    value: np.ndarray


def allocate(capacity: int, entries: int, num_actions: int, num_observations: int) -> BeliefTree:
    """Room for `capacity` nodes and `entries` states of beliefs."""
    whole = [np.zeros(capacity, np.int64) for _ in range(5)]
    real = [np.zeros(capacity) for _ in range(4)]
    return BeliefTree(
        np.zeros(2, np.int64),
        real[0],
        real[1],
        real[2],
        whole[0],
        whole[1],
        whole[2],
        whole[3],
        whole[4],
        real[3],
        np.zeros((capacity, num_actions)),
        np.zeros((capacity, num_actions)),
        np.full((capacity, num_actions, num_observations), -1, np.int64),
        np.full((capacity, 2), -1, np.int64),
        np.zeros(capacity, np.int64),
        np.zeros(entries, np.int64),
        np.zeros(entries),
    )


@njit(cache=True)
def _add(tree: BeliefTree, parent: int, action: int, seen: int, chance: float, lower: float, upper: float) -> int:
    node = tree.size[0]
    tree.size[0] = node + 1
    tree.lower[node], tree.upper[node] = lower, upper
    tree.error[node], tree.best[node] = max(upper - lower, 0.0), -1
    tree.parent[node], tree.action[node], tree.seen[node] = parent, action, seen
    tree.depth[node] = tree.depth[parent] + 1 if parent >= 0 else 0
    tree.chance[node], tree.visits[node] = chance, 0
    tree.begin[node, 0], tree.begin[node, 1] = -1, -1
    tree.child[node] = -1
    return node


@njit(cache=True)
def plant(tree: BeliefTree, bounds: BoundSet, index: np.ndarray, value: np.ndarray, dense: np.ndarray) -> None:
    """Begin a tree at a belief."""
    tree.size[0], tree.size[1] = 0, 0
    root = _add(tree, -1, -1, -1, 1.0, lower_at(bounds, index, value, dense)[0], upper_at(bounds, index, value, dense))
    _hold(tree, root, index, value)


@njit(cache=True)
def _hold(tree: BeliefTree, node: int, index: np.ndarray, value: np.ndarray) -> None:
    begin = tree.size[1]
    end = begin + index.shape[0]
    tree.begin[node, 0], tree.begin[node, 1] = begin, end
    tree.held[begin:end] = index
    tree.value[begin:end] = value
    tree.size[1] = end


@njit(cache=True)
def grow(flat: FlatPOMDP, bounds: BoundSet, tree: BeliefTree, count: int, allowed: np.ndarray, tolerance: float) -> int:
    """Expand up to `count` leaves; how many it was. Stops early when the answer is certain or the tree is full."""
    num_actions, num_states = flat.reward.shape
    num_observations = flat.observation.shape[2]
    dense, other = np.zeros(num_states), np.zeros(num_states)
    q_lower, q_upper = np.zeros(num_actions), np.zeros(num_actions)
    chosen = np.zeros((num_actions, num_observations), np.int64)
    chances = np.zeros((num_actions, num_observations))
    lowers, uppers = np.zeros((num_actions, num_observations)), np.zeros((num_actions, num_observations))
    for done in range(count):
        if _settled(tree, tolerance) or tree.size[0] + num_actions * num_observations > tree.lower.shape[0]:
            return done
        node = 0
        while tree.best[node] >= 0:
            node = tree.best[node]
        if tree.begin[node, 0] < 0:
            up = tree.parent[node]
            at, end = tree.begin[up, 0], tree.begin[up, 1]
            index, value, _ = follow(
                flat, tree.held[at:end], tree.value[at:end], tree.action[node], tree.seen[node], dense
            )
            if tree.size[1] + index.shape[0] > tree.held.shape[0]:
                return done
            _hold(tree, node, index, value)
        at, end = tree.begin[node, 0], tree.begin[node, 1]
        look(
            flat,
            bounds,
            tree.held[at:end],
            tree.value[at:end],
            dense,
            other,
            q_lower,
            q_upper,
            chosen,
            chances,
            lowers,
            uppers,
        )
        for a in range(num_actions):
            if node == 0 and not allowed[a]:
                tree.q_lower[node, a], tree.q_upper[node, a] = -np.inf, -np.inf
                continue
            tree.q_lower[node, a], tree.q_upper[node, a] = q_lower[a], q_upper[a]
            for o in range(num_observations):
                if chances[a, o] > 0.0:
                    tree.child[node, a, o] = _add(tree, node, a, o, chances[a, o], lowers[a, o], uppers[a, o])
        _refresh(tree, node, flat.discount)
    return count


@njit(cache=True)
def _refresh(tree: BeliefTree, node: int, discount: float) -> None:
    """Carry the bounds of a newly expanded node up to the root."""
    num_actions, num_observations = tree.child.shape[1], tree.child.shape[2]
    while True:
        tree.visits[node] += 1
        low, high, action = -np.inf, -np.inf, 0
        for a in range(num_actions):
            low = max(low, tree.q_lower[node, a])
            if tree.q_upper[node, a] > high:
                high, action = tree.q_upper[node, a], a
        up = tree.parent[node]
        # At the root a mask may exclude the actions that the bounds of the whole model count on.
        low = max(low, tree.lower[node]) if up >= 0 else low
        high = min(high, tree.upper[node]) if up >= 0 else high
        gained, shed = low - tree.lower[node], high - tree.upper[node]
        tree.lower[node], tree.upper[node] = low, high
        tree.error[node], tree.best[node] = -1.0, -1
        for o in range(num_observations):
            child = tree.child[node, action, o]
            if child >= 0:
                error = discount * tree.chance[child] * tree.error[child]
                if error > tree.error[node]:
                    tree.error[node], tree.best[node] = error, child
        if up < 0:
            return
        share = discount * tree.chance[node]
        tree.q_lower[up, tree.action[node]] += share * gained
        tree.q_upper[up, tree.action[node]] += share * shed
        node = up


@njit(cache=True)
def _settled(tree: BeliefTree, tolerance: float) -> bool:
    """Whether one action of the root is certainly best, or nothing is left to gain."""
    if tree.visits[0] == 0:
        return False
    if tree.error[0] <= tolerance:
        return True
    best = 0
    for a in range(tree.q_lower.shape[1]):
        if tree.q_lower[0, a] > tree.q_lower[0, best]:
            best = a
    for a in range(tree.q_lower.shape[1]):
        if a != best and tree.q_upper[0, a] > tree.q_lower[0, best] + tolerance:
            return False
    return True


@njit(cache=True)
def reroot(tree: BeliefTree, action: int, seen: int, target: BeliefTree) -> bool:
    """Copy what lies below (action, observation) of the root into `target`; false where nothing does."""
    top = tree.child[0, action, seen] if tree.visits[0] > 0 else -1
    if top < 0 or tree.begin[top, 0] < 0:
        return False
    place = np.full(tree.size[0], -1, np.int64)
    target.size[0], target.size[1] = 0, 0
    for node in range(top, tree.size[0]):  # parents come before children
        if node != top and place[tree.parent[node]] < 0:
            continue
        parent = place[tree.parent[node]] if node != top else -1
        new = _add(
            target, parent, tree.action[node], tree.seen[node], tree.chance[node], tree.lower[node], tree.upper[node]
        )
        place[node] = new
        target.error[new], target.visits[new] = tree.error[node], tree.visits[node]
        target.q_lower[new], target.q_upper[new] = tree.q_lower[node], tree.q_upper[node]
        if parent >= 0:
            target.child[parent, tree.action[node], tree.seen[node]] = new
            if tree.best[tree.parent[node]] == node:
                target.best[parent] = new
        if tree.begin[node, 0] >= 0:
            at, end = tree.begin[node, 0], tree.begin[node, 1]
            _hold(target, new, tree.held[at:end], tree.value[at:end])
    return True
