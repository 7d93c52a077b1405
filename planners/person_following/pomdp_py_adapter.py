"""The influence-augmented local model as genuine pomdp-py classes.

    S   `LocalState`: a state vector of the IALM, and what its arrival brought (reward, outcome, sight)
    A   `RobotAction`
    O   `LocalObservation`: the person's pose if in view, whether the robot moved, how the episode stands
    T   `LocalTransitionModel` draws one compiled step of the IALM
    Z   `LocalObservationModel`, R `LocalRewardModel`: read off the arrived state

pomdp-py's own planners (POUCT here) run on these classes. Observations leave out the 8^8 codes on purpose: a
search tree branches on what matters for influence and reward, and the next belief takes in the whole code.
pomdp-py wants lists of actions in a fixed order, copies the history at every step, and cannot cope with an
observation it has never simulated; `POUCTAgent` therefore searches afresh from each belief.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import numpy as np
import pomdp_py

from nesy.errors import UserError
from planners.config import SearchConfig
from planners.person_following import kernels
from planners.person_following.ialm import IALM, SCALARS
from planners.search.random_bits import stream


class RobotAction(pomdp_py.Action):
    """One of the robot's actions."""

    def __init__(self, index: int, name: str) -> None:
        self.index, self.name = index, name

    def __hash__(self) -> int:
        return self.index

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RobotAction) and self.index == other.index

    def __repr__(self) -> str:
        return f"RobotAction({self.name})"


class LocalState(pomdp_py.State):
    """A state of the IALM.

    Attributes:
        vector: int16 [2N + 5].
        reward: received on arrival.
        outcome: 0 while the episode goes on; a state with another outcome is terminal.
        visible: whether the person is in view.
    """

    def __init__(self, vector: np.ndarray, reward: float = 0.0, outcome: int = 0, visible: bool = False) -> None:
        self.vector, self.reward, self.outcome, self.visible = vector, reward, outcome, visible

    def __hash__(self) -> int:
        return hash(self.vector.tobytes())

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, LocalState)
            and self.outcome == other.outcome
            and bool(np.array_equal(self.vector, other.vector))
        )

    def __repr__(self) -> str:
        return f"LocalState({self.vector.tolist()}, outcome={self.outcome})"


class LocalObservation(pomdp_py.Observation):
    """What the tree branches on: (pose or (-1, -1, -1), outcome)."""

    def __init__(self, pose: tuple[int, int, int], outcome: int) -> None:
        self.pose, self.outcome = pose, outcome
        self._hash = hash((pose, outcome))

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, LocalObservation) and self.pose == other.pose and self.outcome == other.outcome

    def __repr__(self) -> str:
        return f"LocalObservation({self.pose}, outcome={self.outcome})"


class LocalTransitionModel(pomdp_py.TransitionModel):
    """T: one compiled step of the IALM; terminal states stay as they are, without reward."""

    def __init__(self, model: IALM, compiled: kernels.Model, rng: np.random.Generator) -> None:
        self.model, self.compiled = model, compiled
        self._bits = stream(rng)
        self._variables = np.zeros(3 * model.num_factors + len(SCALARS), np.int16)

    def sample(self, state: LocalState, action: RobotAction) -> LocalState:
        """Draw the next state."""
        if state.outcome:
            return LocalState(state.vector, 0.0, state.outcome, state.visible)
        after = np.empty(self.model.state_size, np.int16)
        reward, outcome, visible = kernels.step(
            self.compiled, state.vector, action.index, after, self._variables, self._bits
        )
        return LocalState(after, reward, outcome, bool(visible))


class LocalObservationModel(pomdp_py.ObservationModel):
    """Z: the person's pose if in view, and the outcome; a function of the state."""

    def __init__(self, num_factors: int) -> None:
        self._at = 2 * num_factors

    def sample(self, next_state: LocalState, action: RobotAction) -> LocalObservation:
        """The observation on arrival in `next_state`."""
        if not next_state.visible:
            return LocalObservation((-1, -1, -1), next_state.outcome)
        pose = next_state.vector[self._at : self._at + 3]
        return LocalObservation((int(pose[0]), int(pose[1]), int(pose[2])), next_state.outcome)

    def probability(self, observation: LocalObservation, next_state: LocalState, action: RobotAction) -> float:
        """1 for the observation that belongs to the state, else 0."""
        return float(self.sample(next_state, action) == observation)


class LocalRewardModel(pomdp_py.RewardModel):
    """R: the reward noted in the arrived state."""

    def sample(self, state: LocalState, action: RobotAction, next_state: LocalState) -> float:
        """The reward of the step."""
        return next_state.reward


