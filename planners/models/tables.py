"""Conditional tables with chosen parents: P(target | parents) or E[target | parents] as a decision tree.

A tree asks one question about one parent per node ("factor 3 is 5", "ahead <= 2"), so a table over a dozen
parents needs only as many rows as there are contexts that make a difference. Rows keep their counts. A tree is
grown as long as a question gains anything, and then pruned from below wherever the gain in log-likelihood is
less than `_PRICE` per question: noise is cut off, while a rare context that behaves differently, every time, is
kept. (The usual BIC gives up such contexts, and a planner finds the mistake.) Pruning rather than stopping early
finds contexts that only several questions together tell apart.

Every table is learned from (parents, target) pairs and knows nothing about what they mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from nesy.compiled import njit

_VARIANCE_FLOOR = 1e-4
_PRICE = 2.0  # nats


@dataclass(frozen=True)
class Parents:
    """The parents a table may ask about.

    Attributes:
        names: one name per column.
        slots: where each column is found in the vector of variables that kernels pass around.
        ordered: whether "<=" makes sense for the column; otherwise only "==" is asked.
    """

    names: tuple[str, ...]
    slots: tuple[int, ...]
    ordered: tuple[bool, ...]


@dataclass(frozen=True)
class DecisionTable:
    """One learned table.

    Attributes:
        slot: int32 [nodes], the variable a node asks about, -1 at a row (leaf).
        value: int32 [nodes], what it is compared with.
        ordered: bool [nodes], "<=" rather than "==".
        yes, no: int32 [nodes], where to go on.
        moments: float64 [nodes, M]. Distribution: counts per class. Mean: (n, sum, sum of squares).
        kind: "distribution", "mean", or "given": probabilities in place of counts, which are taken as they stand.
        names: {slot: name}, for printing.
    """

    slot: np.ndarray
    value: np.ndarray
    ordered: np.ndarray
    yes: np.ndarray
    no: np.ndarray
    moments: np.ndarray
    kind: str
    names: dict[int, str]

    @property
    def rows(self) -> int:
        """How many contexts are told apart."""
        return int((self.slot < 0).sum())

    def parents(self) -> tuple[str, ...]:
        """Names of the variables the table asks about."""
        return tuple(self.names[s] for s in sorted(set(self.slot[self.slot >= 0].tolist())))

    def estimates(self, smoothing: float = 0.5) -> np.ndarray:
        """What each node predicts, float64 [nodes, M]: probabilities, or (mean, 0, 0).

        A distribution is drawn towards that of the node above by `smoothing` counts, so that no row says never.
        """
        if self.kind == "given":
            return self.moments
        out = np.zeros_like(self.moments)
        for node in range(len(self.slot)):
            if self.kind == "mean":
                out[node, 0] = self.moments[node, 1] / max(self.moments[node, 0], 1e-12)
                continue
            if node == 0:
                prior = np.full(self.moments.shape[1], 1.0 / self.moments.shape[1])
                total = self.moments[0].sum()
                out[0] = (self.moments[0] + smoothing * prior) / (total + smoothing)
            if self.slot[node] >= 0:
                for child in (self.yes[node], self.no[node]):
                    total = self.moments[child].sum()
                    out[child] = (self.moments[child] + smoothing * out[node]) / (total + smoothing)
        return out

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays to be stored."""
        return {part: getattr(self, part) for part in ("slot", "value", "ordered", "yes", "no", "moments")}

    def locate(self, variables: np.ndarray) -> np.ndarray:
        """The row of each vector of variables: int [n, slots] -> int64 [n]."""
        return _locate_all(self.slot, self.value, self.ordered, self.yes, self.no, variables)


class PackedTables(NamedTuple):
    """Several tables in flat arrays, for kernels; `root[k]` is where table k starts."""

    root: np.ndarray
    slot: np.ndarray
    value: np.ndarray
    ordered: np.ndarray
    yes: np.ndarray
    no: np.ndarray
    estimate: np.ndarray  # float64 [nodes, M]: cumulative probabilities, or the mean in column 0


def learn_distribution(
    variables: np.ndarray, parents: Parents, target: np.ndarray, num_classes: int, weights: np.ndarray | None = None
) -> DecisionTable:
    """Learn P(target | parents).

    Args:
        variables: int [n, slots], non-negative small integers.
        parents: which slots may be asked about.
        target: int [n] in 0..num_classes-1.
        num_classes: number of classes.
        weights: float [n], how often each pair was seen (1 if not given).
    """
    weights = np.ones(len(target)) if weights is None else np.asarray(weights, np.float64)
    moments = np.zeros((len(target), num_classes))
    moments[np.arange(len(target)), target] = weights
    return _learn(variables, parents, moments, "distribution")


def learn_mean(variables: np.ndarray, parents: Parents, target: np.ndarray) -> DecisionTable:
    """Learn E[target | parents] from float targets [n]; `variables` as in `learn_distribution`."""
    target = np.asarray(target, np.float64)
    return _learn(variables, parents, np.stack([np.ones_like(target), target, target**2], axis=1), "mean")


