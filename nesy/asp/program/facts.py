"""The 2DBN and its codebook as ASP facts, in groups that are written only when a program mentions them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

import numpy as np

from nesy.asp.program.names import encode
from nesy.asp.program.sources import MAX_NUMBER
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

SCALE = 1_000_000
"""Probability 1 as an integer weight."""
LEAST = 1e-3
"""Least probability that is written as a fact; what a row loses by that is the fact `dropped`."""

VOCABULARY: dict[str, str] = {
    "factor(F)": "F is a factor, 0 to N-1",
    "value(V)": "V is a value, 0 to K-1",
    "action(A)": "A is an action",
    "scale(W)": "the weight that stands for probability 1",
    "parent(A,F,J,P,S)": "under A the J-th parent (from 1) of F in slice t+1 is factor P of slice t+S (S is 0 or 1)",
    "arity(A,F,N)": "F has N parents under A",
    "row(A,F,X,V,W)": "under A, with the parents' values X (a tuple), F takes the value V with weight W",
    "likely(A,F,X,V)": "the most probable value of that row",
    "met(A,F,X,C)": "the row was met C times in experience (rows never met have C = 0)",
    "dropped(A,F,X,W)": "the weight of the row's values that are too improbable to be written, rounded up",
    "taken(A,C)": "action A was taken C times in experience",
    "changed(A,F,C)": "in C of them the value of F changed",
    "view(I)": "I is a distinct view met in experience",
    "seen(I,C)": "view I was met C times",
    "code(I,F,V)": "in the code of view I, factor F has the value V",
    "cell(I,X,Y,T)": "cell (X,Y) of view I is of the kind T (the viewer looks towards y = 0)",
    "predicate(P)": "P is an observable predicate",
    "holds(I,P)": "P holds in view I",
    "cooccurs(F,V,P,N,M)": "of the M distinct views with F = V, P holds in N",
    "together(F,V,G,U,P,N,M)": "of the M distinct views with F = V and G = U (F < G), P holds in N",
}
"""Every predicate that a program may use, with its meaning (`Facts.vocabulary` names a model's actions too)."""


class Facts:
    """Facts about one model, by predicate."""

    def __init__(self, dbn: TwoSliceDBN, codebook: Codebook | None, *, all_rows: bool = False) -> None:
        """Prepare the facts.

        Args:
            dbn: the model.
            codebook: the views and what holds in them; without it the facts about views are empty.
            all_rows: write the rows never met in experience too.
        """
        self.dbn, self.codebook, self.all_rows = dbn, codebook, all_rows
        self.actions = tuple(encode(name) for name in dbn.action_names)
        self.predicates = () if codebook is None else tuple(encode(n) for n in codebook.predicate_names)
        self._writers: dict[str, Callable[[], Iterable[str]]] = {
            "factor": lambda: [f"factor(0..{dbn.num_factors - 1})."],
            "value": lambda: [f"value(0..{dbn.num_values - 1})."],
            "action": lambda: [f"action({a})." for a in self.actions],
            "scale": lambda: [f"scale({SCALE})."],
            "parent": self._parents,
            "arity": self._arities,
            "row": lambda: self._rows("row"),
            "likely": lambda: self._rows("likely"),
            "met": lambda: self._rows("met"),
            "dropped": lambda: self._rows("dropped"),
            "taken": self._taken,
            "changed": self._changed,
            "view": lambda: [f"view(0..{len(self._book()) - 1})."] if len(self._book()) else [],
            "seen": lambda: [f"seen({i},{c})." for i, c in enumerate(_numbers(self._book().counts))],
            "code": self._codes,
            "cell": self._cells,
            "predicate": lambda: [f"predicate({p})." for p in self.predicates],
            "holds": self._holds,
            "cooccurs": self.cooccurs,
            "together": self.together,
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all predicates that facts exist for."""
        return tuple(self._writers)

    def vocabulary(self) -> dict[str, str]:
        """Every predicate that a program may use, with its meaning in this model."""
        words = dict(VOCABULARY)
        words["action(A)"] += f": {', '.join(self.actions)}"
        if self.codebook is not None:
            kinds, size = map(encode, self.codebook.cell_kinds), self.codebook.views.shape[1:]
            viewer = f"viewer at ({size[0] // 2},{size[1] - 1}), facing y = 0"
            words["cell(I,X,Y,T)"] = f"cell (X,Y) of view I is T: {', '.join(kinds)} ({viewer})"
        return words

    def mentioned(self, *programs: str) -> tuple[str, ...]:
        """The predicates among `names` that the programs may use."""
        words = set(re.findall(r"[a-z]\w*", " ".join(programs)))
        return tuple(name for name in self._writers if name in words)

    def text(self, names: Iterable[str]) -> str:
        """The facts of some predicates, as program text."""
        return "\n".join("\n".join(self._writers[name]()) for name in names) + "\n"

    def dropped(self) -> float:
        """Largest probability that the weights of `row` leave out of one row."""
        table = self.dbn.probabilities if self.all_rows else self.dbn.probabilities[self.dbn.row_counts > 0]
        if not len(table):
            return 0.0
        return float(np.where(table < LEAST, table, 0.0).sum(axis=1).max())

    def _book(self) -> Codebook:
        if self.codebook is not None:
            return self.codebook
        return Codebook(
            views=np.zeros((0, 1, 1), dtype=np.uint8),
            codes=np.zeros((0, self.dbn.num_factors), dtype=np.uint8),
            counts=np.zeros(0, dtype=np.int64),
            predicates=np.zeros((0, 0), dtype=bool),
        )

    def _tables(self) -> Iterable[tuple[str, int, int]]:
        for a, action in enumerate(self.actions):
            for i in range(self.dbn.num_factors):
                yield action, a, i

    def _parents(self) -> Iterable[str]:
        for action, a, i in self._tables():
            for j, (where, p) in enumerate(self.dbn.parents(a, i), 1):
                yield f"parent({action},{i},{j},{p},{where})."

    def _arities(self) -> Iterable[str]:
        for action, a, i in self._tables():
            yield f"arity({action},{i},{len(self.dbn.parents(a, i))})."

    def _rows(self, kind: str) -> Iterable[str]:
        for action, a, i in self._tables():
            counts, table = self.dbn.counts(a, i), self.dbn.cpt(a, i)
            rows = np.arange(len(table)) if self.all_rows else np.flatnonzero(counts)
            texts = self.contexts(rows, len(self.dbn.parents(a, i)))
            head = f"{kind}({action},{i},"
            if kind == "row":
                index, values = np.nonzero(table[rows] >= LEAST)
                weights = np.round(table[rows[index], values] * SCALE).astype(np.int64)
                entries = zip(index.tolist(), values.tolist(), weights.tolist(), strict=True)
                yield from (f"{head}{texts[row]},{value},{weight})." for row, value, weight in entries)
            elif kind == "likely":
                for text, value in zip(texts, table[rows].argmax(axis=1).tolist(), strict=True):
                    yield f"{head}{text},{value})."
            elif kind == "met":
                for text, count in zip(texts, _numbers(counts[rows]), strict=True):
                    yield f"{head}{text},{count})."
            else:
                small = np.where(table[rows] < LEAST, table[rows], 0.0).sum(axis=1)
                left = np.ceil(small * SCALE).astype(np.int64)
                for row in np.flatnonzero(left).tolist():
                    yield f"{head}{texts[row]},{left[row]})."

    def contexts(self, rows: np.ndarray, arity: int) -> list[str]:
        """The parents' values of some rows, as tuples."""
        k = self.dbn.num_values
        if arity == 0:
            return ["()"] * len(rows)
        digits = (rows[:, None] // k ** np.arange(arity - 1, -1, -1, dtype=np.int64)) % k
        if arity == 1:
            return [f"({value},)" for value in digits[:, 0].tolist()]
        return [f"({','.join(map(str, values))})" for values in digits.tolist()]

    def _taken(self) -> Iterable[str]:
        taken = self.dbn.tables.get("taken")
        if taken is not None:
            yield from (f"taken({a},{c})." for a, c in zip(self.actions, _numbers(taken), strict=True))

    def _changed(self) -> Iterable[str]:
        changed = self.dbn.tables.get("changed")
        if changed is not None:
            for (action, _, i), count in zip(self._tables(), _numbers(changed.reshape(-1)), strict=True):
                yield f"changed({action},{i},{count})."

    def _codes(self) -> Iterable[str]:
        for i, code in enumerate(self._book().codes.tolist()):
            yield " ".join(f"code({i},{f},{v})." for f, v in enumerate(code))

    def _cells(self) -> Iterable[str]:
        book = self._book()
        kinds = [encode(kind) for kind in book.cell_kinds]
        for i, view in enumerate(book.views.tolist()):
            yield " ".join(
                f"cell({i},{x},{y},{kinds[cell]})." for x, column in enumerate(view) for y, cell in enumerate(column)
            )

    def _holds(self) -> Iterable[str]:
        views, predicates = np.nonzero(self._book().predicates)
        for i, p in zip(views.tolist(), predicates.tolist(), strict=True):
            yield f"holds({i},{self.predicates[p]})."

    def cooccurs(self, factors: Iterable[int] | None = None, predicates: Iterable[str] | None = None) -> Iterable[str]:
        """Facts cooccurs/5 of some factors and some predicates (constants); of all by default."""
        book, k = self._book(), self.dbn.num_values
        names, truth = self._chosen(predicates)
        for f in range(self.dbn.num_factors) if factors is None else factors:
            chosen = (book.codes[:, f] == np.arange(k)[:, None]).astype(np.int64)
            hits, totals = (chosen @ truth).tolist(), chosen.sum(axis=1).tolist()
            for v in range(k):
                if totals[v]:
                    for p, name in enumerate(names):
                        yield f"cooccurs({f},{v},{name},{hits[v][p]},{totals[v]})."

    def together(self, predicates: Iterable[str] | None = None) -> Iterable[str]:
        """Facts together/7 of some predicates (constants); of all by default."""
        book, k = self._book(), self.dbn.num_values
        names, truth = self._chosen(predicates)
        for f in range(self.dbn.num_factors):
            for g in range(f + 1, self.dbn.num_factors):
                pair = book.codes[:, f].astype(np.int64) * k + book.codes[:, g]
                met, index, totals = np.unique(pair, return_inverse=True, return_counts=True)
                columns = [np.bincount(index.reshape(-1), column, len(met)) for column in truth.T]
                hits = np.array(columns, dtype=np.int64).reshape(len(names), len(met)).T
                for c, total, row in zip(met.tolist(), totals.tolist(), hits.tolist(), strict=True):
                    for name, hit in zip(names, row, strict=True):
                        yield f"together({f},{c // k},{g},{c % k},{name},{hit},{total})."

    def _chosen(self, predicates: Iterable[str] | None) -> tuple[tuple[str, ...], np.ndarray]:
        """Names of some predicates, and their truth in every view, int64 [V, P]."""
        names = self.predicates if predicates is None else tuple(predicates)
        columns = [self.predicates.index(name) for name in names]
        return names, self._book().predicates[:, columns].astype(np.int64)


def _numbers(counts: np.ndarray) -> list[int]:
    """Counts as ASP has them: clingo would make other numbers of those beyond 32 bits.

    Raises:
        UserError: one is too large.
    """
    if counts.size and counts.max() > MAX_NUMBER:
        raise UserError(f"the count {counts.max()} is too large for ASP facts: numbers are at most {MAX_NUMBER}")
    return [int(count) for count in counts.tolist()]
