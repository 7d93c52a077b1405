"""A particle filter over codes: transitions from the 2DBN, likelihood weighting, systematic resampling.

Where the factored filter forgets how factors hang together, particles remember it. An observation that no
particle explains must not end the filter: see `ParticleFilter.update`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nesy.dbn.inference.kernels import packed, sample_codes
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

Propose = Callable[[int, np.random.Generator], np.ndarray]
"""How many codes, and a source of randomness -> uint8 [n, N]: codes that explain the present observation."""


@dataclass(frozen=True)
class Particles:
    """A belief as weighted codes."""

    codes: np.ndarray
    """uint8 [n, N]."""
    weights: np.ndarray
    """float64 [n], sum 1."""
    depleted: bool = False
    """Whether the last observation was explained by no particle, so that the fallback stepped in."""

    @property
    def effective(self) -> float:
        """Effective number of particles, 1 / sum of squared weights."""
        return float(1.0 / np.square(self.weights).sum())

    def marginals(self, num_values: int) -> np.ndarray:
        """Marginal distribution of each factor, float64 [N, K]."""
        return np.stack([np.bincount(column, weights=self.weights, minlength=num_values) for column in self.codes.T])


class ParticleFilter:
    """Filters beliefs over the codes of one model."""

    def __init__(self, dbn: TwoSliceDBN, resample_below: float = 0.5) -> None:
        """A filter that resamples when the effective number falls below a share of the particles."""
        self.dbn = dbn
        self.resample_below = resample_below
        self._tables = packed(dbn)

    def start(self, codes: np.ndarray) -> Particles:
        """Equally weighted particles.

        Raises:
            UserError: no codes, or codes of another model.
        """
        codes = self.dbn._codes(codes).astype(self.dbn.code_type)
        if codes.ndim != 2 or not len(codes):
            raise UserError("a particle filter starts from at least one code, integers [n, N]")
        return Particles(codes, np.full(len(codes), 1.0 / len(codes)))

    def update(
        self,
        belief: Particles,
        action: int,
        likelihood: np.ndarray | Callable[[np.ndarray], np.ndarray],
        rng: np.random.Generator,
        propose: Propose | None = None,
    ) -> Particles:
        """One action and one observation.

        Where no particle explains the observation: with `propose`, the particles are drawn anew from it; without,
        with a likelihood per factor, factors are weighted one by one as far as that is possible (each factor whose
        observed values some particle has keeps those particles, in the model's order); else the prediction stays.
        The result says so (`depleted`).

        Args:
            belief: the particles.
            action: the action.
            likelihood: [N, K] per factor and value, or a function of codes uint8 [n, N] -> [n].
            rng: source of randomness.
            propose: draws codes that explain the observation.

        Raises:
            UserError: no such action, or likelihoods of a wrong shape or sign.
        """
        action = self.dbn.action_index(action)
        number = len(belief.codes)
        uniforms = rng.random(belief.codes.shape)
        codes = sample_codes(self._tables, belief.codes, np.full(number, action), uniforms)
        factors = np.arange(self.dbn.num_factors)
        if callable(likelihood):
            chances = np.asarray(likelihood(codes), dtype=np.float64)
            per_factor = None
        else:
            per_factor = np.asarray(likelihood, dtype=np.float64)
            if per_factor.shape != (self.dbn.num_factors, self.dbn.num_values):
                raise UserError(f"a likelihood has the shape [{self.dbn.num_factors}, {self.dbn.num_values}]")
            chances = per_factor[factors, codes].prod(axis=1)
        if chances.shape != (number,) or not (chances >= 0).all():
            raise UserError("a likelihood has one number >= 0 per particle")
        weights = belief.weights * chances
        if weights.sum() > 0:
            return self._resampled(Particles(codes, weights / weights.sum()), rng)
        if propose is not None:
            return Particles(self.start(propose(number, rng)).codes, np.full(number, 1.0 / number), True)
        weights = belief.weights
        for i in self.dbn.order if per_factor is not None else ():
            assert per_factor is not None
            narrowed = weights * per_factor[i, codes[:, i]]
            if narrowed.sum() > 0:
                weights = narrowed
        return Particles(codes, weights / weights.sum(), True)

    def _resampled(self, belief: Particles, rng: np.random.Generator) -> Particles:
        number = len(belief.codes)
        if belief.effective >= self.resample_below * number:
            return belief
        # systematic resampling: one uniform number, least variance
        points = (rng.random() + np.arange(number)) / number
        cumulative = np.cumsum(belief.weights)
        chosen = np.searchsorted(cumulative / cumulative[-1], points, side="right")
        return Particles(belief.codes[np.minimum(chosen, number - 1)], np.full(number, 1.0 / number))