def pack(tables: list[DecisionTable]) -> PackedTables:
    """Flatten tables for kernels; distributions become cumulative."""
    sizes = np.array([len(t.slot) for t in tables])
    root = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int32)
    width = max(t.moments.shape[1] for t in tables)
    estimate = np.ones((int(sizes.sum()), width))
    for start, table in zip(root, tables, strict=True):
        values = table.estimates()
        if table.kind != "mean":
            values = np.cumsum(values, axis=1)
            values[:, -1] = 1.0
        estimate[start : start + len(values), : values.shape[1]] = values
    return PackedTables(
        root,
        np.concatenate([t.slot for t in tables]),
        np.concatenate([t.value for t in tables]),
        np.concatenate([t.ordered for t in tables]),
        np.concatenate([t.yes + start for t, start in zip(tables, root, strict=True)]).astype(np.int32),
        np.concatenate([t.no + start for t, start in zip(tables, root, strict=True)]).astype(np.int32),
        estimate,
    )


@njit(cache=True)
def locate(tables: PackedTables, table: int, variables: np.ndarray) -> int:
    """Row (node index) of `table` for one vector of variables."""
    node = tables.root[table]
    while tables.slot[node] >= 0:
        value = variables[tables.slot[node]]
        if tables.ordered[node]:
            node = tables.yes[node] if value <= tables.value[node] else tables.no[node]
        else:
            node = tables.yes[node] if value == tables.value[node] else tables.no[node]
    return node


def _learn(variables: np.ndarray, parents: Parents, moments: np.ndarray, kind: str) -> DecisionTable:
    if len(variables) == 0:
        raise ValueError("a table needs at least one example")
    columns = np.ascontiguousarray(variables[:, list(parents.slots)].T.astype(np.int32))
    if columns.min() < 0:
        raise ValueError("the parents of a table must be non-negative integers")
    columns, moments = _collapsed(columns, moments)
    sizes = columns.max(axis=1).astype(np.int64) + 1
    slot, value, ordered, yes, no, node_moments = _grow(
        columns,
        np.array(parents.ordered, dtype=np.bool_),
        sizes,
        moments,
        kind == "mean",
    )
    slot, value, ordered, yes, no, node_moments = _pruned(slot, value, ordered, yes, no, node_moments, kind == "mean")
    slots = np.array(parents.slots, dtype=np.int32)
    slot = np.where(slot >= 0, slots[np.maximum(slot, 0)], -1).astype(np.int32)
    names = dict(zip(parents.slots, parents.names, strict=True))
    return DecisionTable(slot, value, ordered, yes, no, node_moments, kind, names)


