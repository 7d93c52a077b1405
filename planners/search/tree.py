"""A search tree in flat arrays, and the few operations that every search here is made of.

Nodes are beliefs, edges (action, observation). Node i has Q-values at q_value[i], visit counts at q_visits[i];
the child reached by (i, action, observation) is found through an open-addressing hash table, so observations
need no numbering and cost nothing before they occur. Actions are tried in their fixed order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nesy.compiled import njit

NO_CHILD = -9223372036854775807
"""What `find_child` answers where there is no child, or no room for one."""
_EMPTY = np.int64(-1)
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)


class Tree(NamedTuple):
    """The arrays of one tree.

    Attributes:
        size: int64 [1], nodes in use.
        visits: int64 [capacity].
        q_visits: int64 [capacity, A].
        q_value: float64 [capacity, A], mean return of the action.
        value: float64 [capacity], value of the node (`backup_best`): its leaf's, then that of its best action.
        gained, future: float64 [capacity, A], sums of rewards and of the values that followed (`backup_best`).
        depth: int32 [capacity], depth of the node below the root it was made under.
        key, owner, child: the hash table: observation, node * A + action (-1 if empty), node reached.
    """

    size: np.ndarray
    visits: np.ndarray
    q_visits: np.ndarray
    q_value: np.ndarray
    value: np.ndarray
    gained: np.ndarray
    future: np.ndarray
    depth: np.ndarray
    key: np.ndarray
    owner: np.ndarray
    child: np.ndarray


def allocate(capacity: int, num_actions: int) -> Tree:
    """An empty tree for at most `capacity` nodes, with its root (node 0) in place."""
    slots = 1 << int(np.ceil(np.log2(max(2 * capacity, 16))))
    return Tree(
        np.ones(1, np.int64),
        np.zeros(capacity, np.int64),
        np.zeros((capacity, num_actions), np.int64),
        np.zeros((capacity, num_actions)),
        np.zeros(capacity),
        np.zeros((capacity, num_actions)),
        np.zeros((capacity, num_actions)),
        np.zeros(capacity, np.int32),
        np.zeros(slots, np.int64),
        np.full(slots, _EMPTY),
        np.zeros(slots, np.int64),
    )


@njit(cache=True)
def clear(tree: Tree) -> None:
    """Forget everything; the root is node 0 again."""
    used = tree.size[0]
    for node in range(used):
        tree.visits[node] = 0
        tree.depth[node] = 0
        for a in range(tree.q_value.shape[1]):
            tree.q_visits[node, a] = 0
            tree.q_value[node, a] = 0.0
            tree.gained[node, a] = 0.0
            tree.future[node, a] = 0.0
    for slot in range(tree.owner.shape[0]):
        tree.owner[slot] = -1
    tree.size[0] = 1


@njit(cache=True)
def best_by_ucb(tree: Tree, node: int, exploration: float, allowed: np.ndarray) -> int:
    """The action with the highest upper confidence bound (UCB1); untried allowed actions first, in order."""
    num_actions = tree.q_value.shape[1]
    logarithm = np.log(tree.visits[node] + 1.0)
    best, best_score = -1, -np.inf
    for a in range(num_actions):
        if not allowed[a]:
            continue
        visits = tree.q_visits[node, a]
        if visits == 0:
            return a
        score = tree.q_value[node, a] + exploration * np.sqrt(logarithm / visits)
        if score > best_score:
            best, best_score = a, score
    return best


@njit(cache=True)
def find_child(tree: Tree, node: int, action: int, observation: int, add: bool) -> int:
    """The child of `node` by (action, observation).

    With `add`, a missing child is made; the answer is then -(index) - 1. Otherwise a missing child, or one that
    no longer fits into the tree, is answered with `NO_CHILD`.
    """
    num_actions = tree.q_value.shape[1]
    owner = node * num_actions + action
    mask = np.uint64(tree.owner.shape[0] - 1)
    mixed = (np.uint64(owner) * _MULTIPLIER) ^ np.uint64(observation)
    mixed = (mixed ^ (mixed >> np.uint64(29))) * _MULTIPLIER
    slot = (mixed ^ (mixed >> np.uint64(32))) & mask
    while tree.owner[slot] != -1:
        if tree.owner[slot] == owner and tree.key[slot] == observation:
            return tree.child[slot]
        slot = (slot + np.uint64(1)) & mask
    if not add or tree.size[0] >= tree.visits.shape[0]:
        return NO_CHILD
    made = tree.size[0]
    tree.size[0] = made + 1
    tree.owner[slot], tree.key[slot], tree.child[slot] = owner, observation, made
    tree.depth[made] = tree.depth[node] + 1
    return -made - 1


@njit(cache=True)
def backup(
    tree: Tree,
    nodes: np.ndarray,
    actions: np.ndarray,
    rewards: np.ndarray,
    length: int,
    leaf_value: float,
    discount: float,
) -> float:
    """Add one simulation: average its discounted return into the Q-values along its path; the root's return."""
    value = leaf_value
    for d in range(length - 1, -1, -1):
        value = rewards[d] + discount * value
        node, action = nodes[d], actions[d]
        tree.visits[node] += 1
        tree.q_visits[node, action] += 1
        tree.q_value[node, action] += (value - tree.q_value[node, action]) / tree.q_visits[node, action]
    return value


