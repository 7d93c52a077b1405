"""The perception of the belief DQN, and where the published code differs from the paper's text, switch by switch.

view, configuration -> (x, b, b~, configuration), as `planners.perception` makes them, and then:

    fallback             what b~ is where the person is out of view (`DQNConfig.fallback`)
    published_sampling   b~, where there is one, becomes a relaxed sample of itself (Gumbel softmax)
    published_occlusion  the person of `perfect-information` does not look through walls, whatever the task says

The published code: arXiv 2503.20425, github.com/alcedok/SocialNav_paper (read, and run). There b is sampled as well;
here b is certain of its code, of which every sample is the same.
"""

from __future__ import annotations

import numpy as np

from domains.core import UNSEEN, WALL
from nesy.perspective.operator import InfluenceBelief
from planners.config import DQNConfig
from planners.perception import Codec, Perception, Percepts

TEMPERATURE = 0.6


def dqn_perception(codec: Codec, influence: str, rng: np.random.Generator, config: DQNConfig) -> Perception:
    """The perception that the settings of a DQN ask for."""
    if config.fallback == "uniform" and not (config.published_sampling or config.published_occlusion):
        return Perception(codec, influence, rng)
    return DQNPerception(codec, influence, rng, config)


class DQNPerception(Perception):
    """Perception with the switches of `DQNConfig`."""

    def __init__(self, codec: Codec, influence: str, rng: np.random.Generator, config: DQNConfig) -> None:
        super().__init__(codec, influence, rng)
        if config.fallback != "uniform":
            self._shift = InfluenceBelief(influence, codec, rng, even_unseen=True)
        self.config, self.rng = config, rng

    def __call__(self, observation: dict[str, np.ndarray], person_views: np.ndarray) -> Percepts:
        """Percepts of observations `view` [B, V, V] and `configuration` [B]."""
        if self.config.published_occlusion:
            person_views = occluded(person_views)
        percepts = super().__call__(observation, person_views)
        nothing = (percepts.shifted == np.float32(1.0 / percepts.shifted.shape[-1])).all(axis=(1, 2), keepdims=True)
        shifted = percepts.shifted
        if self.config.published_sampling:
            shifted = np.where(nothing, shifted, relaxed_samples(shifted, TEMPERATURE, self.rng))
        if self.config.fallback == "published" and self.influence == "perspective-shift":
            shifted = np.where(nothing, np.float32(0.0), shifted)
        return percepts._replace(shifted=shifted)


def relaxed_samples(beliefs: np.ndarray, temperature: float, rng: np.random.Generator) -> np.ndarray:
    """Gumbel-softmax samples of categorical distributions [B, N, K]: float32 [B, N, K], rows sum to 1."""
    with np.errstate(divide="ignore"):
        scores = (np.log(beliefs) + rng.gumbel(size=beliefs.shape)) / temperature
    weights = np.exp(scores - scores.max(axis=-1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True), np.float32)


def occluded(views: np.ndarray) -> np.ndarray:
    """Views [B, V, V] as they look to who cannot look through walls: Minigrid's visibility rule, `process_vis`."""
    width = views.shape[1]
    lit = np.zeros(views.shape, np.bool_)
    lit[:, width // 2, width - 1] = True
    clear = views != WALL
    for vy in range(width - 1, -1, -1):
        for columns, sideways in ((range(width - 1), 1), (range(width - 1, 0, -1), -1)):
            for vx in columns:
                through = lit[:, vx, vy] & clear[:, vx, vy]
                lit[:, vx + sideways, vy] |= through
                if vy > 0:
                    lit[:, vx + sideways, vy - 1] |= through
                    lit[:, vx, vy - 1] |= through
    return np.where(lit, views, UNSEEN).astype(np.uint8)
