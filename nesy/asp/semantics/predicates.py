"""What codes mean: short rules between factors and predicates, induced from the codebook, in both directions.

`predicate_rules`  wall_ahead  :- X2 in {0, 3}, X5 = 4         a predicate from factor values
`value_rules`      X2 = 3      :- wall_ahead, not goal_visible  a factor's value from predicates

Predicates are used in the order of the vocabulary, those with a name of their own before places and cells. How well
rules do on views they were not learned from is measured in nesy.asp.semantics.scores.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence

import numpy as np

from nesy.asp.semantics.induction import induce
from nesy.asp.semantics.minimal import minimal_form
from nesy.asp.semantics.rules import Rule, RuleSet, counted, scored
from nesy.dbn.codebook import Codebook
from nesy.dbn.rows import unique_rows
from nesy.errors import UserError

COARSE = 150
"""Where a value has no short exact form, a leaf of its tree holds at least this part of the views: rough and short
rather than exact and long."""

_PLACE = re.compile(r"_\d+_\d+$")


def predicate_rules(
    codebook: Codebook,
    predicate: str,
    held_out: float = 0.25,
    seed: int = 0,
    num_values: int | None = None,
    test: np.ndarray | None = None,
) -> RuleSet:
    """Rules for a predicate from the values of factors.

    Args:
        codebook: the views with their codes.
        predicate: its name.
        held_out: share of the distinct views kept for scoring; 0 to learn from all and score on all.
        seed: of the split.
        num_values: K; by default the largest value met, plus one.
        test: the views kept for scoring, in place of a random share.

    Raises:
        UserError: no such predicate, or no views.
    """
    train, test = split(len(codebook), held_out, seed) if test is None else _without(len(codebook), test)
    k = num_values or int(codebook.codes.max(initial=0)) + 1
    values, truth = codebook.codes.astype(np.int64), codebook.predicate(predicate)
    return scored(predicate, induce(values[train], truth[train], k), values, truth, test)


def value_rules(
    codebook: Codebook,
    factor: int,
    value: int,
    predicates: Sequence[str] | None = None,
    held_out: float = 0.25,
    seed: int = 0,
    test: np.ndarray | None = None,
) -> RuleSet:
    """Rules for `factor = value` from predicates (all of them by default).

    Where there is a small exact form it is the shortest one; otherwise the rules come from a tree. The columns of
    the rules are those of `ordered(predicates)`.

    Raises:
        UserError: no such predicate, or no views.
    """
    train, test = split(len(codebook), held_out, seed) if test is None else _without(len(codebook), test)
    names = ordered(codebook.predicate_names if predicates is None else predicates)
    columns = np.stack([codebook.predicate(name) for name in names], axis=1)
    truth = codebook.codes[:, factor] == value
    rules = _value_rules(columns[train], truth[train])
    return scored(f"{factor}={value}", rules, columns.astype(np.int64), truth, test)


def _value_rules(columns: np.ndarray, truth: np.ndarray) -> tuple[Rule, ...]:
    values = columns.astype(np.int64)
    if truth.any() and not truth.all():
        form = minimal_form(columns, truth)
        if form is not None:
            rules = [counted([(c, (int(holds),)) for c, holds in one], values, truth) for one in form]
            return tuple(sorted(rules, key=lambda rule: -rule.right))
    return induce(values, truth, 2, min_leaf=max(1, len(values) // COARSE))


def ordered(predicates: Sequence[str]) -> tuple[str, ...]:
    """Predicates in the order in which rules use them: names of their own, places, then cells."""

    def rank(name: str) -> int:
        return 0 if not _PLACE.search(name) else 2 if name.startswith("cell_") else 1

    return tuple(sorted(predicates, key=rank))


def split(views: int, held_out: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Views to learn from and views to score on: disjoint, or all and all if nothing is held out.

    Raises:
        UserError: there are no views.
    """
    if not views:
        raise UserError("there are no views to learn from")
    order = np.random.default_rng(seed).permutation(views)
    count = round(held_out * views)
    return (order[count:], order[:count]) if count else (order, order)


def _without(views: int, test: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    train = np.setdiff1d(np.arange(views), test)
    if not len(train):
        raise UserError("there are no views to learn from")
    return train, test


def determined(codebook: Codebook, most_factors: int | None = None, least: int = 1) -> tuple[str, ...]:
    """The predicates that the code determines.

    That is: some factors, at most `most_factors` of them, settle the predicate: of the views met that agree on them no
    two disagree on it. With all factors that says little where every view has a code of its own: then it only says
    that the views can be told apart. With few factors, a value of theirs is shared by many views, and what it
    settles can be learned from some of them for the others.

    Args:
        codebook: the views and their codes.
        most_factors: how many factors may be needed; all by default.
        least: the predicate holds in at least so many views, and fails in as many.
    """
    truth = codebook.predicates.astype(np.int64)
    counts = truth.sum(axis=0)
    open_ = np.minimum(counts, len(truth) - counts) >= max(least, 1)
    chosen = np.zeros(truth.shape[1], dtype=bool)
    factors = codebook.codes.shape[1]
    sizes = [factors] if most_factors is None else range(1, min(most_factors, factors) + 1)
    for size in sizes:
        for subset in itertools.combinations(range(factors), size):
            columns = np.flatnonzero(open_ & ~chosen)
            if not len(columns):
                break
            _, index, total = unique_rows(codebook.codes[:, subset])
            hits = np.zeros((len(total), len(columns)), dtype=np.int64)
            np.add.at(hits, index, truth[:, columns])
            chosen[columns[((hits == 0) | (hits == total[:, None])).all(axis=0)]] = True
    return tuple(name for name, yes in zip(codebook.predicate_names, chosen, strict=True) if yes)
