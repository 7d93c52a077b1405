"""Tables as decision diagrams: equal parts are shared, and nothing is asked for that makes no difference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Diagram:
    """A reduced decision diagram; nodes are numbered from 0, its L leaves first."""

    root: int
    leaves: int
    """L."""
    axes: tuple[int, ...]
    """The axis that each further node asks for."""
    children: tuple[np.ndarray, ...]
    """Where the values of that axis lead, int64 [size of the axis] for each further node."""


def diagram(labels: np.ndarray) -> Diagram:
    """The diagram of a table of labels.

    Args:
        labels: int64 [s1, ..., sm], labels 0..L-1; -1 where any label will do (the diagram chooses what makes it
            small).
    """
    leaves = int(labels.max(initial=0)) + 1
    nodes = labels.reshape(-1)
    total = leaves
    axes: list[int] = []
    children: list[np.ndarray] = []
    for axis in range(labels.ndim - 1, -1, -1):
        blocks = nodes.reshape(-1, labels.shape[axis])
        if (nodes < 0).any():
            # free entries of a block take its first entry that is not free
            first = blocks[np.arange(len(blocks)), (blocks >= 0).argmax(axis=1)]
            blocks = np.where(blocks >= 0, blocks, first[:, None])
        nodes = blocks[:, 0].copy()
        differing = np.flatnonzero((blocks != blocks[:, :1]).any(axis=1))
        if len(differing):
            distinct, which = _distinct(blocks[differing])
            nodes[differing] = total + which
            children += list(distinct)
            axes += [axis] * len(distinct)
            total += len(distinct)
    return Diagram(max(int(nodes[0]), 0), leaves, tuple(axes), tuple(children))


def _distinct(blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows, and for every row the number of its own."""
    size = int(blocks.max()) + 2
    if size ** blocks.shape[1] < 1 << 62:
        keys = (blocks + 1) @ size ** np.arange(blocks.shape[1], dtype=np.int64)
        _, first, which = np.unique(keys, return_index=True, return_inverse=True)
        return blocks[first], which.reshape(-1)
    distinct, which = np.unique(blocks, axis=0, return_inverse=True)
    return distinct, which.reshape(-1)


def diagram_facts(
    found: Diagram,
    first: int,
    variables: Sequence[tuple[int, int]],
    values: Sequence[np.ndarray],
    without: frozenset[int] = frozenset(),
) -> list[str]:
    """The inner nodes of a diagram as facts test/3 and edge/3.

    Args:
        found: the diagram.
        first: the number of its node 0 in the program.
        variables: (slice, factor) of each axis.
        values: the values of each axis.
        without: nodes that need no edge to them.
    """
    lines = []
    for offset, (axis, row) in enumerate(zip(found.axes, found.children, strict=True)):
        where, factor = variables[axis]
        name = first + found.leaves + offset
        groups: dict[int, list[str]] = {}
        for value, child in zip(values[axis].tolist(), row.tolist(), strict=True):
            if child not in without:
                groups.setdefault(child, []).append(str(value))
        edges = " ".join(
            f"edge({name},{v[0] if len(v) == 1 else f'({chr(59).join(v)})'},{first + child})."
            for child, v in groups.items()
        )
        lines.append(f"test({name},{factor},{where}). {edges}")
    return lines
