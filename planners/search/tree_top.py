"""The top of a search tree as plain data, for pictures: what was tried, how often, and what it was worth.

    node    {visits, actions: [{action, visits, value, after: [{seen, visits, actions}]}]}

Nodes are visited in the order of their visits; of each action's observations only the most visited are kept.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np

from planners.search.tree import Tree


def in_words(side: int, ahead: int) -> str:
    """A relative place in words."""
    across = f"{abs(side)} {'right' if side > 0 else 'left'}" if side else ""
    along = f"{abs(ahead)} {'ahead' if ahead > 0 else 'behind'}" if ahead else ""
    return ", ".join(filter(None, (across, along))) or "same cell"


def top_of_flat_tree(tree: Tree, name: Callable[[int], str], levels: int = 2, most: int = 3) -> dict[str, Any]:
    """The top `levels` levels of a tree in flat arrays.

    Args:
        tree: as a search left it.
        name: words for an observation.
        levels: how many levels of actions.
        most: observations kept per action.
    """
    num_actions = tree.q_value.shape[1]
    children: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for slot in np.flatnonzero(tree.owner >= 0):
        children[int(tree.owner[slot])].append((int(tree.child[slot]), int(tree.key[slot])))

    def node(index: int, level: int) -> dict[str, Any]:
        actions = []
        for action in range(num_actions):
            visits = int(tree.q_visits[index, action])
            if not visits:
                continue
            entry: dict[str, Any] = {
                "action": action,
                "visits": visits,
                "value": round(float(tree.q_value[index, action]), 3),
            }
            if level > 1:
                reached = sorted(children[index * num_actions + action], key=lambda c: (-int(tree.visits[c[0]]), c[1]))
                entry["after"] = [
                    {"seen": name(key), **node(child, level - 1)} for child, key in reached[:most] if tree.visits[child]
                ]
                entry["left_out"] = len(reached) - len(entry["after"])
            actions.append(entry)
        return {"visits": int(tree.visits[index]), "actions": actions}

    return node(0, levels)


def top_of_pomdp_py_tree(root: Any, name: Callable[[Any], str], levels: int = 2, most: int = 3) -> dict[str, Any]:
    """The same of a pomdp-py tree (`VNode` over `QNode`s)."""
    actions = []
    for action in sorted(root.children, key=lambda a: a.index):
        branch = root.children[action]
        if not branch.num_visits:
            continue
        entry: dict[str, Any] = {
            "action": int(action.index),
            "visits": int(branch.num_visits),
            "value": round(float(branch.value), 3),
        }
        if level_left := levels - 1:
            reached = sorted(
                ((seen, node) for seen, node in branch.children.items() if node.num_visits),
                key=lambda item: (-item[1].num_visits, name(item[0])),
            )
            entry["after"] = [
                {"seen": name(seen), **top_of_pomdp_py_tree(node, name, level_left, most)}
                for seen, node in reached[:most]
            ]
            entry["left_out"] = len(branch.children) - len(entry["after"])
        actions.append(entry)
    return {"visits": int(root.num_visits), "actions": actions}
