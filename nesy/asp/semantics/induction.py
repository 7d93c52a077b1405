"""Induction of short rules from views, by trees over sets of values.

The rules of a tree's leaves are made as general as the views allow, and only those that are needed are kept. A tree
asks at every node whether the value of one column lies in a set. For a binary target the best set is found by
ordering the values by the target's share and cutting that order (Breiman et al. 1984, theorem 4.5); a value that no
view of the node has is placed by its share further up in the tree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nesy.asp.semantics.rules import Rule

SMOOTHING = 5.0
"""Weight of a value's share in the node above, in views."""


def induce(values: np.ndarray, truth: np.ndarray, num_values: int, min_leaf: int = 1) -> tuple[Rule, ...]:
    """Rules for where something holds.

    Args:
        values: integers [n, C] in 0..num_values-1; of columns that do equally well the first is used.
        truth: bool [n].
        num_values: K.
        min_leaf: fewest views at a leaf of the tree.

    Returns:
        Rules that together hold where `truth` does (exactly, if views with equal values agree and `min_leaf` is 1).
    """
    if not truth.any():
        return ()
    if truth.all():
        return (Rule((), len(truth), len(truth)),)
    leaves = grow(values, truth, num_values, min_leaf)
    return _needed([_general(leaf.allowed, values, truth) for leaf in leaves if leaf.holds], values, truth)


@dataclass(frozen=True)
class Leaf:
    """A leaf of a tree."""

    allowed: np.ndarray
    """bool [C, K]: the values that lead to it."""
    holds: bool
    """Whether the target holds in most of its views."""


def grow(values: np.ndarray, truth: np.ndarray, num_values: int, min_leaf: int = 1) -> list[Leaf]:
    """A tree, as its leaves; arguments as for `induce`."""
    columns, k = values.shape[1], num_values
    flat = values + np.arange(columns) * k
    leaves = []
    prior = np.full((columns, k), truth.mean())
    stack = [(np.arange(len(values)), np.ones((columns, k), dtype=bool), prior)]
    while stack:
        index, allowed, prior = stack.pop()
        wanted = truth[index]
        hits = int(wanted.sum())
        total = np.bincount(flat[index].reshape(-1), minlength=columns * k).reshape(columns, k)
        right = np.bincount(flat[index[wanted]].reshape(-1), minlength=columns * k).reshape(columns, k)
        share = (right + SMOOTHING * prior) / (total + SMOOTHING)
        cut = None if hits in (0, len(index)) else _best_cut(total, right, share, allowed, min_leaf)
        if cut is None:
            leaves.append(Leaf(allowed, 2 * hits > len(index)))
            continue
        column, inside = cut
        yes, no = allowed.copy(), allowed.copy()
        yes[column] &= inside
        no[column] &= ~inside
        chosen = inside[values[index, column]]
        stack += [(index[~chosen], no, share), (index[chosen], yes, share)]
    return leaves


def _best_cut(
    total: np.ndarray, right: np.ndarray, share: np.ndarray, allowed: np.ndarray, min_leaf: int
) -> tuple[int, np.ndarray] | None:
    """The column and set of values that tell most about the target; None if none tells anything."""
    views, hits = int(total[0].sum()), int(right[0].sum())
    # values in descending order of the share, those ruled out at the end (they have no views)
    order = np.argsort(np.where(allowed, -share, 2.0), axis=1, kind="stable")
    inside = np.take_along_axis(total, order, 1).cumsum(axis=1)
    found = np.take_along_axis(right, order, 1).cumsum(axis=1)
    left_open = _entropy(found, inside) + _entropy(hits - found, views - inside)
    left_open[(inside < min_leaf) | (views - inside < min_leaf)] = np.inf
    column, last = np.unravel_index(int(np.round(left_open, 9).argmin()), left_open.shape)
    before = _entropy(np.array([hits]), np.array([views]))[0]
    # a cut that tells nothing by itself may be the first of two that do: an exact tree takes it
    if not left_open[column, last] < (before - 1e-9 if min_leaf > 1 else np.inf):
        return None
    chosen = np.zeros(total.shape[1], dtype=bool)
    chosen[order[column, : last + 1]] = True
    met = total[column] > 0
    edge = (share[column][chosen & met].min() + share[column][~chosen & met].max()) / 2
    return int(column), np.where(met, chosen, share[column] >= edge)


def _entropy(hits: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Entropy of binary outcomes times their number, in nats."""
    share = hits / np.maximum(total, 1)
    return -total * (share * np.log(np.maximum(share, 1e-300)) + (1 - share) * np.log(np.maximum(1 - share, 1e-300)))


def _general(allowed: np.ndarray, values: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The rule without conditions, and with more values, as long as it says nothing more that is wrong."""
    result = allowed.copy()
    narrow = np.flatnonzero(~allowed.all(axis=1))
    fits = {c: result[c][values[:, c]] for c in narrow.tolist()}

    def wrong(column: int, mask: np.ndarray) -> int:
        here = mask & ~truth
        for other in fits:
            if other != column:
                here = here & fits[other]
        return int(here.sum())

    limit = wrong(-1, np.ones(len(values), dtype=bool))
    everywhere = np.ones(len(values), dtype=bool)
    # the condition that most values satisfy says least: try to do without it first; later columns before earlier
    for column in sorted(fits, key=lambda c: (-int(allowed[c].sum()), -c)):
        if wrong(column, everywhere) <= limit:
            result[column] = True
            del fits[column]
            continue
        others = everywhere.copy()
        for other in fits:
            if other != column:
                others &= fits[other]
        # values never met in this context stay out: a rule should not promise more than was seen
        met = np.bincount(values[others, column], minlength=result.shape[1])
        wrongly = np.bincount(values[others & ~truth, column], minlength=result.shape[1])
        result[column] |= (met > 0) & (wrongly == 0)
        fits[column] = result[column][values[:, column]]
    return result


def _needed(masks: list[np.ndarray], values: np.ndarray, truth: np.ndarray) -> tuple[Rule, ...]:
    """The rules that cover what the others do not, those that cover most first."""
    covers = np.ones((len(masks), len(values)), dtype=bool)
    narrow = [np.flatnonzero(~mask.all(axis=1)).tolist() for mask in masks]
    for here, mask, columns in zip(covers, masks, narrow, strict=True):
        for column in columns:
            here &= mask[column][values[:, column]]
    rules: list[Rule] = []
    left = truth.copy()
    while len(masks):
        gain = (covers & left).sum(axis=1)
        best = int(gain.argmax())
        if not gain[best]:
            break
        left &= ~covers[best]
        conditions = []
        for column in narrow[best]:
            met = np.unique(values[:, column])
            if not masks[best][column, met].all():
                conditions.append((int(column), tuple(int(v) for v in met if masks[best][column, v])))
        rules.append(Rule(tuple(conditions), int((covers[best] & truth).sum()), int(covers[best].sum())))
    return tuple(rules)
