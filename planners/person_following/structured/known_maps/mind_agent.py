"""The agent that plans with persons' minds: an exact belief per episode, and PO-UCT with values of imagined ways.

percepts (x, c)  ->  belief over (scene, stations, z, g)  ->  search  ->  action
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from domains.core import ViewGeometry
from planners.agents import BeliefAgent, Situation
from planners.config import SearchConfig
from planners.perception import Codec
from planners.person_following.motion import NUM_MOTIONS
from planners.person_following.structured.known_maps.mind_beliefs import MindBelief, Truth
from planners.person_following.structured.known_maps.mind_walk import KEYS, MindParticles, MindTree
from planners.person_following.structured.known_maps.minds import MindModel
from planners.person_following.structured.known_maps.ways import Ways
from planners.search.random_bits import stream
from planners.search.tree import allocate, clear
from planners.search.tree_top import in_words
from planners.search.walk import best_tried, walks

SLACK = 0.01
"""How improbable it is, per step, that a person taken to know everything does not know of a moved goal yet."""


class MindSearch:
    """Plans in a belief over what the person has in mind.

    Args:
        ways: the ways that the person may go.
        config: budget and parameters.
        rng: seeds the search's own random stream.
    """

    def __init__(self, ways: Ways, config: SearchConfig, rng: np.random.Generator) -> None:
        self.ways, self.config = ways, config
        self.tree = allocate(config.simulations + 2, NUM_MOTIONS)
        self._bits = stream(rng)

    def plan(
        self, belief: MindParticles, allowed: np.ndarray | None = None, spent: float = 0.0
    ) -> tuple[int, dict[str, Any]]:
        """The best action among those `allowed`, bool [A], and what the search saw; `spent` as of `IALMSearch`."""
        mask = np.ones(NUM_MOTIONS, np.bool_) if allowed is None else np.asarray(allowed, np.bool_)
        clear(self.tree)
        config = self.config
        info = walks(
            MindTree(self.ways.packed),
            belief,
            self.tree,
            config.simulations,
            config.time_left(spent),
            config.mind_depth,
            self.ways.discount,
            config.mind_exploration,
            False,
            mask,
            self._bits,
        )
        info["distinct"] = len(belief.node)
        return best_tried(info, mask), info

    def describe(self, seen: int) -> str:
        """An observation of the tree in words (mind_walk): the robot's code, and where the person is."""
        code = "".join(str(value) for value in self.ways.codes[seen // KEYS])
        key = seen % KEYS - 1
        if key < 0:
            return f"code {code}: not in view"
        heading = key // 4 % 4
        offset = np.array([key // 16 // 128 - 64, key // 16 % 128 - 64])
        scenes = self.ways.model.scenes
        return f"code {code}: {in_words(int(offset @ scenes.side[heading]), int(offset @ scenes.ahead[heading]))}"


class MindAgent(BeliefAgent):
    """Keeps an exact belief over what the person has in mind, and searches in it."""

    algorithm = "PO-UCT, leaves by imagined trajectories"
    model = "hand-structured: known maps, goals"

    def __init__(
        self, model: MindModel, codec: Codec, influence: str, config: SearchConfig, geometry: ViewGeometry, seed: int
    ) -> None:
        super().__init__(geometry, seed)
        self.influence, self.config = influence, config
        slack = SLACK if influence == "egocentric" else None
        self.ways = Ways(model, codec, config.per_step, slack)

    def _told(self, situation: Situation) -> Sequence[Truth | None]:
        if self.influence != "perfect-information":
            return [None] * len(situation.active)
        return [((mind[0][0], mind[0][1]), (mind[1][0], mind[1][1])) for mind in situation.env.person_minds().tolist()]

    def _belief(self, rng: np.random.Generator) -> MindBelief:
        return MindBelief(self.ways, self.influence, rng)

    def _planner(self, rng: np.random.Generator) -> MindSearch:
        return MindSearch(self.ways, self.config, rng)