def _collapsed(columns: np.ndarray, moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add up the examples whose parents agree: columns int32 [F, n] -> [F, m], moments [n, M] -> [m, M]."""
    sizes = columns.max(axis=1).astype(object) + 1
    if int(np.prod(sizes)) < 2**62:
        keys = np.zeros(columns.shape[1], np.int64)
        for column, size in zip(columns, sizes, strict=True):
            keys = keys * int(size) + column
        _, first, group = np.unique(keys, return_index=True, return_inverse=True)
    else:
        _, first, group = np.unique(columns.T, axis=0, return_index=True, return_inverse=True)
    group = group.reshape(-1)
    summed = np.stack([np.bincount(group, moment, len(first)) for moment in moments.T], axis=1)
    return np.ascontiguousarray(columns[:, first]), summed


@njit(cache=True)
def _score(here: np.ndarray, i: int, minus: np.ndarray, j: int, mean: bool) -> float:
    """Maximum log-likelihood, up to a constant, of the examples summed up in here[i] - minus[j]."""
    total = 0.0
    score = 0.0
    width = here.shape[1]
    if mean:
        total = here[i, 0] - minus[j, 0]
        if total <= 0.5:
            return 0.0
        average = (here[i, 1] - minus[j, 1]) / total
        variance = (here[i, 2] - minus[j, 2]) / total - average * average
        return -0.5 * total * np.log(max(variance, 0.0) + _VARIANCE_FLOOR)
    for k in range(width):
        count = here[i, k] - minus[j, k]
        if count > 1e-9:
            total += count
            score += count * np.log(count)
    return score - total * np.log(total) if total > 0.0 else 0.0


@njit(cache=True)
def _best_split(
    columns: np.ndarray,
    ordered: np.ndarray,
    sizes: np.ndarray,
    moments: np.ndarray,
    mean: bool,
    rows: np.ndarray,
    here: np.ndarray,
    node: int,
) -> tuple[int, int, bool]:
    """Feature, value and kind of the question that gains most at `node`; feature -1 if none gains anything."""
    width = moments.shape[1]
    zero = np.zeros((1, width))
    base = _score(here, node, zero, 0, mean)
    best_gain, best_feature, best_value, best_ordered = 1e-6, -1, 0, False
    histogram = np.zeros((sizes.max(), width))
    below = np.zeros((1, width))
    for feature in range(columns.shape[0]):
        size = sizes[feature]
        for v in range(size):
            for k in range(width):
                histogram[v, k] = 0.0
        for row in rows:
            for k in range(width):
                histogram[columns[feature, row], k] += moments[row, k]
        for k in range(width):
            below[0, k] = 0.0
        for v in range(size):
            gain = _score(histogram, v, zero, 0, mean) + _score(here, node, histogram, v, mean) - base
            if gain > best_gain + 1e-9:
                best_gain, best_feature, best_value, best_ordered = gain, feature, v, False
            if ordered[feature]:
                for k in range(width):
                    below[0, k] += histogram[v, k]
                gain = _score(below, 0, zero, 0, mean) + _score(here, node, below, 0, mean) - base
                if gain > best_gain + 1e-9:
                    best_gain, best_feature, best_value, best_ordered = gain, feature, v, True
    return best_feature, best_value, best_ordered


@njit(cache=True)
def _grow(
    columns: np.ndarray, ordered: np.ndarray, sizes: np.ndarray, moments: np.ndarray, mean: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    n = columns.shape[1]
    width = moments.shape[1]
    capacity = 2 * n + 1
    slot = np.full(capacity, -1, np.int32)
    value = np.zeros(capacity, np.int32)
    is_ordered = np.zeros(capacity, np.bool_)
    yes = np.zeros(capacity, np.int32)
    no = np.zeros(capacity, np.int32)
    here = np.zeros((capacity, width))
    begin = np.zeros(capacity, np.int64)
    end = np.zeros(capacity, np.int64)
    index = np.arange(n)
    scratch = np.zeros(n, np.int64)
    end[0] = n
    for row in range(n):
        for k in range(width):
            here[0, k] += moments[row, k]
    nodes = 1
    node = 0
    while node < nodes:  # breadth first: a parent always comes before its children
        feature, split, less = _best_split(
            columns, ordered, sizes, moments, mean, index[begin[node] : end[node]], here, node
        )
        if feature >= 0:
            front, back = begin[node], 0
            for position in range(begin[node], end[node]):
                row = index[position]
                v = columns[feature, row]
                if v == split or (less and v < split):
                    index[front] = row
                    front += 1
                    for k in range(width):
                        here[nodes, k] += moments[row, k]
                else:
                    scratch[back] = row
                    back += 1
                    for k in range(width):
                        here[nodes + 1, k] += moments[row, k]
            for position in range(back):
                index[front + position] = scratch[position]
            slot[node], value[node], is_ordered[node] = feature, split, less
            yes[node], no[node] = nodes, nodes + 1
            begin[nodes], end[nodes] = begin[node], front
            begin[nodes + 1], end[nodes + 1] = front, end[node]
            nodes += 2
        node += 1
    return slot[:nodes], value[:nodes], is_ordered[:nodes], yes[:nodes], no[:nodes], here[:nodes]


def _pruned(
    slot: np.ndarray,
    value: np.ndarray,
    ordered: np.ndarray,
    yes: np.ndarray,
    no: np.ndarray,
    moments: np.ndarray,
    mean: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Keep a split only where its subtree as a whole pays for itself; renumber what is left, breadth first."""
    zero = np.zeros((1, moments.shape[1]))
    worth = np.array([_score(moments, node, zero, 0, mean) for node in range(len(slot))])
    kept = slot >= 0
    for node in range(len(slot) - 1, -1, -1):  # children come after their parent
        if kept[node]:
            below = worth[yes[node]] + worth[no[node]] - _PRICE
            kept[node] = below > worth[node]
            worth[node] = max(below, worth[node])
    order = [0]
    new_yes, new_no = [], []
    for node in order:  # grows while it is walked through
        if kept[node]:
            new_yes.append(len(order))
            new_no.append(len(order) + 1)
            order += [int(yes[node]), int(no[node])]
        else:
            new_yes.append(0)
            new_no.append(0)
    chosen = np.array(order)
    return (
        np.where(kept[chosen], slot[chosen], -1),
        value[chosen],
        ordered[chosen],
        np.array(new_yes, np.int32),
        np.array(new_no, np.int32),
        moments[chosen],
    )


@njit(cache=True)
def _locate_all(
    slot: np.ndarray, value: np.ndarray, ordered: np.ndarray, yes: np.ndarray, no: np.ndarray, variables: np.ndarray
) -> np.ndarray:
    out = np.zeros(len(variables), np.int64)
    for i in range(len(variables)):
        node = 0
        while slot[node] >= 0:
            v = variables[i, slot[node]]
            met = v <= value[node] if ordered[node] else v == value[node]
            node = yes[node] if met else no[node]
        out[i] = node
    return out


def stored_table(name: str, description: dict[str, Any], arrays: dict[str, np.ndarray]) -> DecisionTable:
    """A table from its `kind` and `names` in a JSON file and its arrays `NAME.PART` in the .npz file beside it."""
    parts = {part: arrays[f"{name}.{part}"] for part in ("slot", "value", "ordered", "yes", "no", "moments")}
    names = {int(slot): str(text) for slot, text in description["names"].items()}
    return DecisionTable(**parts, kind=str(description["kind"]), names=names)
