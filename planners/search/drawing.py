"""Drawings of search trees: DOT for other tools, and SVG that needs none.

A tree becomes a list of nodes first, so that both kinds of trees (tree, bound_search) are drawn by
the same code: the most visited branches, down to a depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np

from nesy.errors import UserError
from planners.search.bound_search import BeliefTree
from planners.search.tree import Tree

_MOST = 200  # nodes drawn
_BOX, _GAP, _LEVEL = 104, 12, 74  # width of a node, space between two, height of a level


@dataclass(frozen=True)
class Drawn:
    """One node of a drawing: its label, the node above (-1 at the root), the label of the edge, and its depth."""

    label: str
    parent: int
    edge: str
    depth: int


def drawing_of(
    tree: Tree | BeliefTree,
    actions: Sequence[str],
    observations: Sequence[str] | None,
    depth: int,
    format: Literal["dot", "svg"],
) -> str:
    """Draw a tree.

    Args:
        tree: as the last `plan` left it.
        actions: names of the actions.
        observations: names of the observations; their numbers by default.
        depth: deepest step drawn.
        format: `dot` or `svg`.

    Raises:
        UserError: another format.
    """
    nodes = _beliefs(tree, actions, observations, depth) if isinstance(tree, BeliefTree) else None
    if nodes is None:
        assert isinstance(tree, Tree)
        nodes = _walks(tree, actions, observations, depth)
    if format == "dot":
        return _dot(nodes)
    if format == "svg":
        return _svg(nodes)
    raise UserError(f"a drawing is 'dot' or 'svg', not '{format}'")


def _name(names: Sequence[str] | None, i: int) -> str:
    return names[i] if names is not None and 0 <= i < len(names) else str(i)


def _chosen(parent: np.ndarray, depth: np.ndarray, visits: np.ndarray, deepest: int) -> dict[int, int]:
    """Nodes to draw -> their number in the drawing: the most visited ones whose parents are drawn as well."""
    candidates = [n for n in range(len(parent)) if depth[n] <= deepest and (n == 0 or visits[n] > 0)]
    kept = sorted(sorted(candidates, key=lambda n: (n != 0, -visits[n], n))[:_MOST])
    place: dict[int, int] = {}
    for node in kept:
        if node == 0 or int(parent[node]) in place:
            place[node] = len(place)
    return place


def _beliefs(tree: BeliefTree, actions: Sequence[str], observations: Sequence[str] | None, deepest: int) -> list[Drawn]:
    size = int(tree.size[0])
    place = _chosen(tree.parent[:size], tree.depth[:size], tree.visits[:size], deepest)
    return [
        Drawn(
            f"{tree.lower[n]:.2f} to {tree.upper[n]:.2f}, n={tree.visits[n]}",
            place.get(int(tree.parent[n]), -1),
            "" if n == 0 else f"{_name(actions, int(tree.action[n]))} / {_name(observations, int(tree.seen[n]))}",
            int(tree.depth[n]),
        )
        for n in place
    ]


def _walks(tree: Tree, actions: Sequence[str], observations: Sequence[str] | None, deepest: int) -> list[Drawn]:
    size, num_actions = int(tree.size[0]), tree.q_value.shape[1]
    owner, key = np.full(size, -1, np.int64), np.zeros(size, np.int64)
    used = np.flatnonzero(tree.owner >= 0)
    owner[tree.child[used]], key[tree.child[used]] = tree.owner[used], tree.key[used]
    parent = np.where(owner >= 0, owner // num_actions, -1)
    place = _chosen(parent, tree.depth[:size], tree.visits[:size], deepest)
    out = []
    for n in place:
        tried = np.where(tree.q_visits[n] > 0, tree.q_value[n], -np.inf)
        best = int(tried.argmax())
        label = f"n={tree.visits[n]}"
        if np.isfinite(tried[best]):
            label = f"{_name(actions, best)} {tried[best]:.2f}, {label}"
        edge = "" if n == 0 else f"{_name(actions, int(owner[n] % num_actions))} / {_name(observations, int(key[n]))}"
        out.append(Drawn(label, place.get(int(parent[n]), -1), edge, int(tree.depth[n])))
    return out


def _dot(nodes: list[Drawn]) -> str:
    lines = ["digraph search {", '  node [shape=box, fontname="Helvetica"];']
    for i, node in enumerate(nodes):
        lines.append(f'  n{i} [label="{_quoted(node.label)}"];')
        if node.parent >= 0:
            lines.append(f'  n{node.parent} -> n{i} [label="{_quoted(node.edge)}"];')
    return "\n".join([*lines, "}"]) + "\n"


def _quoted(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


def _svg(nodes: list[Drawn]) -> str:
    children: list[list[int]] = [[] for _ in nodes]
    for i, node in enumerate(nodes):
        if node.parent >= 0:
            children[node.parent].append(i)
    centre = [0.0] * len(nodes)
    reached = 0.0
    for i in _bottom_up(children):
        if children[i]:
            centre[i] = (centre[children[i][0]] + centre[children[i][-1]]) / 2
        else:
            centre[i] = reached + _BOX / 2
            reached += _BOX + _GAP
    height = _LEVEL * (1 + max((node.depth for node in nodes), default=0))
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{max(reached, _BOX):.0f}" height="{height}" '
        'font-family="sans-serif" font-size="9" text-anchor="middle">'
    ]
    for i, node in enumerate(nodes):
        x, y = centre[i], node.depth * _LEVEL + 34
        if node.parent >= 0:
            above = centre[node.parent], nodes[node.parent].depth * _LEVEL + 54
            parts.append(f'<path d="M{above[0]:.1f} {above[1]}L{x:.1f} {y}" stroke="#999" fill="none"/>')
            parts.append(f'<text x="{x:.1f}" y="{y - 4}" fill="#555">{escape(node.edge)}</text>')
        parts.append(
            f'<rect x="{x - _BOX / 2:.1f}" y="{y}" width="{_BOX}" height="20" rx="3" fill="#eef3fa" stroke="#456"/>'
            f'<text x="{x:.1f}" y="{y + 13}">{escape(node.label)}</text>'
        )
    return "".join([*parts, "</svg>"])


def _bottom_up(children: list[list[int]]) -> list[int]:
    """Nodes, every one after all of its children, left to right."""
    order: list[int] = []
    waiting = [(0, False)]
    while waiting:
        node, ready = waiting.pop()
        if ready:
            order.append(node)
            continue
        waiting.append((node, True))
        waiting += [(child, False) for child in reversed(children[node])]
    return order
