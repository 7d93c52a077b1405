"""Can people read the codes? How the factors line up with the observable predicates of a domain.

Per predicate: the fewest factors whose values determine it on all views, and the normalised mutual information
with the factor that tells most about it.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np


def readability(codes: np.ndarray, truth: np.ndarray, names: tuple[str, ...], num_values: int = 8) -> dict[str, Any]:
    """Readability of a code book.

    Args:
        codes: int [V, N], codes of distinct views.
        truth: bool [V, P], the predicates on those views; constant ones are left out.
        names: of the P predicates.
        num_values: K.

    Returns:
        `predicates`: per name `factors` (the smallest set that determines it, the first in lexical order; all N
        where none does) and `information` (normalised mutual information with the best factor), `best_factor`;
        `mean_factors` and `mean_information` over predicates; `single` and `pairs`, the shares that one factor and
        that at most two factors determine.
    """
    assert truth.shape == (len(codes), len(names)), truth.shape
    varies = np.flatnonzero(truth.any(0) & ~truth.all(0))
    num_factors = codes.shape[1]
    chosen: dict[int, tuple[int, ...]] = {}
    for size in range(1, num_factors + 1):
        for factors in combinations(range(num_factors), size):
            open_ones = np.array([p for p in varies if p not in chosen], dtype=np.int64)
            if len(open_ones):
                for p in open_ones[_determined(codes[:, factors], truth[:, open_ones], num_values)]:
                    chosen[int(p)] = factors
    information = np.array([_information(codes[:, i], truth[:, varies], num_values) for i in range(num_factors)])
    report = {
        names[p]: {
            "factors": list(chosen.get(int(p), range(num_factors))),
            "best_factor": int(information[:, column].argmax()),
            "information": float(information[:, column].max()),
        }
        for column, p in enumerate(varies)
    }
    counts = np.array([len(chosen.get(int(p), range(num_factors))) for p in varies])
    return {
        "mean_factors": float(counts.mean()) if len(counts) else 0.0,
        "single": float((counts == 1).mean()) if len(counts) else 1.0,
        "pairs": float((counts <= 2).mean()) if len(counts) else 1.0,
        "mean_information": float(information.max(0).mean()) if len(counts) else 1.0,
        "predicates": report,
    }


def _groups(columns: np.ndarray, num_values: int) -> np.ndarray:
    key = np.zeros(len(columns), dtype=np.int64)
    for factor in range(columns.shape[1]):
        key = key * num_values + columns[:, factor]
    return np.unique(key, return_inverse=True)[1]


def _determined(columns: np.ndarray, truth: np.ndarray, num_values: int) -> np.ndarray:
    """Bool [P]: whether the columns' values decide each predicate."""
    group = _groups(columns, num_values)
    size = np.bincount(group)
    order = np.argsort(group, kind="stable")
    true = np.add.reduceat(truth[order].astype(np.int64), np.cumsum(size) - size, axis=0)
    return np.asarray(((true == 0) | (true == size[:, None])).all(0))


def _information(column: np.ndarray, truth: np.ndarray, num_values: int) -> np.ndarray:
    """Normalised mutual information [P], 2 I / (H + H), of one factor with every predicate."""
    counts = np.stack([np.bincount(column, weights=side, minlength=num_values) for side in truth.T.astype(float)])
    sizes = np.bincount(column, minlength=num_values)
    joint = np.stack([counts, sizes - counts], axis=1) / len(column)  # [P, 2, K]
    of_predicate = np.array([_entropy(part.sum(1)) for part in joint])
    of_factor = _entropy(sizes / len(column))
    of_both = np.array([_entropy(part.reshape(-1)) for part in joint])
    total = of_predicate + of_factor
    return np.asarray(np.where(total > 0, 2 * (total - of_both) / np.maximum(total, 1e-12), 0.0))


def _entropy(chances: np.ndarray) -> float:
    positive = chances[chances > 0]
    return float(-(positive * np.log(positive)).sum())
