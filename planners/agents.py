"""What an agent is to the comparison: something that sees a batch of situations and acts in each.

percepts (x, b, b~, configuration), the last actions  ->  actions [B]
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from domains.core import BatchedEnvironment, ViewGeometry
from planners.perception import Percepts

if TYPE_CHECKING:
    from planners.dqn.dqn import DQNPolicy  # imports torch


class Situation(NamedTuple):
    """One moment in B environments.

    Attributes:
        env: the environments; only oracles look into them.
        observation: `view` [B, V, V] and `configuration` [B].
        percepts: what perception makes of it; None for agents that do without.
        active: bool [B], where the episode still goes on; actions elsewhere are ignored.
        last_actions: int64 [B], what was done before; None at the start of the episodes.
        allowed: bool [B, A], what the rules allow, at least one action each; None without rules.
        begun: `time.perf_counter()` when the decision began; None where nobody asks how long it takes.
    """

    env: BatchedEnvironment
    observation: dict[str, np.ndarray]
    percepts: Percepts | None
    active: np.ndarray
    last_actions: np.ndarray | None
    allowed: np.ndarray | None = None
    begun: float | None = None


class Agent(Protocol):
    """Acts in a batch of episodes, from their starts to their ends."""

    @property
    def algorithm(self) -> str:
        """What decides, in the field's words."""
        ...

    @property
    def model(self) -> str:
        """What it plans with."""
        ...

    def actions(self, situation: Situation) -> np.ndarray:
        """Actions int64 [B]."""
        ...

    def person_belief(self) -> np.ndarray | None:
        """What the agent took the person to see when it last acted.

        Returns:
            Float [B, N, K], per factor of the person's code a distribution, or NaN where the agent did not act; None
            for agents that keep no such belief.
        """
        ...


class Unbelieving:
    """An agent that keeps no belief of what the person sees."""

    def person_belief(self) -> None:
        """None."""
        return None


def says_something(believed: np.ndarray) -> np.ndarray:
    """Which beliefs [B, N, K] are not the same for all values of all factors: bool [B]; NaN and zeros say nothing."""
    return np.asarray((believed.max(axis=-1) > believed.sum(axis=-1) / believed.shape[-1] + 1e-6).any(axis=-1))


class DQNAgent:
    """Acts greedily on a trained belief DQN."""

    model = "none"

    def __init__(self, policy: DQNPolicy) -> None:
        self.policy = policy
        self._given: np.ndarray | None = None

    @property
    def algorithm(self) -> str:
        """The DQN's extensions by name."""
        config = self.policy.config
        used = (("double", config.double), ("dueling", config.dueling), (f"{config.n_step}-step", config.n_step > 1))
        return " ".join([*(name for name, on in used if on), "DQN"])

    def actions(self, situation: Situation) -> np.ndarray:
        """Greedy actions."""
        assert situation.percepts is not None
        self._given = np.where(situation.active[:, None, None], situation.percepts.shifted, np.nan)
        return self.policy.actions(situation.percepts, situation.allowed)

    def person_belief(self) -> np.ndarray | None:
        """The b~ that the network was given."""
        return self._given


class Planner(Protocol):
    """Chooses an action for a belief, int16 [P, 2N + 5]."""

    def plan(
        self, belief: np.ndarray, allowed: np.ndarray | None = None, spent: float = 0.0
    ) -> tuple[int, dict[str, object]]:
        """The action among those `allowed`, bool [A] (all by default), and what the search saw.

        `spent`: seconds that the decision has taken already, which a limit of time counts.
        """
        ...


class BeliefAgent:
    """Keeps a belief per episode and plans in it; what both are, and what a belief is told, its kinds say.

    Every episode has random streams of its own, so results do not depend on which episodes run side by side.
    """

    algorithm: str
    model: str
    acts_on_code = True
    """Whether it takes in the robot's code, or what it sees."""

    def __init__(self, geometry: ViewGeometry, seed: int) -> None:
        self.geometry, self.seed = geometry, seed
        self.beliefs: list[Any] = []
        self.planners: list[Any] = []
        self.infos: list[dict[str, Any]] = []
        self._acted = np.zeros(0, np.bool_)

    def actions(self, situation: Situation) -> np.ndarray:
        """Update the beliefs of the active episodes and plan in each."""
        percepts = situation.percepts
        assert percepts is not None
        begun = time.perf_counter() if situation.begun is None else situation.begun
        count = len(situation.active)
        if situation.last_actions is None:
            self._begin(count)
        actions = np.zeros(count, np.int64)
        self.infos, self._acted = [{} for _ in range(count)], situation.active.copy()
        poses = self.geometry.relative(percepts.configurations)
        seen, told = self._seen(situation), self._told(situation)
        shared = (time.perf_counter() - begun) / max(int(situation.active.sum()), 1)
        for i in np.flatnonzero(situation.active).tolist():
            pose = poses[i] if percepts.configurations[i] > 0 else None
            belief = self.beliefs[i]
            begun = time.perf_counter()
            if situation.last_actions is None:
                belief.reset(seen[i], pose, told[i])
            else:
                belief.update(int(situation.last_actions[i]), seen[i], pose, told[i])
            allowed = None if situation.allowed is None else situation.allowed[i]
            spent = shared + time.perf_counter() - begun
            actions[i], info = self.planners[i].plan(belief.states, allowed, spent)
            expected = {
                "influence": belief.influence().tolist(),
                "effective": belief.effective,
                "resets": belief.resets,
            }
            self.infos[i] = info | expected
        return actions

    def person_belief(self) -> np.ndarray | None:
        """The marginals of the beliefs that it planned in."""
        if not self._acted.any():
            return None
        marginals = {i: self.beliefs[i].person_marginals() for i in np.flatnonzero(self._acted).tolist()}
        unknown = np.full_like(next(iter(marginals.values())), np.nan)
        return np.stack([marginals.get(i, unknown) for i in range(len(self._acted))])

    def _begin(self, count: int) -> None:
        self.beliefs, self.planners = [], []
        for i in range(count):
            filtering, planning = (
                np.random.default_rng(child) for child in np.random.SeedSequence([self.seed, i]).spawn(2)
            )
            self.beliefs.append(self._belief(filtering))
            self.planners.append(self._planner(planning))

    def _seen(self, situation: Situation) -> np.ndarray:
        """What the belief of each episode takes in of what its robot sees: codes [B, N] here."""
        assert situation.percepts is not None
        return situation.percepts.codes

    def _told(self, situation: Situation) -> Sequence[Any] | np.ndarray:
        """What the belief of each episode is told besides."""
        raise NotImplementedError

    def _belief(self, rng: np.random.Generator) -> Any:
        raise NotImplementedError

    def _planner(self, rng: np.random.Generator) -> Any:
        raise NotImplementedError
