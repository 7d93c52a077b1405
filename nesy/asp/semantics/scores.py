"""How well the rules of nesy.asp.semantics.predicates do on views that they were not learned from.

The views are the distinct views of the codebook, each once. They are divided into folds; each fold is scored with
rules that were learned from the other folds alone, so every view is judged once, by rules that never saw it. Two
divisions: `views`, at random; `maps`, by the maps that a view was met on: the maps are divided at random, a fold's
views are those met on no other map, and the rules are learned from views met on other maps.

Precision: of the views where a rule applies, those where its conclusion holds. Recall: of the views where the
conclusion holds, those where a rule applies. Both from the counts of all folds together, then averaged over
predicates, or over the values of all factors, with equal weights (macro average).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from nesy.asp.semantics.predicates import determined, ordered, predicate_rules, value_rules
from nesy.asp.semantics.rules import RuleSet, sentence
from nesy.dbn.codebook import Codebook
from nesy.dbn.rows import unique_rows

FOLDS = 4
SUPPORT = 20
"""A predicate is averaged over if it holds in at least so many distinct views, and fails in as many: with fewer, a
fold holds hardly any."""
MOST_FACTORS = 3
"""... and if at most so many factors settle it (`determined`)."""
OVERALL = ("count", "precision", "recall", "length")
"""Figures over all predicates with support; folds of maps would take twice the time to say the same."""


def scores(
    codebook: Codebook,
    num_values: int,
    factor_names: Sequence[str],
    maps_of_views: Sequence[Sequence[int]] | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Scores of the rules in both directions.

    Args:
        codebook: views, codes, predicates.
        num_values: K.
        factor_names: N names.
        maps_of_views: for each view the maps it was met on; None where that is not known.
        seed: of the divisions into folds.

    Returns:
        `predicates`: predicates from codes, those that the code determines by few factors; `all_predicates`: all
        that vary enough (without maps); `by_factors`: the same by the least number of factors that settle a predicate;
        `values`: values from predicates; each with `count`, macro averages
        `precision` and `recall` over held-out views, `length` (mean conditions of the rules from all views), the
        same by maps (`maps_precision`, `maps_recall`) and `each`, one record per predicate or value.
    """
    divisions = {"": folds(len(codebook), seed)}
    if maps_of_views is not None:
        divisions["maps_"] = map_folds(maps_of_views, seed)
    chosen = set(determined(codebook, MOST_FACTORS, SUPPORT))
    supported = set(determined(codebook, None, SUPPORT))
    predicates = {}
    for name in (n for n in codebook.predicate_names if n in set(determined(codebook))):
        record = _record(
            partial(predicate_rules, codebook, name, held_out=0.0, num_values=num_values),
            codebook.codes.astype(np.int64),
            codebook.predicate(name),
            divisions if name in chosen else {"": divisions[""]} if name in supported else {},
            factor_names,
            predicates=False,
        )
        predicates[name] = {**record, "counts": name in chosen, "supported": name in supported}
    names = ordered(codebook.predicate_names)
    columns = np.stack([codebook.predicate(name) for name in names], axis=1).astype(np.int64)
    values = {}
    for factor, factor_name in enumerate(factor_names):
        for value in np.unique(codebook.codes[:, factor]).tolist():
            record = _record(
                partial(value_rules, codebook, factor, value, held_out=0.0),
                columns,
                codebook.codes[:, factor] == value,
                divisions,
                names,
                predicates=True,
            )
            values[f"{factor_name}={value}"] = {**record, "counts": True}
    return {
        "predicates": _macro(predicates),
        "all_predicates": _overall(predicates, supported),
        "by_factors": {
            str(number): _overall(predicates, names) for number, names in _by_factors(codebook, supported).items()
        },
        "values": _macro(values),
        "folds": FOLDS,
        "views": len(codebook),
    }


