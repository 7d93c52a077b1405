"""Refinement of the codes: coordinate descent on the next-code likelihood, one factor of one view at a time.

With few distinct views, the likelihood of a 2DBN whose tables are counted from the codes can be followed
exactly while single entries of the code book change. A move gives view v the value k in factor i; its cost is
the change of the total conditional entropy (nats times weight) plus a given reluctance to give that value. Codes
stay distinct. Noise that fades over the rounds (simulated annealing with Gumbel noise, i.e. Gibbs sampling) keeps
the descent out of poor minima. After every round the structure is searched anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nesy.compiled import njit
from nesy.world_model.codes.counting import (
    Counts,
    Edges,
    Families,
    count,
    edges_of,
    families_of,
    logs_up_to,
    shift_edge,
)
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
def _shift(
    sign: int, view: int, changed: int, codes: np.ndarray, start: np.ndarray, incident: np.ndarray, edges: Edges,
    families: Families, counts: Counts, num_values: int,
) -> float:  # fmt: skip
    """Add (sign 1) or remove (-1) what depends on one entry of the code book; returns the change of entropy."""
    change = 0.0
    for position in range(start[view], start[view + 1]):
        e = incident[position]
        before, after = edges.source[e] == view, edges.target[e] == view
        change += shift_edge(sign, e, before, after, changed, codes, edges, families, counts, num_values)
    return change


@njit(cache=True)
def _sweep(
    visit: np.ndarray, noise: np.ndarray, reluctance: np.ndarray, taken: np.ndarray, codes: np.ndarray,
    start: np.ndarray, incident: np.ndarray, edges: Edges, families: Families, counts: Counts, num_values: int,
) -> int:  # fmt: skip
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
        common = (view, i, codes, start, incident, edges, families, counts, num_values)
        _shift(-1, *common)
        best, best_cost = old, np.inf
        for value in range(num_values):
            if value != old and taken[rest + value * place]:
                continue
            codes[view, i] = value
            cost = _shift(1, *common) + reluctance[view, i, value] - noise[step, value]
            _shift(-1, *common)
            if cost < best_cost:
                best, best_cost = value, cost
        codes[view, i] = best
        _shift(1, *common)
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
        self.edges = edges_of(transitions)
        self.logs = logs_up_to(int(transitions.weight.sum()))

    def search(self, codes: np.ndarray, start: Structure | None = None) -> CodeBook:
        """The best structure found for `codes`, keeping what is better in `start`."""
        t = self.transitions
        structure, nll = search(
            codes[t.source], t.action, codes[t.target], t.weight,
            num_values=self.num_values, num_actions=self.num_actions, limits=self.limits, start=start,
        )  # fmt: skip
        return CodeBook(codes, structure, nll)

    def refine(
        self,
        book: CodeBook,
        reluctance: np.ndarray,
        noise: float,
        sweeps: int,
        rng: np.random.Generator,
        factors: list[int],
    ) -> tuple[CodeBook, int]:
        """Some sweeps over the entries of some factors, then a new search of the structure.

        Args:
            book: distinct codes and their structure.
            reluctance: float [V, N, K]: cost in nats of giving a view a value.
            noise: scale of the Gumbel noise (the annealing temperature), in nats.
            sweeps: passes over all entries.
            rng: draws the order and the noise.
            factors: those whose values may change.

        Returns:
            The new code book and the number of entries changed.
        """
        codes = book.codes.copy()
        num_views, num_factors = codes.shape
        families = families_of(book.structure)
        counts = count(codes, self.edges, families, self.num_values, self.logs)
        moved = 0
        place = self.num_values ** np.arange(num_factors - 1, -1, -1)
        for _ in range(sweeps):
            entries = np.arange(num_views)[:, None] * num_factors + np.array(factors, dtype=np.int64)
            visit = rng.permutation(entries.reshape(-1))
            gumbel = np.zeros((len(visit), self.num_values))
            if noise > 0:
                gumbel = noise * rng.gumbel(size=gumbel.shape)
            taken = np.zeros(self.num_values**num_factors, dtype=np.bool_)
            taken[codes @ place] = True
            moved += _sweep(
                visit, gumbel, reluctance, taken, codes, self._start, self._incident,
                self.edges, families, counts, self.num_values,
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
