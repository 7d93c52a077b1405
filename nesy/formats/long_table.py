"""The 2DBN as one long table: a row per action, factor, parents' values and value.

The order is that of `TwoSliceDBN.probabilities`: action, factor, row of the table, value.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nesy.dbn.model import TwoSliceDBN
from nesy.names import sliced


@dataclass(frozen=True)
class Part:
    """The rows of one action and factor."""

    action: int
    factor: int
    parents: tuple[str, ...]
    """Names of the parents, with a stroke for those of slice t+1 (see nesy.names.sliced)."""
    parent_values: np.ndarray
    """[rows, parents], of the codes' type."""
    probabilities: np.ndarray
    """float64 [rows, K]."""
    counts: np.ndarray
    """int64 [rows]."""


def parts(dbn: TwoSliceDBN) -> Iterator[Part]:
    """All parts, in order."""
    k = dbn.num_values
    for a in range(dbn.num_actions):
        for i in range(dbn.num_factors):
            parents = dbn.parents(a, i)
            powers = k ** np.arange(len(parents) - 1, -1, -1, dtype=np.int64)
            rows = np.arange(dbn.num_rows(a, i))
            yield Part(
                action=a,
                factor=i,
                parents=tuple(sliced(dbn.factor_names[p], where) for where, p in parents),
                parent_values=(rows[:, None] // powers % k).astype(dbn.code_type),
                probabilities=dbn.cpt(a, i),
                counts=dbn.counts(a, i),
            )
