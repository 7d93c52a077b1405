"""Refinement of the codes: coordinate descent on the next-code likelihood, one factor of one view at a time.

With few distinct views, the likelihood of a 2DBN whose tables are counted from the codes can be followed
exactly while single entries of the code book change. A move gives view v the value k in factor i; its cost is
the change of the total conditional entropy (nats times weight) plus the reluctance of the encoder to give that
value. Codes stay distinct. Noise that fades over the rounds (simulated annealing with Gumbel noise, i.e. Gibbs
sampling) keeps the descent out of poor minima. After every round the structure is searched anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nesy.compiled import njit
from nesy.world_model.distinct import Transitions
from nesy.world_model.structure import Limits, Structure, search


@dataclass
class CodeBook:
    """Codes of the distinct views, with the structure found for them."""

    codes: np.ndarray
    """int64 [V, N]."""
    structure: Structure
    nll: float
    """Conditional entropy of the next code under the structure, in nats."""


@njit(cache=True)
def _xlogx(count: int, table: np.ndarray) -> float:
    if count < len(table):
        return table[count]
    return count * np.log(count)


@njit(cache=True)
def _cell(
    f: int,
    source: int,
    target: int,
    child: int,
    codes: np.ndarray,
    count: np.ndarray,
    which: np.ndarray,
    factor: np.ndarray,
    num_values: int,
) -> int:
    key = 0
    for p in range(count[f]):
        view = source if which[f, p] == 0 else target
        key = key * num_values + codes[view, factor[f, p]]
    return key * num_values + codes[target, child]


@njit(cache=True)
def _count(
    codes: np.ndarray,
    source: np.ndarray,
    action: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    count: np.ndarray,
    which: np.ndarray,
    factor: np.ndarray,
    num_values: int,
    cells: np.ndarray,
    rows: np.ndarray,
) -> None:
    num_factors = codes.shape[1]
    cells[:] = 0
    rows[:] = 0
    for e in range(len(source)):
        for i in range(num_factors):
            f = action[e] * num_factors + i
            key = _cell(f, source[e], target[e], i, codes, count, which, factor, num_values)
            cells[f, key] += weight[e]
            rows[f, key // num_values] += weight[e]


@njit(cache=True)
def _shift_counts(
    sign: int,
    view: int,
    changed: int,
    codes: np.ndarray,
    source: np.ndarray,
    action: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    start: np.ndarray,
    incident: np.ndarray,
    count: np.ndarray,
    which: np.ndarray,
    factor: np.ndarray,
    as_now: np.ndarray,
    as_next: np.ndarray,
    num_values: int,
    cells: np.ndarray,
    rows: np.ndarray,
    table: np.ndarray,
) -> float:
    """Add (sign 1) or remove (-1) what depends on one entry of the code book; returns the change of entropy."""
    num_factors = codes.shape[1]
    change = 0.0
    for position in range(start[view], start[view + 1]):
        e = incident[position]
        for i in range(num_factors):
            f = action[e] * num_factors + i
            if not ((source[e] == view and as_now[f, changed]) or (target[e] == view and as_next[f, changed])):
                continue
            key = _cell(f, source[e], target[e], i, codes, count, which, factor, num_values)
            row = key // num_values
            before, mass = cells[f, key], rows[f, row]
            after, new_mass = before + sign * weight[e], mass + sign * weight[e]
            change += _xlogx(before, table) - _xlogx(after, table) + _xlogx(new_mass, table) - _xlogx(mass, table)
            cells[f, key] = after
            rows[f, row] = new_mass
    return change


@njit(cache=True)
def _sweep(
    visit: np.ndarray,
    noise: np.ndarray,
    reluctance: np.ndarray,
    taken: np.ndarray,
    codes: np.ndarray,
    source: np.ndarray,
    action: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    start: np.ndarray,
    incident: np.ndarray,
    count: np.ndarray,
    which: np.ndarray,
    factor: np.ndarray,
    as_now: np.ndarray,
    as_next: np.ndarray,
    num_values: int,
    cells: np.ndarray,
    rows: np.ndarray,
    table: np.ndarray,
) -> int:
    num_factors = codes.shape[1]
    moved = 0
    for step in range(len(visit)):
        view, i = visit[step] // num_factors, visit[step] % num_factors
        old = codes[view, i]
        whole, place = 0, 1
        for j in range(num_factors):
            whole = whole * num_values + codes[view, j]
        for _ in range(num_factors - 1 - i):
            place *= num_values
        rest = whole - old * place
        common = (
            view, i, codes, source, action, target, weight, start, incident,
            count, which, factor, as_now, as_next, num_values, cells, rows, table,
        )  # fmt: skip
        _shift_counts(-1, *common)
        best, best_cost = old, np.inf
        for value in range(num_values):
            if value != old and taken[rest + value * place]:
                continue
            codes[view, i] = value
            cost = _shift_counts(1, *common) + reluctance[view, i, value] - noise[step, value]
            _shift_counts(-1, *common)
            if cost < best_cost:
                best, best_cost = value, cost
        codes[view, i] = best
        _shift_counts(1, *common)
        if best != old:
            moved += 1
            taken[whole] = False
            taken[rest + best * place] = True
    return moved


class Refiner:
    """Refines one code book against one set of transitions; all state is in the `CodeBook` and the arguments."""

    def __init__(self, transitions: Transitions, num_values: int, num_actions: int, limits: Limits) -> None:
        """Index the transitions by view.

        Args:
            transitions: what the codes are to predict.
            num_values: K.
            num_actions: A.
            limits: what a structure may look like.
        """
        self.transitions, self.limits = transitions, limits
        self.num_values, self.num_actions = num_values, num_actions
        source, target = transitions.source, transitions.target
        edges = np.arange(len(source))
        loops = source == target
        ends = np.concatenate([source, target[~loops]])
        order = np.argsort(ends, kind="stable")
        self._incident = np.concatenate([edges, edges[~loops]])[order]
        self._start = np.searchsorted(ends[order], np.arange(transitions.num_views + 1))
        counts = np.arange(min(int(transitions.weight.sum()) + 1, 1 << 20), dtype=np.float64)
        self._table = counts * np.log(np.maximum(counts, 1.0))

    def search(self, codes: np.ndarray, start: Structure | None = None) -> CodeBook:
        """The best structure found for `codes`, keeping what is better in `start`."""
        t = self.transitions
        structure, nll = search(
            codes[t.source], t.action, codes[t.target], t.weight,
            num_values=self.num_values, num_actions=self.num_actions, limits=self.limits, start=start,
        )  # fmt: skip
        return CodeBook(codes, structure, nll)

    def refine(
        self, book: CodeBook, reluctance: np.ndarray, noise: float, sweeps: int, rng: np.random.Generator
    ) -> tuple[CodeBook, int]:
        """Some sweeps over every entry of the code book, then a new search of the structure.

        Args:
            book: distinct codes and their structure.
            reluctance: float [V, N, K]: cost in nats of giving a view a value.
            noise: scale of the Gumbel noise (the annealing temperature), in nats.
            sweeps: passes over all entries.
            rng: draws the order and the noise.

        Returns:
            The new code book and the number of entries changed.
        """
        t = self.transitions
        codes = book.codes.copy()
        num_views, num_factors = codes.shape
        count, which, factor = book.structure.arrays()
        families = len(count)
        as_now = np.zeros((families, num_factors), dtype=np.bool_)
        as_next = np.zeros((families, num_factors), dtype=np.bool_)
        for f in range(families):
            as_next[f, f % num_factors] = True
            for p in range(count[f]):
                (as_now if which[f, p] == 0 else as_next)[f, factor[f, p]] = True
        rows = np.zeros((families, self.num_values ** int(count.max())), dtype=np.int32)
        cells = np.zeros((families, self.num_values ** (int(count.max()) + 1)), dtype=np.int32)
        edges = (t.source, t.action, t.target, t.weight)
        _count(codes, *edges, count, which, factor, self.num_values, cells, rows)
        moved = 0
        place = self.num_values ** np.arange(num_factors - 1, -1, -1)
        for _ in range(sweeps):
            visit = rng.permutation(num_views * num_factors)
            gumbel = noise * rng.gumbel(size=(len(visit), self.num_values)) if noise > 0 else np.zeros((1, 1))
            if noise <= 0:
                gumbel = np.broadcast_to(gumbel, (len(visit), self.num_values)).copy()
            taken = np.zeros(self.num_values**num_factors, dtype=np.bool_)
            taken[codes @ place] = True
            moved += _sweep(
                visit, gumbel, reluctance, taken, codes, *edges, self._start, self._incident,
                count, which, factor, as_now, as_next, self.num_values, cells, rows, self._table,
            )  # fmt: skip
        return self.search(codes, book.structure), moved


def separate(logits: np.ndarray) -> np.ndarray:
    """Distinct codes close to what an encoder prefers.

    Views are taken in order of their index; a view whose most probable code is taken gets the most probable
    code among those that differ from it in one factor, or in two, and so on.

    Args:
        logits: float [V, N, K] of the encoder.

    Returns:
        int64 [V, N], pairwise distinct.
    """
    num_views, num_factors, num_values = logits.shape
    assert num_values**num_factors >= num_views, "fewer codes than views"
    ranked = np.argsort(-logits, axis=2, kind="stable")
    codes = ranked[:, :, 0].astype(np.int64)
    loss = np.take_along_axis(logits, ranked[:, :, :1], 2) - logits
    taken: set[tuple[int, ...]] = set()
    for view in range(num_views):
        if tuple(codes[view]) in taken:
            codes[view] = _nearest_free(codes[view], loss[view], taken)
        taken.add(tuple(codes[view]))
    return codes


def _nearest_free(code: np.ndarray, loss: np.ndarray, taken: set[tuple[int, ...]]) -> np.ndarray:
    """The cheapest code not in `taken`, by best-first search over single changes."""
    import heapq

    heap: list[tuple[float, tuple[int, ...], int]] = [(0.0, tuple(int(value) for value in code), 0)]
    while heap:
        cost, candidate, first = heapq.heappop(heap)
        if candidate not in taken:
            return np.array(candidate, dtype=np.int64)
        for i in range(first, len(code)):
            for value in range(loss.shape[1]):
                if value != code[i]:
                    changed = (*candidate[:i], value, *candidate[i + 1 :])
                    heapq.heappush(heap, (cost + float(loss[i, value]), changed, i + 1))
    raise AssertionError("fewer codes than views")
