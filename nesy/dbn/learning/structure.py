"""Who depends on whom, from transitions: a score-based search for the parents of every factor and action.

Scores of a parent set with q rows, counts N_jk of row j and value k, N_j = sum_k N_jk:

    BDeu  sum_j [ G(s/q) - G(s/q + N_j) + sum_k G(s/qK + N_jk) - G(s/qK) ],  G = log Gamma
          (Heckerman, Geiger and Chickering 1995; s is the equivalent sample size)
    BIC   log-likelihood - (log N) / 2 * q (K - 1)
    AIC   log-likelihood - q (K - 1)

Counts may be fractions: the children are distributions, so that a network's conditionals can be scored too.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from nesy.dbn.rows import unique_rows
from nesy.errors import UserError

Score = Literal["bdeu", "bic", "aic"]
SCORES: tuple[Score, ...] = ("bdeu", "bic", "aic")


@dataclass(frozen=True)
class Search:
    """How parents are searched for."""

    score: Score = "bdeu"
    """What a parent set is judged by."""
    sample_size: float = 1.0
    """Equivalent sample size of BDeu."""
    max_parents: int = 4
    """Most parents from slice t."""
    max_next: int = 0
    """Most parents from slice t+1."""
    exhaustive: int = 2
    """Parent sets up to this size are all tried, of slice t or, with `both`, of both slices; larger ones grow parent
    by parent."""
    both: bool = False
    """Whether parents of slice t+1 are as likely as those of slice t."""
    lean: bool = False
    """Whether parents go without which the steps met fall into the same rows: BDeu likes such copies of others."""
    max_rows: int = 1 << 20
    """Most rows of a table: factors of many values have fewer parents."""


class Candidates:
    """Values of possible parents; children that share them share what is computed of them alone."""

    def __init__(self, values: np.ndarray) -> None:
        """Merge equal combinations, so that every score works on few rows.

        Args:
            values: uint8 [n, C].
        """
        first, self.index, _ = unique_rows(values)
        self.merged = values[first].astype(np.int64)
        self._groups: dict[tuple[int, ...], np.ndarray] = {}

    def groups(self, chosen: tuple[int, ...]) -> np.ndarray:
        """Which of the distinct values of some columns each merged combination has: int64 [m]."""
        if chosen not in self._groups:
            size = int(self.merged.max(initial=0)) + 1
            row = np.zeros(len(self.merged), dtype=np.int64)
            for column in chosen:
                row = row * size + self.merged[:, column]
            self._groups[chosen] = np.unique(row, return_inverse=True)[1].reshape(-1)
        return self._groups[chosen]


def learn_parents(
    candidates: np.ndarray | Candidates,
    child: np.ndarray,
    weights: np.ndarray,
    num_values: int,
    limits: Sequence[int],
    search: Search,
) -> tuple[int, ...]:
    """The best parents of one factor under one action.

    Args:
        candidates: integers [n, C]: values of the possible parents, or what was made of them for several children.
        child: float [n, M]: distribution of the child in every transition (one-hot where it was observed).
        weights: float [n]: how much each transition counts.
        num_values: K, values that a candidate may have.
        limits: (S, C): the first S candidates belong to slice t, the others to slice t+1.
        search: what is searched.

    Returns:
        Columns of `candidates`, ascending.

    Raises:
        UserError: there is no such score.
    """
    if search.score not in SCORES:
        raise UserError(f"no score '{search.score}'; the scores are {', '.join(SCORES)}")
    split, total = limits
    known: dict[tuple[int, ...], float] = {}
    shared = candidates if isinstance(candidates, Candidates) else Candidates(candidates)
    number = len(shared.merged)
    if not number:
        return ()
    counts = np.stack(
        [np.bincount(shared.index, weights * column, minlength=number) for column in child.T if column.any()], axis=1
    )
    size = child.shape[1]

    def allowed(chosen: tuple[int, ...]) -> bool:
        later = sum(c >= split for c in chosen)
        few = later <= search.max_next and len(chosen) - later <= search.max_parents
        return few and num_values ** len(chosen) <= search.max_rows

    def score(chosen: tuple[int, ...]) -> float:
        if chosen not in known:
            rows = float(num_values) ** len(chosen)
            known[chosen] = _score(shared.groups(chosen), counts, size, rows, search)
        return known[chosen]

    tried = range(total if search.both else split)
    sets = (c for depth in range(search.exhaustive + 1) for c in itertools.combinations(tried, depth))
    best = _climb(max(filter(allowed, sets), key=score), range(total), allowed, score)
    return _lean(best, shared) if search.lean else best


def _lean(chosen: tuple[int, ...], candidates: Candidates) -> tuple[int, ...]:
    """The parents without those that tell no two of the combinations apart that the others do not."""
    for one in reversed(chosen):
        rest = tuple(c for c in chosen if c != one)
        if candidates.groups(rest).max(initial=0) == candidates.groups(chosen).max(initial=0):
            chosen = rest
    return chosen


def _climb(
    best: tuple[int, ...],
    candidates: range,
    allowed: Callable[[tuple[int, ...]], bool],
    score: Callable[[tuple[int, ...]], float],
) -> tuple[int, ...]:
    """Add, drop or exchange one parent as long as the score rises."""
    while True:
        chosen = set(best)
        moves = [tuple(sorted(chosen | {c})) for c in candidates if c not in chosen]
        moves += [tuple(sorted(chosen - {c})) for c in best]
        moves += [tuple(sorted(chosen - {c} | {d})) for c in best for d in candidates if d not in chosen]
        moves = [move for move in moves if allowed(move)]
        better = max(moves, key=score, default=best)
        if score(better) <= score(best) + 1e-9:
            return best
        best = better


def _score(index: np.ndarray, counts: np.ndarray, size: int, q: float, search: Search) -> float:
    """The score of one parent set.

    Args:
        index: int64 [m]: the row that each combination of candidates belongs to.
        counts: float [m, M]: counts of the child's values; values that it never has can be left out.
        size: how many values the child has, those left out included.
        q: rows of the table.
        search: what is scored.
    """
    from scipy.special import gammaln

    table = np.stack([np.bincount(index, column) for column in counts.T], axis=1)
    totals = table.sum(axis=1)
    if search.score == "bdeu":
        per_row, per_entry = search.sample_size / q, search.sample_size / (q * size)
        rows = gammaln(per_row) - gammaln(per_row + totals)
        # an entry without counts adds nothing
        met = table[table > 0]
        return float(rows.sum() + gammaln(per_entry + met).sum() - len(met) * gammaln(per_entry))
    with np.errstate(divide="ignore", invalid="ignore"):
        likelihood = float(np.where(table > 0, table * np.log(table / totals[:, None]), 0.0).sum())
    free = q * (size - 1)
    return likelihood - (0.5 * np.log(max(totals.sum(), 2.0)) if search.score == "bic" else 1.0) * free
