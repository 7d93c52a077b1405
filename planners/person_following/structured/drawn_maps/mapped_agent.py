"""The agent that plans on a map drawn on the way: an exact belief per episode, and PO-UCT with values of imagined ways.

views, c  ->  map, belief over the person's pose  ->  ways it may go  ->  search  ->  action
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from domains.core import ViewGeometry
from planners.agents import BeliefAgent, Situation
from planners.config import SearchConfig
from planners.perception import Codec
from planners.person_following.motion import NUM_MOTIONS
from planners.person_following.structured.drawn_maps.mapped_belief import MappedBelief
from planners.person_following.structured.drawn_maps.mapped_model import MappedModel
from planners.person_following.structured.drawn_maps.mapped_walk import MappedParticles, MappedTree
from planners.person_following.structured.drawn_maps.mapped_ways import layers_of, tables_of
from planners.search.random_bits import stream
from planners.search.tree import allocate, clear
from planners.search.tree_top import in_words
from planners.search.walk import best_tried, walks

HORIZON = 14
"""For how many steps persons' ways are imagined."""
DEPTH = 1
"""Deepest step of the search, whose leaves are worth what is imagined from there: deeper ones lose (docs/notes)."""


class MappedSearch:
    """Plans in a belief over where the person is.

    Args:
        model: learned tables.
        config: budget and parameters.
        rng: seeds the search's own random stream.
    """

    def __init__(self, model: MappedModel, config: SearchConfig, rng: np.random.Generator) -> None:
        self.model, self.config = model, config
        self.tables = tables_of(model)
        self.tree = allocate(config.simulations + 2, NUM_MOTIONS)
        self._bits = stream(rng)

    def plan(
        self, belief: MappedBelief, allowed: np.ndarray | None = None, spent: float = 0.0
    ) -> tuple[int, dict[str, Any]]:
        """The best action among those `allowed`, bool [A], and what the search saw; `spent` as of `IALMSearch`."""
        begun = time.perf_counter()
        mask = np.ones(NUM_MOTIONS, np.bool_) if allowed is None else np.asarray(allowed, np.bool_)
        clear(self.tree)
        config = self.config
        people, lost = np.nonzero(belief.weights)
        places, node = np.unique(people, return_inverse=True)
        layers = layers_of(
            self.tables,
            belief.ground,
            belief.chances,
            places,
            belief.weights.sum(1)[places],
            belief.robot,
            HORIZON,
            config.per_step,
        )
        particles = MappedParticles(
            np.cumsum(belief.weights[people, lost]), node.reshape(-1).astype(np.int64), lost, belief.robot
        )
        info = walks(
            MappedTree(self.tables, belief.ground, layers),
            particles,
            self.tree,
            config.simulations,
            config.time_left(spent + time.perf_counter() - begun),
            DEPTH,
            config.per_step,
            config.mind_exploration,
            False,
            mask,
            self._bits,
        )
        info["distinct"] = len(places)
        return best_tried(info, mask), info

    def describe(self, seen: int) -> str:
        """An observation of the tree in words (mapped_walk): where the person is."""
        if seen < 0:
            return "not in view"
        robot, person = divmod(seen, len(self.tables.chart.usual) ** 2 * 4)
        side, ahead, _ = self.model.chart.relative(robot, person)
        return in_words(int(side), int(ahead))


class MappedAgent(BeliefAgent):
    """Draws a map, keeps an exact belief over where the person is on it, and searches in it."""

    acts_on_code = False
    algorithm = "one-step expectation by sampling, leaves by imagined trajectories"
    model = "hand-structured: drawn map"

    def __init__(
        self,
        model: MappedModel,
        codec: Codec,
        influence: str,
        config: SearchConfig,
        geometry: ViewGeometry,
        seed: int,
        possible: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        super().__init__(geometry, seed)
        self.drawn_map, self.codec, self.config = model, codec, config
        self.influence, self.possible = influence, possible
        self.tables = tables_of(model, influence == "perfect-information")

    def _seen(self, situation: Situation) -> np.ndarray:
        return situation.observation["view"]

    def _told(self, situation: Situation) -> Sequence[Any] | np.ndarray:
        if self.influence != "perfect-information":
            return [None] * len(situation.active)
        return situation.env.person_views()

    def _belief(self, rng: np.random.Generator) -> MappedBelief:
        return MappedBelief(self.drawn_map, self.tables, self.codec, self.influence, rng, self.possible)

    def _planner(self, rng: np.random.Generator) -> MappedSearch:
        return MappedSearch(self.drawn_map, self.config, rng)
