"""Whose particles a question about knowledge is about: the robot's own, or those of the perspective-shifted belief.

What the robot takes the person to see is b~ = Φ(b, configuration, M), with the extracted 2DBN as the model M: no
network is loaded. The person's possible worlds are the codes met in experience, each as probable as b~ makes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.perspective.operator import TableModel, shift

FLOOR = 0.02
"""Each factor of b~ keeps so much for all its values, so that a prior which fits no known code prefers the nearest."""


@dataclass(frozen=True)
class PersonsWorlds:
    """What the person may be seeing."""

    particles: np.ndarray
    """uint8 [n, N]."""
    reachable: bool
    """Whether Φ could imagine being there; otherwise nothing is known about what the person sees."""


def persons_worlds(
    dbn: TwoSliceDBN, codebook: Codebook, code: np.ndarray, configuration: int, particles: int, seed: int
) -> PersonsWorlds:
    """Particles over what the person sees.

    Args:
        dbn: the model.
        codebook: the codes met, with their views.
        code: integers [N], the robot's own code.
        configuration: where the robot sees the person; 0: nowhere.
        particles: how many.
        seed: of the drawing.

    Raises:
        UserError: a code of another model.
    """
    own = np.eye(dbn.num_values, dtype=np.float32)[dbn._codes(code)]
    first = np.unique(codebook.codes, axis=0, return_index=True)[1]
    model = TableModel(dbn, codebook.codes[first], codebook.views[first])
    shifted = shift(own[None], np.array([configuration]), model)
    known = codebook.codes[first]
    floored = (1 - FLOOR) * shifted.beliefs[0].astype(np.float64) + FLOOR / dbn.num_values
    logarithms = np.log(floored)[np.arange(dbn.num_factors), known].sum(axis=1)
    chances = np.exp(logarithms - logarithms.max())
    # codes that fit only by what every factor keeps are no worlds
    chances[chances < 1e-3] = 0.0
    drawn = np.random.default_rng(seed).choice(len(known), size=particles, p=chances / chances.sum())
    return PersonsWorlds(known[drawn], bool(shifted.reachable[0]))
