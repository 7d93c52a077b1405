"""From observation to what every agent here decides on: code, belief b, and b~ as the influence mode has it.

view -> (codec) code x and belief b -> (influence mode) belief b~ over the person's code
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from nesy.perspective.operator import BeliefCodec, InfluenceBelief


class Codec(BeliefCodec, Protocol):
    """What turns views into codes and beliefs, and Φ needs: `nesy.world_model.SymbolicCodec`."""

    def codes(self, views: np.ndarray) -> np.ndarray:
        """uint8 [B, V, V] -> uint8 [B, N]."""
        ...


class Percepts(NamedTuple):
    """What is known at one moment in B environments.

    Attributes:
        codes: uint8 [B, N], the robot's codes.
        beliefs: float32 [B, N, K], b.
        shifted: float32 [B, N, K], b~.
        configurations: int64 [B], 0 where the person is out of view.
    """

    codes: np.ndarray
    beliefs: np.ndarray
    shifted: np.ndarray
    configurations: np.ndarray


class Perception:
    """Turns observations into percepts under one influence mode."""

    def __init__(self, codec: Codec, influence: str, rng: np.random.Generator) -> None:
        self.codec, self.influence = codec, influence
        self._shift = InfluenceBelief(influence, codec, rng)

    def __call__(self, observation: dict[str, np.ndarray], person_views: np.ndarray) -> Percepts:
        """Percepts of observations `view` [B, V, V] and `configuration` [B].

        `person_views` uint8 [B, V, V] is used by the mode `perfect-information` alone.
        """
        views, configurations = observation["view"], np.asarray(observation["configuration"], np.int64)
        beliefs = self.codec.beliefs(views)
        shifted = self._shift(beliefs, configurations, person_views if self.needs_person_views else None)
        return Percepts(self.codec.codes(views), beliefs, np.asarray(shifted, np.float32), configurations)

    @property
    def needs_person_views(self) -> bool:
        """Whether the mode looks into the person's head."""
        return self.influence == "perfect-information"
