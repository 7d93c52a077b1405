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
from planners.explicit.bound_kernels import Ahead, BoundSet, FlatPOMDP, follow, look, lower_at, upper_at


class BeliefTree(NamedTuple):
    """A tree of beliefs in flat arrays; node 0 is the root, children come after their parents, siblings side by side.

    Attributes:
        size: int64 [4], nodes, rows and belief entries in use, and whether the last `grow` lacked room.
        lower, upper: float64 [N].
        error: float64 [N], how much the widest leaf below adds to the node's own width.
        chance: float64 [N], of the observation that leads here.
        best: int32 [N], the child on the way to that leaf; -1 at leaves.
        parent, action, seen, depth: int32 [N].
        visits: int32 [N], expansions at and below the node.
        row: int32 [N], where the arrays of nodes whose beliefs are known have this one; -1 for other leaves.
        q_lower, q_upper: float64 [R, A]; -inf where an action is not allowed.
        children: int32 [R, A + 1]; those of action a are children[row, a] : children[row, a + 1].
        begin: int64 [R + 1], where the beliefs lie in `held` and `value`.
    """

    size: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    error: np.ndarray
    chance: np.ndarray
    best: np.ndarray
    parent: np.ndarray
    action: np.ndarray
    seen: np.ndarray
    depth: np.ndarray
    visits: np.ndarray
    row: np.ndarray
    q_lower: np.ndarray
    q_upper: np.ndarray
    children: np.ndarray
    begin: np.ndarray
    held: np.ndarray
    value: np.ndarray


def allocate(nodes: int, rows: int, entries: int, num_actions: int) -> BeliefTree:
    """Room for `nodes` nodes, of which `rows` have beliefs, with `entries` states in all."""
    return BeliefTree._make(
        [
            np.zeros(4, np.int64),
            *(np.zeros(nodes) for _ in range(4)),
            *(np.zeros(nodes, np.int32) for _ in range(7)),
            np.zeros((rows, num_actions)),
            np.zeros((rows, num_actions)),
            np.zeros((rows, num_actions + 1), np.int32),
            np.zeros(rows + 1, np.int64),
            np.zeros(entries, np.int64),
            np.zeros(entries),
        ]
    )


def enlarged(tree: BeliefTree, most_nodes: int, most_entries: int) -> BeliefTree | None:
    """The tree with twice the room, within limits; None where they are reached."""
    nodes, rows, entries = len(tree.lower), len(tree.q_lower), len(tree.held)
    if nodes >= most_nodes or entries >= most_entries:
        return None
    larger = allocate(min(2 * nodes, most_nodes), 2 * rows, min(2 * entries, most_entries), tree.q_lower.shape[1])
    for before, after in zip(tree, larger, strict=True):
        after[: len(before)] = before
    return larger


@njit(cache=True)
def _add(tree: BeliefTree, parent: int, action: int, seen: int, chance: float, lower: float, upper: float) -> int:
    node = tree.size[0]
    tree.size[0] = node + 1
    tree.lower[node], tree.upper[node] = lower, upper
    tree.error[node], tree.best[node] = max(upper - lower, 0.0), -1
    tree.parent[node], tree.action[node], tree.seen[node] = parent, action, seen
    tree.depth[node] = tree.depth[parent] + 1 if parent >= 0 else 0
    tree.chance[node], tree.visits[node], tree.row[node] = chance, 0, -1
    return node


@njit(cache=True)
def plant(tree: BeliefTree, bounds: BoundSet, index: np.ndarray, value: np.ndarray, dense: np.ndarray) -> None:
    """Begin a tree at a belief, for which there must be room."""
    tree.size[:] = 0
    root = _add(tree, -1, -1, -1, 1.0, lower_at(bounds, index, value, dense)[0], upper_at(bounds, index, value, dense))
    _hold(tree, root, index, value)


@njit(cache=True)
def _hold(tree: BeliefTree, node: int, index: np.ndarray, value: np.ndarray) -> None:
    row, begin = tree.size[1], tree.size[2]
    end = begin + index.shape[0]
    tree.row[node] = row
    tree.begin[row], tree.begin[row + 1] = begin, end
    tree.children[row] = 0
    tree.held[begin:end] = index
    tree.value[begin:end] = value
    tree.size[1], tree.size[2] = row + 1, end


