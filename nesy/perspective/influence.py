"""The influence prior: what the other agent is taken to see and to have in mind, and what it will therefore do.

    I(u | l) = sum over y of pi(u | y) b~(y)

y is the other agent's situation: what pi needs to know of it (a code, a goal that it heads for, what lies around it).
An influence mode says where b~ comes from. It means the same for every agent that has modes:

| mode | b~ |
| --- | --- |
| `perspective-shift` | the own belief seen from the other's place (Φ), kept over time where the agent remembers |
| `egocentric` | the own situation: the other is taken to see and know what the own agent sees and knows |
| `perfect-information` | the truth |
| `zero` | a base distribution that nothing observed changes: what such agents are in general |
| `random` | one situation drawn from the base of `zero`, anew at each decision, the same throughout the belief |

The hand-structured planners answer `perspective-shift` on maps of their own, without Φ. What the base is depends on y:
all codes alike (the DQN), codes as often as others had them (the local model's particles), all candidates alike
(goals), surroundings as often as they were met (maps drawn on the way).
"""

from __future__ import annotations

import numpy as np

from nesy.errors import UserError

INFLUENCE_MODES = ("zero", "random", "egocentric", "perspective-shift", "perfect-information")


class InfluencePrior:
    """What an influence mode puts in the place of what is believed of the other agent.

    Attributes:
        mode: one of `INFLUENCE_MODES`.
    """

    def __init__(self, mode: str, rng: np.random.Generator) -> None:
        """Prepare a mode.

        Args:
            mode: one of `INFLUENCE_MODES`.
            rng: used by `random` alone.

        Raises:
            UserError: an unknown mode.
        """
        if mode not in INFLUENCE_MODES:
            raise UserError(f"unknown influence mode '{mode}'; known: {', '.join(INFLUENCE_MODES)}")
        self.mode, self.rng = mode, rng
        self._number = 0.0

    @property
    def blind(self) -> bool:
        """Whether b~ is the base, or drawn from it, whatever is observed."""
        return self.mode in ("zero", "random")

    def renew(self) -> None:
        """Another decision: `random` draws anew."""
        if self.mode == "random":
            self._number = float(self.rng.random())

    def base(self, weights: np.ndarray) -> np.ndarray:
        """b~ under `zero` and `random`: float64 [n], from the weights [n] of the base distribution."""
        weights = np.asarray(weights, np.float64)
        if self.mode != "random":
            return np.asarray(weights / weights.sum())
        cumulative = np.cumsum(weights)
        drawn = int(np.searchsorted(cumulative, self._number * cumulative[-1], side="right"))
        out = np.zeros(len(weights))
        out[min(drawn, len(weights) - 1)] = 1.0
        return out

    def codes(self, shape: tuple[int, ...], num_values: int) -> np.ndarray:
        """b~ over codes whose factors are believed one by one, as `base` where all are alike: float32 [*shape, K]."""
        if self.mode != "random":
            return np.full((*shape, num_values), 1.0 / num_values, np.float32)
        return np.eye(num_values, dtype=np.float32)[self.rng.integers(0, num_values, shape)]


def influence(policy: np.ndarray, believed: np.ndarray) -> np.ndarray:
    """I(u | l): float64 [U], of pi(u | y) [n, U] and b~(y) [n], any positive weights."""
    believed = np.asarray(believed, np.float64)
    return np.asarray(believed @ policy / believed.sum())
