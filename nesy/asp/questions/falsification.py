"""Looking for a step that breaks a property by trying some: a counterexample, if there are many, costs next to nothing.

What is not found here is left to the proof (nesy.asp.questions.verification).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from nesy.asp.program.conditions import Literal, of_factor
from nesy.dbn.model import TwoSliceDBN

TRIES = 1024

Step = tuple[tuple[int, ...], tuple[int, ...]]


def try_steps(
    dbn: TwoSliceDBN,
    action: int,
    codes: np.ndarray,
    conclusion: Sequence[Literal],
    holds: Callable[[str, np.ndarray], np.ndarray],
    least: float,
    rng: np.random.Generator,
) -> Step | None:
    """A possible step from one of some codes that breaks a conclusion, if one is met.

    Args:
        dbn: the model.
        action: the action.
        codes: uint8 [n, N], codes that satisfy the premise.
        conclusion: literals about the code after.
        holds: truth bool [m] of a predicate in codes [m, N].
        least: values of a row less probable than this are impossible.
        rng: for the values of slice t+1.

    Returns:
        The code and the next code.
    """
    if not len(codes):
        return None
    now = np.resize(codes, (TRIES, dbn.num_factors)).astype(np.int64)
    later = np.zeros_like(now)
    possible = np.ones(TRIES, dtype=bool)
    smallest = max(least, np.finfo(float).tiny)
    for i in dbn.order:
        allowed = dbn.cpt(action, i)[dbn.rows(action, i, now, later)] >= smallest
        possible &= allowed.any(axis=1)
        wish = rng.random(allowed.shape)
        for literal in conclusion:
            if literal.kind == "same":
                wish += np.arange(dbn.num_values) != now[:, i, None]
            elif literal.factor == i:
                wish[:, literal.value] += -1 if literal.kind == "is" else 1
        later[:, i] = np.where(allowed, wish, -2).argmax(axis=1)
    broken = np.zeros(TRIES, dtype=bool)
    for literal in conclusion:
        if literal.kind == "same":
            broken |= (now != later).any(axis=1)
        elif literal.predicate:
            broken |= holds(literal.predicate, later) == (literal.kind == "fails")
        else:
            broken |= ~of_factor(literal, later)
    found = np.flatnonzero(broken & possible)
    if not len(found):
        return None
    return tuple(int(v) for v in now[found[0]]), tuple(int(v) for v in later[found[0]])
