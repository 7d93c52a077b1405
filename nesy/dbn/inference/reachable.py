"""What the structure of a 2DBN says before anything is computed: dependencies in a slice, values within reach."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from nesy.dbn.model import TwoSliceDBN


def ancestors(dbn: TwoSliceDBN, action: int, factors: tuple[int, ...]) -> tuple[int, ...]:
    """The factors of slice t+1 that `factors` depend on within that slice, with `factors` themselves."""
    found, waiting = set(factors), list(factors)
    while waiting:
        for p in dbn.parents_next[action][waiting.pop()]:
            if p not in found:
                found.add(p)
                waiting.append(p)
    return tuple(sorted(found))


def reachable_values(dbn: TwoSliceDBN, start: np.ndarray, plan: Sequence[int]) -> list[tuple[np.ndarray, ...]]:
    """Values that each factor may have after 0, 1, ..., T steps of a plan: [T + 1][N] arrays of values.

    An upper bound: factors are taken as free of each other. `start` is a code, integers [N], or a belief [N, K].
    """
    start = np.asarray(start)
    belief = np.eye(dbn.num_values)[dbn._codes(start)] if start.ndim == 1 else start
    found = [tuple(np.flatnonzero(row) for row in belief)]
    full = np.arange(dbn.num_values)
    for action in plan:
        later: dict[int, np.ndarray] = {}
        for i in dbn.order:
            sets = [later[p] if where else found[-1][p] for where, p in dbn.parents(action, i)]
            possible = dbn.tensor(action, i)[np.ix_(*sets, full)] > 0
            later[i] = np.flatnonzero(possible.reshape(-1, dbn.num_values).any(axis=0))
        found.append(tuple(later[i] for i in range(dbn.num_factors)))
    return found
