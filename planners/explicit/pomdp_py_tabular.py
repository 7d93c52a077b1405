"""Explicit POMDPs and pomdp-py, both ways.

    TabularAgent, TabularEnvironment    pomdp-py's own planners on a `TabularPOMDP`
    tabular(...)                        any pomdp-py problem whose models have probabilities, as a `TabularPOMDP`

States, actions and observations of our models are pomdp-py's simple ones, named as the model names them. pomdp-py
wants actions as a list in a fixed order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pomdp_py
from scipy import sparse

from nesy.errors import UserError
from planners.explicit.pomdp import TabularPOMDP
from planners.search.random_bits import stream, uniform


class TabularTransition(pomdp_py.TransitionModel):
    """T of an explicit model."""

    def __init__(self, model: TabularPOMDP, bits: np.ndarray) -> None:
        self.model, self.bits = model, bits
        self.number = {name: s for s, name in enumerate(model.states)}
        self.action = {name: a for a, name in enumerate(model.actions)}
        self.states = [pomdp_py.SimpleState(name) for name in model.states]
        self.rows = [[_row(matrix, s) for s in range(len(model.states))] for matrix in model.transition]

    def probability(self, next_state: Any, state: Any, action: Any) -> float:
        """T(s' | s, a)."""
        matrix = self.model.transition[self.action[action.name]]
        return float(matrix[self.number[state.data], self.number[next_state.data]])

    def sample(self, state: Any, action: Any) -> Any:
        """Draw the next state."""
        successors, cumulative = self.rows[self.action[action.name]][self.number[state.data]]
        return self.states[successors[int(np.searchsorted(cumulative, uniform(self.bits), side="right"))]]

    def get_all_states(self) -> list[Any]:
        """The states, in order."""
        return self.states


class TabularObservation(pomdp_py.ObservationModel):
    """Z of an explicit model."""

    def __init__(self, model: TabularPOMDP, bits: np.ndarray) -> None:
        self.model, self.bits = model, bits
        self.number = {name: s for s, name in enumerate(model.states)}
        self.action = {name: a for a, name in enumerate(model.actions)}
        self.seen = {name: o for o, name in enumerate(model.observations)}
        self.observations = [pomdp_py.SimpleObservation(name) for name in model.observations]
        self.cumulative = np.cumsum(model.observation, axis=2)
        self.cumulative[..., -1] = 1.0

    def probability(self, observation: Any, next_state: Any, action: Any) -> float:
        """Z(o | s', a)."""
        table = self.model.observation[self.action[action.name]]
        return float(table[self.number[next_state.data], self.seen[observation.data]])

    def sample(self, next_state: Any, action: Any) -> Any:
        """Draw an observation."""
        row = self.cumulative[self.action[action.name], self.number[next_state.data]]
        return self.observations[int(np.searchsorted(row, uniform(self.bits), side="right"))]

    def get_all_observations(self) -> list[Any]:
        """The observations, in order."""
        return self.observations


class TabularReward(pomdp_py.RewardModel):
    """R(s, a) of an explicit model: expected, so drawing it is reading it."""

    def __init__(self, model: TabularPOMDP) -> None:
        self.reward = {
            (s, a): float(model.reward[i, j]) for i, a in enumerate(model.actions) for j, s in enumerate(model.states)
        }

    def sample(self, state: Any, action: Any, next_state: Any) -> float:
        """The reward of the step."""
        return self.reward[state.data, action.name]


class TabularPolicy(pomdp_py.RolloutPolicy):
    """All actions in their order; rollouts draw one uniformly."""

    def __init__(self, model: TabularPOMDP, bits: np.ndarray) -> None:
        self.actions = [pomdp_py.SimpleAction(name) for name in model.actions]
        self.bits = bits

    def get_all_actions(self, state: Any = None, history: Any = None) -> list[Any]:
        """The list of actions."""
        return self.actions

    def rollout(self, state: Any, history: Any = None) -> Any:
        """A uniformly random action."""
        return self.actions[int(uniform(self.bits) * len(self.actions))]


class TabularAgent(pomdp_py.Agent):
    """An agent over an explicit model, its belief a pomdp-py histogram."""

    def __init__(self, model: TabularPOMDP, belief: np.ndarray, rng: np.random.Generator) -> None:
        bits = stream(rng)
        transition = TabularTransition(model, bits)
        histogram = {transition.states[s]: float(belief[s]) for s in np.flatnonzero(belief > 0)}
        super().__init__(
            pomdp_py.Histogram(histogram),
            TabularPolicy(model, bits),
            transition,
            TabularObservation(model, bits),
            TabularReward(model),
        )


class TabularEnvironment(pomdp_py.Environment):
    """An explicit model as an environment."""

    def __init__(self, model: TabularPOMDP, state: int, rng: np.random.Generator) -> None:
        transition = TabularTransition(model, stream(rng))
        super().__init__(transition.states[state], transition, TabularReward(model))


def tabular(
    agent: Any,
    discount: float,
    states: Sequence[Any] | None = None,
    observations: Sequence[Any] | None = None,
    terminal: Sequence[Any] = (),
) -> TabularPOMDP:
    """A pomdp-py problem as tables, so that our planners and the solver run on it.

    Args:
        agent: a `pomdp_py.Agent` whose transition and observation models have `probability`.
        discount: per step; pomdp-py gives it to planners, not to problems.
        states: all states; those of the transition model (`get_all_states`) by default.
        observations: all observations; those of the observation model by default.
        terminal: states that end an episode.

    Raises:
        UserError: states or observations cannot be listed, or the probabilities do not sum to 1.
    """
    try:
        states = list(agent.transition_model.get_all_states() if states is None else states)
        observations = list(agent.observation_model.get_all_observations() if observations is None else observations)
        actions = list(agent.policy_model.get_all_actions())
    except (NotImplementedError, AttributeError):
        raise UserError("the pomdp-py problem does not list its states, actions or observations: give them") from None
    ends = np.array([state in list(terminal) for state in states], np.bool_)
    transition, observation = [], np.zeros((len(actions), len(states), len(observations)))
    reward = np.zeros((len(actions), len(states)))
    for a, action in enumerate(actions):
        matrix = np.array([[_chance(agent.transition_model, t, s, action) for t in states] for s in states])
        matrix[ends] = np.eye(len(states))[ends]
        transition.append(sparse.csr_array(matrix))
        for j, state in enumerate(states):
            for o, seen in enumerate(observations):
                observation[a, j, o] = _chance(agent.observation_model, seen, state, action)
            if not ends[j]:
                reward[a, j] = sum(
                    matrix[j, t] * agent.reward_model.sample(state, action, states[t])
                    for t in np.flatnonzero(matrix[j])
                )
    belief = np.array([float(agent.belief[state]) for state in states])
    return TabularPOMDP(
        states=tuple(map(str, states)),
        actions=tuple(map(str, actions)),
        observations=tuple(map(str, observations)),
        transition=transition,
        observation=observation,
        reward=reward,
        discount=discount,
        start=belief / belief.sum(),
        terminal=ends,
    )


def _chance(model: Any, *arguments: Any) -> float:
    try:
        return float(model.probability(*arguments))
    except NotImplementedError:
        raise UserError(f"{type(model).__name__} has no probabilities, so it cannot be written as tables") from None


def _row(matrix: sparse.csr_array, state: int) -> tuple[np.ndarray, np.ndarray]:
    begin, end = matrix.indptr[state], matrix.indptr[state + 1]
    cumulative = np.cumsum(matrix.data[begin:end])
    cumulative[-1] = 1.0
    return matrix.indices[begin:end], cumulative