def _by_factors(codebook: Codebook, names: set[str]) -> dict[int, set[str]]:
    """Predicates by the least number of factors that settle them; those that no number settles are left out."""
    found: dict[int, set[str]] = {}
    left = set(names)
    for number in range(1, codebook.codes.shape[1] + 1):
        if not left:
            break
        here = left & set(determined(codebook, number))
        if here:
            found[number] = here
        left -= here
    return found


def _overall(each: dict[str, dict[str, Any]], names: set[str]) -> dict[str, Any]:
    chosen = {name: {**record, "counts": name in names} for name, record in each.items()}
    return {figure: value for figure, value in _macro(chosen).items() if figure in OVERALL}


def folds(views: int, seed: int) -> list[np.ndarray]:
    """The views of each fold, divided at random."""
    return [np.sort(part) for part in np.array_split(np.random.default_rng(seed).permutation(views), FOLDS)]


def map_folds(maps_of_views: Sequence[Sequence[int]], seed: int) -> list[np.ndarray]:
    """The views of each fold, divided by maps: those met on maps of one fold only.

    A view met on maps of several folds is in none: it is always there to learn from.
    """
    maps = sorted({m for found in maps_of_views for m in found})
    order = np.random.default_rng(seed).permutation(len(maps))
    fold_of = {maps[m]: fold for fold, part in enumerate(np.array_split(order, FOLDS)) for m in part.tolist()}
    where = [{fold_of[m] for m in found} for found in maps_of_views]
    return [np.array([v for v, found in enumerate(where) if found == {fold}], dtype=np.int64) for fold in range(FOLDS)]


def maps_of(codebook: Codebook, views: np.ndarray, map_ids: np.ndarray) -> list[list[int]]:
    """For each view of the codebook the maps on which it was met.

    Args:
        codebook: the distinct views.
        views: uint8 [n, v, v], views met.
        map_ids: int64 [n], the maps they were met on.
    """
    both = np.concatenate([codebook.views, views]).reshape(len(codebook) + len(views), -1)
    _, index, _ = unique_rows(both)
    place = np.full(int(index.max()) + 1, -1)
    place[index[: len(codebook)]] = np.arange(len(codebook))
    pairs = np.unique(np.stack([place[index[len(codebook) :]], map_ids], axis=1), axis=0)
    found: list[list[int]] = [[] for _ in range(len(codebook))]
    for view, which in pairs[pairs[:, 0] >= 0].tolist():
        found[view].append(which)
    return found


def _record(
    learn: Callable[..., RuleSet],
    values: np.ndarray,
    truth: np.ndarray,
    divisions: dict[str, list[np.ndarray]],
    names: Sequence[str],
    predicates: bool,
) -> dict[str, Any]:
    everything = learn()
    record: dict[str, Any] = {
        "views": int(truth.sum()),
        "accuracy": everything.accuracy,
        "rules": len(everything.rules),
        "length": everything.length,
        "text": [sentence(rule, names, predicates) for rule in everything.rules],
    }
    for prefix, division in divisions.items():
        right = said = wanted = 0
        for test in division:
            if not len(test):
                continue
            here = learn(test=test).applies(values[test])
            right += int((here & truth[test]).sum())
            said += int(here.sum())
            wanted += int(truth[test].sum())
        record[f"{prefix}precision"] = right / said if said else 1.0
        record[f"{prefix}recall"] = right / wanted if wanted else 1.0
        record[f"{prefix}held_out"] = wanted
    return record


def _macro(each: dict[str, dict[str, Any]]) -> dict[str, Any]:
    counted = [record for record in each.values() if record["counts"]]
    result: dict[str, Any] = {"count": len(counted)}
    for figure in ("precision", "recall", "length", "maps_precision", "maps_recall"):
        # what no held-out view shows cannot be averaged
        held_out = "maps_held_out" if figure.startswith("maps_") else "held_out"
        found = [record[figure] for record in counted if figure in record and record.get(held_out, 1)]
        if found:
            result[figure] = float(np.mean(found))
    return {**result, "each": each}
