"""The agent that plans with persons' minds: an exact belief per episode, and PO-UCT with values of imagined ways.

percepts (x, c)  ->  belief over (scene, stations, z, g)  ->  search  ->  action
"""

from __future__ import annotations

from typing import Any

import numpy as np

from domains.core import ViewGeometry
from planners.agents import Situation
from planners.config import SearchConfig
from planners.mind_beliefs import MindBelief, Truth
from planners.mind_walk import KEYS, MindParticles, MindTree
from planners.minds import MindModel
from planners.perception import Codec
from planners.random_bits import stream
from planners.tree import allocate, clear
from planners.tree_top import in_words
from planners.walk import best_tried, walks
from planners.ways import Ways

NUM_ACTIONS = 4
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
        self.tree = allocate(config.simulations + 2, NUM_ACTIONS)
        self._bits = stream(rng)

    def plan(self, belief: MindParticles, allowed: np.ndarray | None = None) -> tuple[int, dict[str, Any]]:
        """The best action among those `allowed`, bool [A], and what the search saw."""
        mask = np.ones(NUM_ACTIONS, np.bool_) if allowed is None else np.asarray(allowed, np.bool_)
        clear(self.tree)
        config = self.config
        info = walks(
            MindTree(self.ways.packed),
            belief,
            self.tree,
            config.simulations,
            config.time_limit,
            config.mind_depth,
            config.mind_discount,
            config.mind_exploration,
            False,
            mask,
            self._bits,
        )
        info["distinct"] = len(belief.node)
        return best_tried(info, mask), info

    def describe(self, seen: int) -> str:
        """An observation of the tree in words (planners.mind_walk): the robot's code, and where the person is."""
        code = "".join(str(value) for value in self.ways.codes[seen // KEYS])
        key = seen % KEYS - 1
        if key < 0:
            return f"code {code}: not in view"
        heading = key // 4 % 4
        offset = np.array([key // 16 // 128 - 64, key // 16 % 128 - 64])
        scenes = self.ways.model.scenes
        return f"code {code}: {in_words(int(offset @ scenes.side[heading]), int(offset @ scenes.ahead[heading]))}"


class MindAgent:
    """Plays episodes side by side, each with a belief and random streams of its own."""

    def __init__(
        self, model: MindModel, codec: Codec, influence: str, config: SearchConfig, geometry: ViewGeometry, seed: int
    ) -> None:
        self.influence, self.config, self.geometry, self.seed = influence, config, geometry, seed
        slack = SLACK if influence == "egocentric" else None
        self.ways = Ways(model, codec, config.mind_discount, slack)
        self.beliefs: list[MindBelief] = []
        self.planners: list[MindSearch] = []
        self.infos: list[dict[str, Any]] = []

    def actions(self, situation: Situation) -> np.ndarray:
        """Update the beliefs of the active episodes and plan in each."""
        percepts = situation.percepts
        assert percepts is not None
        count = len(situation.active)
        if situation.last_actions is None:
            self._begin(count)
        actions = np.zeros(count, np.int64)
        self.infos = [{} for _ in range(count)]
        poses = self.geometry.relative(percepts.configurations)
        minds = situation.env.person_minds() if self.influence == "perfect-information" else None
        for i in np.flatnonzero(situation.active):
            pose = poses[i] if percepts.configurations[i] > 0 else None
            truth: Truth | None = None
            if minds is not None:
                truth = tuple(tuple(int(v) for v in place) for place in minds[i])  # type: ignore[assignment]
            belief = self.beliefs[i]
            if situation.last_actions is None:
                belief.reset(percepts.codes[i], pose, truth)
            else:
                belief.update(int(situation.last_actions[i]), percepts.codes[i], pose, truth)
            allowed = None if situation.allowed is None else situation.allowed[i]
            actions[i], info = self.planners[i].plan(belief.particles(), allowed)
            self.infos[i] = info | {"effective": float(len(belief.weights)), "resets": belief.resets}
        return actions

    def _begin(self, count: int) -> None:
        self.beliefs, self.planners = [], []
        for i in range(count):
            filtering, planning = (
                np.random.default_rng(child) for child in np.random.SeedSequence([self.seed, i]).spawn(2)
            )
            self.beliefs.append(MindBelief(self.ways, self.influence, filtering))
            self.planners.append(MindSearch(self.ways, self.config, planning))