class LocalPolicyModel(pomdp_py.RolloutPolicy):
    """All actions, in a fixed order; at the root (an empty history) those that `allowed`, bool [A], leaves."""

    def __init__(self, action_names: Sequence[str], allowed: np.ndarray | None = None) -> None:
        self.actions = [RobotAction(i, name) for i, name in enumerate(action_names)]
        self.first = [action for action in self.actions if allowed is None or allowed[action.index]]

    def get_all_actions(self, state: Any = None, history: Any = None) -> list[RobotAction]:
        """The list of actions."""
        return self.actions if history else self.first

    def sample(self, state: Any, history: Any = None) -> RobotAction:
        """A uniformly random action."""
        return random.choice(self.actions)

    def rollout(self, state: Any, history: Any = None) -> RobotAction:
        """A uniformly random action; only used by planners that insist on random rollouts."""
        return random.choice(self.actions)


class ParticleDistribution(pomdp_py.GenerativeDistribution):
    """A belief as equally weighted state vectors, int16 [P, 2N + 5]."""

    def __init__(self, states: np.ndarray, rng: np.random.Generator) -> None:
        self.states, self.rng = states, rng

    def random(self) -> LocalState:
        """Draw a state."""
        return LocalState(self.states[self.rng.integers(len(self.states))])

    def mpe(self) -> LocalState:
        """The most frequent state."""
        vectors, counts = np.unique(self.states, axis=0, return_counts=True)
        return LocalState(vectors[counts.argmax()])

    def __getitem__(self, state: LocalState) -> float:
        return float((self.states == state.vector).all(axis=1).mean())


class RobotAgent(pomdp_py.Agent):
    """The robot: a belief and the models T, Z, R over the IALM."""

    def __init__(
        self,
        model: IALM,
        compiled: kernels.Model,
        belief: np.ndarray,
        rng: np.random.Generator,
        allowed: np.ndarray | None = None,
    ) -> None:
        super().__init__(
            ParticleDistribution(belief, rng),
            LocalPolicyModel(model.dbn.action_names, allowed),
            LocalTransitionModel(model, compiled, rng),
            LocalObservationModel(model.num_factors),
            LocalRewardModel(),
        )


class LocalEnvironment(pomdp_py.Environment):
    """The IALM as an environment of its own, to try planners on without the task."""

    def __init__(self, model: IALM, compiled: kernels.Model, state: LocalState, rng: np.random.Generator) -> None:
        super().__init__(state, LocalTransitionModel(model, compiled, rng), LocalRewardModel())


class LeafValuePOUCT(pomdp_py.POUCT):
    """pomdp-py's POUCT with leaf values read off the model instead of rollouts."""

    def __init__(self, model: IALM, config: SearchConfig, spent: float = 0.0) -> None:
        limited = config.time_limit > 0  # pomdp-py counts either simulations or seconds
        super().__init__(
            max_depth=config.depth,
            num_sims=-1 if limited else config.pomdp_py_simulations,
            planning_time=config.time_left(spent) if limited else -1.0,
            discount_factor=config.per_step,
            exploration_const=config.exploration,
            rollout_policy=LocalPolicyModel(model.dbn.action_names),
        )
        self._leaf_values, self._at = model.leaf_values, 2 * model.num_factors

    def _rollout(self, state: LocalState, history: Any, root: Any, depth: int) -> float:
        """What the leaf is worth."""
        if state.outcome:
            return 0.0
        side, ahead, heading, _, lost = state.vector[self._at :].tolist()
        values = self._leaf_values[side, ahead, heading]
        return float(values[min(lost, len(values) - 1)])


class POUCTAgent:
    """Decides with pomdp-py's POUCT from a particle belief."""

    def __init__(self, model: IALM, compiled: kernels.Model, config: SearchConfig, rng: np.random.Generator) -> None:
        self.model, self.compiled, self.config, self.rng = model, compiled, config, rng
        self.root: Any = None
        """Root of the last search's tree, for pictures."""

    def plan(
        self, belief: np.ndarray, allowed: np.ndarray | None = None, spent: float = 0.0
    ) -> tuple[int, dict[str, Any]]:
        """Choose an action.

        Args:
            belief: int16 [P, 2N + 5], equally weighted particles.
            allowed: bool [A], actions that a shield leaves; all by default. The others are not tried at the root.
            spent: seconds that the decision has taken already.

        Returns:
            The action, and what the search saw: values and visits per action, simulations.
        """
        if allowed is not None and not np.any(allowed):
            raise UserError("a search needs at least one allowed action")
        agent = RobotAgent(self.model, self.compiled, belief, self.rng, allowed)
        planner = LeafValuePOUCT(self.model, self.config, spent)
        action = planner.plan(agent)
        self.root = agent.tree
        children = agent.tree.children
        found = {a.index: node for a, node in children.items()}
        names = range(len(self.model.dbn.action_names))
        return action.index, {
            "values": [float(found[a].value) if a in found else 0.0 for a in names],
            "visits": [int(found[a].num_visits) if a in found else 0 for a in names],
            "simulations": int(planner.last_num_sims),
        }
