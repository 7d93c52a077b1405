"""Tables as decision diagrams: which values a row allows, with equal parts shared.

What matters to a proof is which values are possible, and most rows of a large table agree on that. The diagram is
reduced: no two nodes are equal, no node asks for a value that makes no difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.rows import unique_rows
from nesy.errors import UserError


@dataclass(frozen=True)
class Diagram:
    """The diagram of one table; nodes are numbered from 0, leaves first."""

    root: int
    leaves: np.ndarray
    """bool [L, K]: which values each leaf allows."""
    parents: tuple[int, ...]
    """Position of the parent that each further node asks for."""
    children: np.ndarray
    """int64 [nodes, K]: where its values lead."""
    dropped: float
    """Largest probability that a row has on values taken as impossible."""


def diagram(dbn: TwoSliceDBN, action: int, factor: int, least: float, rows: np.ndarray | None = None) -> Diagram:
    """The diagram of the values at least as probable as `least`.

    Args:
        dbn: the model.
        action: the action.
        factor: the factor.
        least: values less probable count as impossible.
        rows: the rows that matter (the others are free to become whatever makes the diagram small); by default all.

    Raises:
        UserError: `least` makes a row impossible.
    """
    k = dbn.num_values
    table = dbn.cpt(action, factor)
    chosen = table if rows is None else table[rows]
    allowed = chosen >= max(least, np.finfo(float).tiny)
    if not allowed.any(axis=1).all():
        raise UserError(f"no value of some row is at least {least} probable; choose less")
    first, index, _ = unique_rows(allowed)
    leaves = allowed[first]
    nodes = np.full(len(table), -1, dtype=np.int64)
    nodes[np.arange(len(table)) if rows is None else rows] = index
    parents: list[int] = []
    children: list[np.ndarray] = []
    total = len(leaves)
    for position in range(len(dbn.parents(action, factor)) - 1, -1, -1):
        blocks = _filled(nodes.reshape(-1, k))
        nodes = blocks[:, 0].copy()
        differing = np.flatnonzero((blocks != blocks[:, :1]).any(axis=1))
        if len(differing):
            distinct, which = np.unique(blocks[differing], axis=0, return_inverse=True)
            nodes[differing] = total + which.reshape(-1)
            children.append(distinct)
            parents += [position] * len(distinct)
            total += len(distinct)
    return Diagram(
        root=max(int(nodes[0]), 0),
        leaves=leaves,
        parents=tuple(parents),
        children=np.concatenate(children) if children else np.zeros((0, k), dtype=np.int64),
        dropped=float(np.where(allowed, 0.0, chosen).sum(axis=1).max()),
    )


def _filled(blocks: np.ndarray) -> np.ndarray:
    """Free entries (-1) of each block take the block's first entry that is not free."""
    first = blocks[np.arange(len(blocks)), (blocks >= 0).argmax(axis=1)]
    return np.where(blocks >= 0, blocks, first[:, None])


def diagram_facts(dbn: TwoSliceDBN, action: int, factor: int, found: Diagram) -> list[str]:
    """The diagram as facts root/2, test/3, edge/3, leaf/2 and may/2; node N of factor F is the term n(F,N)."""
    parents = dbn.parents(action, factor)

    def node(number: int) -> str:
        return f"n({factor},{number})"

    lines = [f"root({factor},{node(found.root)})."]
    for number, values in enumerate(found.leaves):
        lines.append(f"leaf({node(number)},{factor}).")
        lines += [f"may({node(number)},{v})." for v in np.flatnonzero(values).tolist()]
    for offset, (position, row) in enumerate(zip(found.parents, found.children.tolist(), strict=True)):
        name = node(len(found.leaves) + offset)
        where, p = parents[position]
        lines.append(f"test({name},{p},{where}).")
        lines += [f"edge({name},{value},{node(child)})." for value, child in enumerate(row)]
    return lines