@njit(cache=True)
def grow(
    flat: FlatPOMDP,
    bounds: BoundSet,
    tree: BeliefTree,
    count: int,
    allowed: np.ndarray,
    tolerance: float,
    ahead: Ahead,
) -> int:
    """Expand up to `count` leaves; how many it was. Stops early when the answer is certain or the tree is full."""
    num_actions = flat.reward.shape[0]
    tree.size[3] = 0
    for done in range(count):
        if _settled(tree, tolerance):
            return done
        node = 0
        while tree.best[node] >= 0:
            node = tree.best[node]
        if tree.row[node] < 0:
            up = tree.row[tree.parent[node]]
            at, end = tree.begin[up], tree.begin[up + 1]
            index, value, _ = follow(
                flat, tree.held[at:end], tree.value[at:end], tree.action[node], tree.seen[node], ahead.dense
            )
            if tree.size[2] + index.shape[0] > tree.held.shape[0] or tree.size[1] == tree.q_lower.shape[0]:
                tree.size[3] = 1
                return done
            _hold(tree, node, index, value)
        row = tree.row[node]
        at, end = tree.begin[row], tree.begin[row + 1]
        look(flat, bounds, tree.held[at:end], tree.value[at:end], ahead)
        if tree.size[0] + np.count_nonzero(ahead.chances) > tree.lower.shape[0]:
            tree.size[3] = 1
            return done
        for a in range(num_actions):
            tree.children[row, a] = tree.size[0]
            if node == 0 and not allowed[a]:
                tree.q_lower[row, a], tree.q_upper[row, a] = -np.inf, -np.inf
                continue
            tree.q_lower[row, a], tree.q_upper[row, a] = ahead.q_lower[a], ahead.q_upper[a]
            for o in range(flat.num_observations):
                if ahead.chances[a, o] > 0.0:
                    _add(tree, node, a, o, ahead.chances[a, o], ahead.lowers[a, o], ahead.uppers[a, o])
        tree.children[row, num_actions] = tree.size[0]
        _refresh(tree, node, flat.discount)
    return count


@njit(cache=True)
def _refresh(tree: BeliefTree, node: int, discount: float) -> None:
    """Carry the bounds of a newly expanded node up to the root."""
    while True:
        tree.visits[node] += 1
        row = tree.row[node]
        low, high, action = -np.inf, -np.inf, 0
        for a in range(tree.q_lower.shape[1]):
            low = max(low, tree.q_lower[row, a])
            if tree.q_upper[row, a] > high:
                high, action = tree.q_upper[row, a], a
        up = tree.parent[node]
        # At the root a mask may exclude the actions that the bounds of the whole model count on.
        low = max(low, tree.lower[node]) if up >= 0 else low
        high = min(high, tree.upper[node]) if up >= 0 else high
        gained, shed = low - tree.lower[node], high - tree.upper[node]
        tree.lower[node], tree.upper[node] = low, high
        tree.error[node], tree.best[node] = -1.0, -1
        for child in range(tree.children[row, action], tree.children[row, action + 1]):
            error = discount * tree.chance[child] * tree.error[child]
            if error > tree.error[node]:
                tree.error[node], tree.best[node] = error, child
        if up < 0:
            return
        share, above = discount * tree.chance[node], tree.row[up]
        tree.q_lower[above, tree.action[node]] += share * gained
        tree.q_upper[above, tree.action[node]] += share * shed
        node = up


@njit(cache=True)
def _settled(tree: BeliefTree, tolerance: float) -> bool:
    """Whether one action of the root is certainly best, or nothing is left to gain."""
    if tree.visits[0] == 0:
        return False
    if tree.error[0] <= tolerance:
        return True
    row, best = tree.row[0], 0
    for a in range(tree.q_lower.shape[1]):
        if tree.q_lower[row, a] > tree.q_lower[row, best]:
            best = a
    for a in range(tree.q_lower.shape[1]):
        if a != best and tree.q_upper[row, a] > tree.q_lower[row, best] + tolerance:
            return False
    return True


@njit(cache=True)
def child_of(tree: BeliefTree, action: int, seen: int) -> int:
    """The node below (action, observation) of the root; -1 where there is none."""
    row = tree.row[0]
    for child in range(tree.children[row, action], tree.children[row, action + 1]):
        if tree.seen[child] == seen:
            return child
    return -1


@njit(cache=True)
def reroot(tree: BeliefTree, action: int, seen: int, target: BeliefTree) -> bool:
    """Copy what lies below (action, observation) of the root into `target`, as large; false where nothing does."""
    top = child_of(tree, action, seen) if tree.visits[0] > 0 else -1
    if top < 0 or tree.row[top] < 0:
        return False
    place = np.full(tree.size[0], -1, np.int64)
    target.size[:] = 0
    for node in range(top, tree.size[0]):  # parents come before children
        if node != top and place[tree.parent[node]] < 0:
            continue
        parent = place[tree.parent[node]] if node != top else -1
        new = _add(
            target, parent, tree.action[node], tree.seen[node], tree.chance[node], tree.lower[node], tree.upper[node]
        )
        place[node] = new
        target.error[new], target.visits[new] = tree.error[node], tree.visits[node]
        if parent >= 0 and tree.best[tree.parent[node]] == node:
            target.best[parent] = new
        row = tree.row[node]
        if row >= 0:
            at, end = tree.begin[row], tree.begin[row + 1]
            _hold(target, new, tree.held[at:end], tree.value[at:end])
            below = target.row[new]
            target.q_lower[below], target.q_upper[below] = tree.q_lower[row], tree.q_upper[row]
    for node in range(top, tree.size[0]):
        row = tree.row[node]
        if place[node] < 0 or row < 0 or tree.children[row, 0] == tree.children[row, -1]:
            continue
        shift = place[tree.children[row, 0]] - tree.children[row, 0]
        for a in range(tree.children.shape[1]):
            target.children[target.row[place[node]], a] = tree.children[row, a] + shift
    return True