@njit(cache=True)
def backup_best(
    tree: Tree,
    nodes: np.ndarray,
    actions: np.ndarray,
    rewards: np.ndarray,
    length: int,
    leaf: int,
    leaf_value: float,
    discount: float,
) -> None:
    """Add one simulation with Bellman's backup: a node is worth its best action, not what was tried on average.

    `leaf` is the node that the simulation made, or -1 where it ended without making one (at the end of an episode,
    the greatest depth, or in a full tree); `leaf_value` is what followed.
    """
    before, after = 0.0, leaf_value  # visits times value of the child, before and after this simulation
    if leaf >= 0:
        tree.value[leaf] = leaf_value
    for d in range(length - 1, -1, -1):
        node, action = nodes[d], actions[d]
        old = tree.value[node] * (tree.visits[node] + 1)
        tree.visits[node] += 1
        tree.q_visits[node, action] += 1
        tree.gained[node, action] += rewards[d]
        tree.future[node, action] += after - before
        total = tree.gained[node, action] + discount * tree.future[node, action]
        tree.q_value[node, action] = total / tree.q_visits[node, action]
        best = -np.inf
        for a in range(tree.q_value.shape[1]):
            if tree.q_visits[node, a] > 0 and tree.q_value[node, a] > best:
                best = tree.q_value[node, a]
        tree.value[node] = best
        before, after = old, best * (tree.visits[node] + 1)


@njit(cache=True)
def reroot(tree: Tree, action: int, observation: int) -> bool:
    """Keep only what lies below (action, observation) of the root, which becomes the root.

    False, and the tree is as before, where there is nothing below.
    """
    top = find_child(tree, 0, action, observation, False)
    if top < 0 or tree.visits[top] == 0:
        return False
    num_actions = tree.q_value.shape[1]
    used = tree.size[0]
    owner, key = np.full(used, -1, np.int64), np.zeros(used, np.int64)
    for slot in range(tree.owner.shape[0]):
        if tree.owner[slot] != -1:
            owner[tree.child[slot]], key[tree.child[slot]] = tree.owner[slot], tree.key[slot]
            tree.owner[slot] = -1
    place = np.full(used, -1, np.int64)
    place[top] = 0
    size, depth = 0, tree.depth[top]
    for node in range(top, used):  # children come after their parents, so nothing is overwritten before it is moved
        if node != top:
            if owner[node] < 0 or place[owner[node] // num_actions] < 0:
                continue
            place[node] = size
        new = size
        size += 1
        tree.visits[new], tree.value[new] = tree.visits[node], tree.value[node]
        tree.depth[new] = tree.depth[node] - depth
        for a in range(num_actions):
            tree.q_visits[new, a], tree.q_value[new, a] = tree.q_visits[node, a], tree.q_value[node, a]
            tree.gained[new, a], tree.future[new, a] = tree.gained[node, a], tree.future[node, a]
    for node in range(size, used):
        tree.visits[node], tree.depth[node] = 0, 0
        for a in range(num_actions):
            tree.q_visits[node, a], tree.q_value[node, a] = 0, 0.0
            tree.gained[node, a], tree.future[node, a] = 0.0, 0.0
    tree.size[0] = 1
    for node in range(top + 1, used):
        if place[node] > 0:
            up = place[owner[node] // num_actions]
            tree.size[0] = place[node]
            find_child(tree, up, owner[node] % num_actions, key[node], True)
    tree.size[0] = size
    return True
