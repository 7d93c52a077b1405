"""What must, can and cannot hold after a plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nesy.asp.program.facts import LEAST
from nesy.asp.questions.planning import PredicateTruth, outcomes_of
from nesy.dbn.model import TwoSliceDBN


@dataclass(frozen=True)
class Aftermath:
    """What holds after a plan."""

    must: tuple[str, ...]
    """Predicates that hold in every possible outcome."""
    cannot: tuple[str, ...]
    """Predicates that hold in none."""
    can: dict[str, float]
    """The others, with their probability (outcomes whose code leaves a predicate open do not count for it)."""
    codes: int
    """Number of possible outcomes."""
    unknown: float
    """Probability of outcomes that are no code met in experience: nothing is known about their predicates."""
    cut: float
    """Outcomes less probable than this were left out."""
    dropped: float
    """Their probability together."""


def after(
    dbn: TwoSliceDBN, truth: PredicateTruth, start: np.ndarray, plan: Sequence[int], least: float = LEAST
) -> Aftermath:
    """What must, can and cannot hold after a plan.

    A learned model calls hardly anything impossible, so outcomes less probable than `least` are left out. The result
    says how probable they are together.

    Args:
        dbn: the model.
        truth: what holds in a code.
        start: integers [N].
        plan: the actions.
        least: 0 leaves nothing out that can be told (branches below one in a million are cut, or below the least power
            of ten that leaves at most 50,000 outcomes).

    Raises:
        UserError: more than 50,000 outcomes have a probability above 0.001.
    """
    codes, weights, cut = outcomes_of(dbn, start, plan)
    kept = weights >= least if (weights >= least).any() else weights == weights.max()
    codes, weights, cut = codes[kept], weights[kept], max(cut, least)
    holds, fails = truth.of(codes)
    known = (holds | fails).any(axis=1)
    probability = weights @ holds
    must, cannot, can = [], [], {}
    for p, name in enumerate(truth.codebook.predicate_names):
        if holds[:, p].all():
            must.append(name)
        elif fails[:, p].all():
            cannot.append(name)
        else:
            can[name] = float(probability[p])
    dropped = max(0.0, 1.0 - float(weights.sum()))
    return Aftermath(tuple(must), tuple(cannot), can, len(codes), float(weights[~known].sum()), cut, dropped)
