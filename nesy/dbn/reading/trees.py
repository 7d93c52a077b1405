"""Context-specific structure: a conditional table as a decision tree with value sets at its branches.

Most rows of a table say the same. A tree asks for one parent after the other, puts values that make no difference
into one branch, and ends in a distribution: shorter to read and to hand to ASP. With tolerance 0 it is exact on every
row; otherwise the largest total variation of a row from its leaf is stated. Rows never met in experience can be left
free, which shortens trees much further: then the tree is exact on the rows met, and a guess elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nesy.dbn.model import TwoSliceDBN


@dataclass(frozen=True)
class Leaf:
    """A distribution."""

    distribution: np.ndarray
    """float64 [K]."""
    rows: int
    """Rows of the table that end here, of those that count."""


@dataclass(frozen=True)
class Branch:
    """A question for a parent's value."""

    parent: int
    """Position among the table's parents."""
    children: tuple[tuple[tuple[int, ...], Tree], ...]
    """(values, subtree): the sets of values are disjoint and hold every value."""


Tree = Leaf | Branch


@dataclass(frozen=True)
class ConditionalTree:
    """A table as a tree."""

    tree: Tree
    leaves: int
    """How many distributions it has; at most the number of rows that count."""
    error: float
    """Largest total variation of a row that counts from its leaf."""
    met_only: bool
    """Whether only rows met in experience count."""


def conditional_tree(
    dbn: TwoSliceDBN, action: int, factor: int, tolerance: float = 0.0, met_only: bool = False
) -> ConditionalTree:
    """The tree of one table.

    Args:
        dbn: the model.
        action: the action.
        factor: the factor.
        tolerance: total variation up to which rows count as equal; a leaf may be a little further from some of its
            rows, since it holds their mean. The error says how far at most.
        met_only: leave the rows never met in experience free.
    """
    table = dbn.cpt(action, factor)
    counts = dbn.counts(action, factor)
    care = counts > 0 if met_only and counts.any() else np.ones(len(table), dtype=bool)
    arity = len(dbn.parents(action, factor))
    digits = np.arange(len(table))[:, None] // dbn.num_values ** np.arange(arity - 1, -1, -1) % dbn.num_values
    rows = np.flatnonzero(care)
    weights = np.maximum(counts, 1).astype(float)
    tree = _grow(table, digits, rows, weights, tuple(range(arity)), dbn.num_values, tolerance)
    error = 0.0
    for row in rows.tolist():
        leaf = look_up(tree, digits[row])
        error = max(error, 0.5 * float(np.abs(leaf.distribution - table[row]).sum()))
    return ConditionalTree(tree, sum(1 for _ in leaves(tree)), error, bool(met_only and counts.any()))


def look_up(tree: Tree, values: np.ndarray) -> Leaf:
    """The leaf for some values of the parents, integers [P]."""
    while isinstance(tree, Branch):
        value = int(values[tree.parent])
        tree = next(child for chosen, child in tree.children if value in chosen)
    return tree


def leaves(
    tree: Tree, path: tuple[tuple[int, tuple[int, ...]], ...] = ()
) -> Iterator[tuple[tuple[tuple[int, tuple[int, ...]], ...], Leaf]]:
    """All leaves with their paths of (parent, values)."""
    if isinstance(tree, Leaf):
        yield path, tree
        return
    for values, child in tree.children:
        yield from leaves(child, (*path, (tree.parent, values)))


def describe_tree(dbn: TwoSliceDBN, action: int, factor: int, tree: ConditionalTree) -> str:
    """The tree as indented text."""
    from nesy.dbn.reading.text import distribution, parent_names

    names = parent_names(dbn, action, factor)
    head = f"{dbn.factor_names[factor]}' under {dbn.action_names[action]}: {tree.leaves} leaves, "
    head += f"{dbn.num_rows(action, factor)} rows" + (" (rows met only)" if tree.met_only else "")
    lines = [head + (f", error {tree.error:.3g}" if tree.error else ", exact")]

    def write(node: Tree, depth: int) -> None:
        if isinstance(node, Leaf):
            lines[-1] += f" -> {distribution(node.distribution)}"
            return
        for values, child in node.children:
            lines.append("  " * (depth + 1) + f"{names[node.parent]} in {{{', '.join(map(str, values))}}}")
            write(child, depth + 1)

    write(tree.tree, 0)
    return "\n".join(lines)


def _grow(
    table: np.ndarray,
    digits: np.ndarray,
    rows: np.ndarray,
    weights: np.ndarray,
    parents: tuple[int, ...],
    num_values: int,
    tolerance: float,
) -> Tree:
    if not len(rows):
        return Leaf(table.mean(axis=0), 0)
    mean = np.average(table[rows], axis=0, weights=weights[rows])
    spread = 0.5 * np.abs(table[rows] - table[rows[0]]).sum(axis=1).max()
    if spread == 0.0:
        return Leaf(table[rows[0]], len(rows))
    # values put together level by level may end further from their mean than from each other; the error is stated
    if not parents or 0.5 * np.abs(table[rows] - mean).sum(axis=1).max() <= tolerance:
        return Leaf(mean, len(rows))
    parent = max(parents, key=lambda p: (_gain(table, digits[:, p], rows, weights, num_values), -p))
    rest = tuple(p for p in parents if p != parent)
    groups = _groups(table, digits, rows, parent, rest, num_values, tolerance)
    children = []
    for values in groups:
        inside = rows[np.isin(digits[rows, parent], values)]
        children.append((values, _grow(table, digits, inside, weights, rest, num_values, tolerance)))
    return Branch(parent, tuple(children))


def _gain(table: np.ndarray, column: np.ndarray, rows: np.ndarray, weights: np.ndarray, num_values: int) -> float:
    """Information that a parent's value gives about the distribution: less is left after asking is better."""
    left = 0.0
    for value in range(num_values):
        inside = rows[column[rows] == value]
        if len(inside):
            mean = np.average(table[inside], axis=0, weights=weights[inside])
            left -= float(weights[inside].sum() * (mean * np.log(np.maximum(mean, 1e-300))).sum())
    return -left


def _groups(
    table: np.ndarray,
    digits: np.ndarray,
    rows: np.ndarray,
    parent: int,
    rest: tuple[int, ...],
    num_values: int,
    tolerance: float,
) -> list[tuple[int, ...]]:
    """Values of a parent that agree wherever both have a row; free values join the first group."""
    # rows by the values of the other parents
    context = np.zeros(len(rows), dtype=np.int64)
    for p in rest:
        context = context * num_values + digits[rows, p]
    _, context = np.unique(context, return_inverse=True)
    context = context.reshape(-1)
    size = int(context.max()) + 1
    groups: list[tuple[list[int], np.ndarray, np.ndarray]] = []
    free = []
    for value in range(num_values):
        chosen = digits[rows, parent] == value
        if not chosen.any():
            free.append(value)
            continue
        known = np.zeros(size, dtype=bool)
        known[context[chosen]] = True
        content = np.zeros((size, table.shape[1]))
        content[context[chosen]] = table[rows[chosen]]
        for values, seen, rows_of_group in groups:
            both = seen & known
            if both.any() and 0.5 * np.abs(rows_of_group[both] - content[both]).sum(axis=1).max() <= tolerance:
                values.append(value)
                rows_of_group[known & ~seen] = content[known & ~seen]
                seen |= known
                break
        else:
            groups.append(([value], known, content))
    if len(groups) == 1 and len(rows) > 1:
        return [tuple(sorted([*groups[0][0], *free]))]
    groups[0][0].extend(free)
    return [tuple(sorted(values)) for values, _, _ in groups]
