"""What the page's interactive graph of the 2DBN shows, as plain JSON values: parents, tables, meanings, rules.

A table can have tens of thousands of rows, so that only the rows most often met in experience are handed over, and
how many are left out is said beside them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nesy.dbn import Codebook, TwoSliceDBN
from nesy.dbn.graph import arc_strength

MOST_ROWS = 120
"""Rows per table on the page."""
MOST_VIEWS = 4
"""Pictures per value."""
MOST_PREDICATES = 3
"""Predicates per factor whose rules are looked for: those that tell most about the factor."""
MOST_RULES = 6
"""Rules per predicate on the page."""
SURE = 0.95
"""Share of the views with a value in which a predicate must hold (or fail) to be said of the value."""


def graph_data(dbn: TwoSliceDBN, book: Codebook) -> dict[str, Any]:
    """Everything about every factor.

    Returns:
        `factors`, `actions`, `num_values`, `cell_kinds`, `tables` [A][N], `values` [N][K], `rules` [N], `views`
        (distinct pictures, each once), `total_views`.
    """
    views: dict[str, int] = {}
    return {
        "factors": list(dbn.factor_names),
        "actions": list(dbn.action_names),
        "num_values": dbn.num_values,
        "cell_kinds": list(book.cell_kinds),
        "tables": [[_table(dbn, a, i) for i in range(dbn.num_factors)] for a in range(dbn.num_actions)],
        "values": [_values(dbn, book, i, views) for i in range(dbn.num_factors)],
        "rules": _rules(dbn, book),
        "total_views": len(book),
        "views": list(views),
    }


def _table(dbn: TwoSliceDBN, action: int, factor: int) -> dict[str, Any]:
    """Parents with their strengths, and the rows most often met: [parent values, visits, [[value, chance], ...]]."""
    counts, table = dbn.counts(action, factor), dbn.cpt(action, factor)
    met = int((counts > 0).sum())
    parents = dbn.parents(action, factor)
    shown = np.argsort(-counts, kind="stable")[: min(MOST_ROWS, met if met else MOST_ROWS)]
    digits = np.stack(
        [shown // dbn.num_values ** (len(parents) - 1 - position) % dbn.num_values for position in range(len(parents))],
        axis=1,
    ) if parents else np.zeros((len(shown), 0), np.int64)  # fmt: skip
    return {
        "parents": [
            [where, int(parent), round(strength, 4)]
            for (where, parent), strength in zip(parents, arc_strength(dbn, action, factor), strict=True)
        ],
        "rows": [
            [digits[position].tolist(), int(counts[row]), _distribution(table[row])]
            for position, row in enumerate(shown)
        ],
        "num_rows": len(table),
        "met": met,
        "visits": int(counts.sum()),
        "visits_shown": int(counts[shown].sum()),
    }


def _distribution(row: np.ndarray, least: float = 0.005) -> list[list[float]]:
    """[value, chance] of the values that matter, the most probable first."""
    return [[int(k), round(float(row[k]), 3)] for k in np.argsort(-row, kind="stable") if row[k] >= least]


def _values(dbn: TwoSliceDBN, book: Codebook, factor: int, views: dict[str, int]) -> list[dict[str, Any]]:
    """Per value: how often met, what it means, and the views most often met with it."""
    base = book.predicates.mean(axis=0) if len(book) else np.zeros(len(book.predicate_names))
    described = []
    for value in range(dbn.num_values):
        having = np.flatnonzero(book.codes[:, factor] == value)
        often = having[np.argsort(-book.counts[having], kind="stable")][:MOST_VIEWS]
        share = book.predicates[having].mean(axis=0) if len(having) else base
        telling = [int(p) for p in np.argsort(-np.abs(share - base), kind="stable") if abs(share[p] - base[p]) >= 0.05]
        described.append(
            {
                "meaning": dbn.value_meanings[factor][value] if dbn.value_meanings else "",
                "views": len(having),
                "visits": int(book.counts[having].sum()),
                "pictures": [
                    views.setdefault("".join(map(str, book.views[row].reshape(-1).tolist())), len(views))
                    for row in often
                ],
                "holds": [book.predicate_names[p] for p in telling if share[p] >= SURE][:6],
                "fails": [book.predicate_names[p] for p in telling if share[p] <= 1 - SURE][:6],
                "leans": [[book.predicate_names[p], round(float(share[p]), 3), round(float(base[p]), 3)]
                          for p in telling if 1 - SURE < share[p] < SURE][:3],
            }
        )  # fmt: skip
    return described


def _rules(dbn: TwoSliceDBN, book: Codebook) -> list[list[dict[str, Any]]]:
    """Per factor: rules of the predicates that it tells most about, as texts."""
    from nesy.asp.semantics.predicates import predicate_rules

    gains = information(book.codes, book.predicates, dbn.num_values)
    wanted = [
        [int(p) for p in np.argsort(-gains[i], kind="stable")[:MOST_PREDICATES] if gains[i, p] > 0.01]
        for i in range(dbn.num_factors)
    ]
    found = {p: predicate_rules(book, book.predicate_names[p], num_values=dbn.num_values)
             for p in sorted({p for chosen in wanted for p in chosen})}  # fmt: skip
    described = []
    for factor, chosen in enumerate(wanted):
        entries = []
        for p in chosen:
            rules = [rule for rule in found[p].rules if any(column == factor for column, _ in rule.conditions)]
            texts = [
                " and ".join(_condition(dbn, column, allowed) for column, allowed in rule.conditions)
                for rule in rules[:MOST_RULES]
            ]
            entries.append(
                {
                    "predicate": book.predicate_names[p],
                    "meaning": book.predicate_meanings[p],
                    "information": round(float(gains[factor, p]), 3),
                    "rules": [
                        [text, rule.right, rule.applies] for text, rule in zip(texts, rules[:MOST_RULES], strict=True)
                    ],
                    "left_out": len(found[p].rules) - len(texts),
                    "precision": round(found[p].precision, 3),
                    "recall": round(found[p].recall, 3),
                }
            )
        described.append(entries)
    return described


def _condition(dbn: TwoSliceDBN, factor: int, allowed: tuple[int, ...]) -> str:
    name = dbn.factor_names[factor]
    if len(allowed) == 1:
        return f"{name} = {allowed[0]}"
    excluded = [value for value in range(dbn.num_values) if value not in allowed]
    if len(excluded) == 1:
        return f"{name} ≠ {excluded[0]}"
    return f"{name} in {{{', '.join(map(str, allowed))}}}"


def information(codes: np.ndarray, predicates: np.ndarray, num_values: int) -> np.ndarray:
    """Mutual information between every factor and every predicate over the distinct views, in bits.

    Args:
        codes: integers [V, N].
        predicates: bool [V, P].
        num_values: K.

    Returns:
        float64 [N, P].
    """
    total = max(len(codes), 1)
    base = _entropy(predicates.sum(axis=0) / total)
    gains = np.tile(base, (codes.shape[1], 1))
    for factor in range(codes.shape[1]):
        for value in range(num_values):
            having = predicates[codes[:, factor] == value]
            if len(having):
                gains[factor] -= len(having) / total * _entropy(having.mean(axis=0))
    return gains


def _entropy(chance: np.ndarray) -> np.ndarray:
    """Entropy of a coin in bits, elementwise."""
    inside = np.clip(chance, 1e-12, 1 - 1e-12)
    return np.asarray(-inside * np.log2(inside) - (1 - inside) * np.log2(1 - inside))
