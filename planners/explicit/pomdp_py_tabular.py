"""Explicit POMDPs and pomdp-py, both ways.

    TabularAgent, TabularEnvironment    pomdp-py's own planners on a `TabularPOMDP`
    tabular(...)                        any pomdp-py problem whose models have probabilities, as a `TabularPOMDP`

States, actions and observations of our models are pomdp-py's simple ones, named as the model names them. pomdp-py
wants actions as a list in a fixed order.
"""

from __future__ import annotations

import inspect
import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pomdp_py
from scipy import sparse

from nesy.errors import UserError
from planners.explicit.pomdp import TabularPOMDP
from planners.explicit.pomdp_py_rewards import expected_rewards
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
    actions: Sequence[Any] | None = None,
    reward_draws: int | None = None,
) -> TabularPOMDP:
    """A pomdp-py problem as tables, so that our planners and the solver run on it.

    States, actions and observations are told apart by equality, as pomdp-py does; those that print alike get numbers.
    The reward of a step is the expectation where the reward model has probabilities over few values, else what it
    always says.

    Args:
        agent: a `pomdp_py.Agent` whose transition and observation models have `probability`.
        discount: per step; pomdp-py gives it to planners, not to problems.
        states: all states; those of the transition model (`get_all_states`) by default.
        observations: all observations; those of the observation model by default.
        terminal: states that end an episode.
        actions: all actions, allowed in every state; by default those of the policy model, which must be the same in
            every state that is not terminal.
        reward_draws: how often a reward is drawn to average it, where the model draws and tells no probabilities.

    Raises:
        UserError: states, actions or observations cannot be listed, are listed twice or depend on the state, the
            probabilities do not sum to 1, or rewards are drawn and `reward_draws` is not given.
    """
    if reward_draws is not None and reward_draws < 1:
        raise UserError(f"reward_draws must be at least 1, got {reward_draws}")
    try:
        states = list(agent.transition_model.get_all_states() if states is None else states)
        observations = list(agent.observation_model.get_all_observations() if observations is None else observations)
    except (NotImplementedError, AttributeError):
        raise UserError("the pomdp-py problem does not list its states or observations: give them") from None
    places, seen_at = _places(states, "state"), _places(observations, "observation")
    ends = np.zeros(len(states), np.bool_)
    for state in terminal:
        if state not in places:
            raise UserError(f"the terminal state {state} is not among the states")
        ends[places[state]] = True
    going_on = [states[s] for s in np.flatnonzero(~ends)] or states
    actions = list(actions) if actions is not None else _actions(agent, going_on)
    _places(actions, "action")
    transition, observation = [], np.zeros((len(actions), len(states), len(observations)))
    for a, action in enumerate(actions):
        matrix = np.array([[_chance(agent.transition_model, t, s, action) for t in states] for s in states])
        matrix[ends] = np.eye(len(states))[ends]
        transition.append(sparse.csr_array(matrix))
        for j, state in enumerate(states):
            for seen, o in seen_at.items():
                observation[a, j, o] = _chance(agent.observation_model, seen, state, action)
    return TabularPOMDP(
        states=_names(states),
        actions=_names(actions),
        observations=_names(observations),
        transition=transition,
        observation=observation,
        reward=expected_rewards(agent.reward_model, states, actions, transition, ends, reward_draws),
        discount=discount,
        start=_start(agent.belief, places),
        terminal=ends,
    )


def _places(things: Sequence[Any], kind: str) -> dict[Any, int]:
    """Where each thing stands; equal ones are one."""
    places: dict[Any, int] = {}
    for place, thing in enumerate(things):
        try:
            first = places.setdefault(thing, place)
        except (NotImplementedError, TypeError):
            raise UserError(f"{kind}s of class {type(thing).__name__} need __hash__ and __eq__") from None
        if first != place:
            raise UserError(f"the {kind} {thing} is listed twice")
    return places


def _names(things: Sequence[Any]) -> tuple[str, ...]:
    """How things print; those that print alike are numbered from 1."""
    texts = [str(thing) for thing in things]
    often, taken, names = Counter(texts), set(texts), []
    numbers = {text: itertools.count(1) for text in often}
    for text in texts:
        name = text
        while often[text] > 1 and name in taken:
            name = f"{text} ({next(numbers[text])})"
        taken.add(name)
        names.append(name)
    return tuple(names)


def _actions(agent: Any, states: Sequence[Any]) -> list[Any]:
    """The actions of the policy model, asked for in every state as pomdp-py's planners do."""
    get, given = agent.policy_model.get_all_actions, {"history": agent.history}
    parameters = inspect.signature(get).parameters.values()
    takes = {parameter.name for parameter in parameters}
    anything = any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters)
    first: tuple[Any, list[Any]] | None = None
    for state in states:
        asked = {k: v for k, v in {"state": state, **given}.items() if anything or k in takes}
        try:
            found = list(get(**asked))
        except (NotImplementedError, AttributeError, TypeError) as error:
            reason = f" ({error})" if str(error) else ""
            raise UserError(f"get_all_actions(state, history) does not list the actions: give them{reason}") from None
        if first is None:
            first = state, found
        elif _places(found, "action").keys() != _places(first[1], "action").keys():
            raise UserError(
                f"state {state} has other actions than state {first[0]}, and tables have one list for all states; "
                "give `actions`, which are then allowed everywhere"
            )
    if first is None or not first[1]:
        raise UserError("the policy model lists no actions: give them")
    return first[1]


def _start(belief: Any, places: dict[Any, int]) -> np.ndarray:
    """The agent's belief: float64 [S]."""
    try:
        believed = dict(belief.get_histogram())
    except (NotImplementedError, AttributeError):
        believed = {state: belief[state] for state in places}  # a distribution that cannot be gone through
    out = np.zeros(len(places))
    for state, chance in believed.items():
        if chance > 0 and state not in places:
            raise UserError(f"the belief holds {state}, which is not among the states")
        if chance > 0:
            out[places[state]] = float(chance)
    if not out.sum() > 0:
        raise UserError("the agent's belief holds no state")
    return np.asarray(out / out.sum())


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
