"""Reference agents: they say what a comparison's numbers mean.

`optimum` and `greedy-follower` look at the full state through the domain's oracles; `greedy-last-seen` has what
the learning agents have, the view and the configuration, and one memory: where it last saw the person.
"""

from __future__ import annotations

import numpy as np

from domains.core import Domain, ObservationPolicy, OraclePolicy
from planners.agents import Situation, Unbelieving


class RandomAgent(Unbelieving):
    """Acts uniformly at random, with a random stream per episode."""

    algorithm = "uniformly random"
    model = "none"

    def __init__(self, num_actions: int, seed: int) -> None:
        self.num_actions, self.seed = num_actions, seed
        self.streams: list[np.random.Generator] = []

    def actions(self, situation: Situation) -> np.ndarray:
        """Random actions."""
        count = len(situation.active)
        if situation.last_actions is None:
            self.streams = [np.random.default_rng([self.seed, i]) for i in range(count)]
        return np.array([stream.integers(self.num_actions) for stream in self.streams], np.int64)


class OracleFollower(Unbelieving):
    """First action of the shortest path to the person's pose on the full map; stays when there."""

    algorithm = "shortest path to the person"
    model = "the world, full state"

    def actions(self, situation: Situation) -> np.ndarray:
        """The expert's actions."""
        return np.asarray(situation.env.expert_actions("follower"), np.int64)


class OptimalAgent(Unbelieving):
    """An exact optimum: with the full state, or for a belief from observations."""

    algorithm = "dynamic programming"

    def __init__(self, policy: OraclePolicy, model: str) -> None:
        self.policy, self.model = policy, model

    def actions(self, situation: Situation) -> np.ndarray:
        """The oracle's actions."""
        return np.asarray(self.policy.actions(situation.env), np.int64)


class LastSeenFollower(Unbelieving):
    """Walks to where it last saw the person, by what it sees: the domain's follower, as an agent."""

    algorithm = "shortest path to the last seen pose"
    model = "none"

    def __init__(self, domain: Domain, variant: str) -> None:
        domain.last_seen_follower(1, variant)  # where there is none, it says so before anything is played
        self.domain, self.variant = domain, variant
        self.follower: ObservationPolicy | None = None

    def actions(self, situation: Situation) -> np.ndarray:
        """Actions by the last seen configuration."""
        if self.follower is None or situation.last_actions is None:
            self.follower = self.domain.last_seen_follower(len(situation.active), self.variant)
        return self.follower.actions(situation.observation, acted=situation.last_actions)
