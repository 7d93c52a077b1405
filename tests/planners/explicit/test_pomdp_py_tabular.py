"""pomdp-py problems as tables: what is told apart, which rewards, which actions."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pomdp_py
import pytest

from nesy.errors import UserError
from planners.explicit.pomdp_py_tabular import TabularAgent, tabular

GO, STAY, SEEN = pomdp_py.SimpleAction("go"), pomdp_py.SimpleAction("stay"), pomdp_py.SimpleObservation("seen")
A, B = pomdp_py.SimpleState("a"), pomdp_py.SimpleState("b")


class Room(pomdp_py.State):
    """A room that prints without its light."""

    def __init__(self, name: str, lit: bool) -> None:
        self.name, self.lit = name, lit

    def __hash__(self) -> int:
        return hash((self.name, self.lit))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Room) and (self.name, self.lit) == (other.name, other.lit)

    def __str__(self) -> str:
        return self.name


class Stays(pomdp_py.TransitionModel):
    """Nothing moves."""

    def __init__(self, states: list[Any]) -> None:
        self.states = states

    def probability(self, next_state: Any, state: Any, action: Any) -> float:
        return float(next_state == state)

    def get_all_states(self) -> list[Any]:
        return self.states


class Sees(pomdp_py.ObservationModel):
    """All observations are equally likely."""

    def __init__(self, observations: list[Any]) -> None:
        self.observations = observations

    def probability(self, observation: Any, next_state: Any, action: Any) -> float:
        return 1 / len(self.observations)

    def get_all_observations(self) -> list[Any]:
        return self.observations


class Earns(pomdp_py.RewardModel):
    """Rewards by a function of the state."""

    def __init__(self, of: Callable[[Any], float]) -> None:
        self.of = of

    def sample(self, state: Any, action: Any, next_state: Any) -> float:
        return self.of(state)


class Policy(pomdp_py.RolloutPolicy):
    """Has actions."""

    def __init__(self, *actions: Any) -> None:
        self.actions = list(actions)


class Acts(Policy):
    """The same actions everywhere."""

    def get_all_actions(self, state: Any = None, history: Any = None) -> list[Any]:
        return self.actions


def agent(
    states: list[Any],
    reward: pomdp_py.RewardModel,
    policy: pomdp_py.RolloutPolicy | None = None,
    observations: list[Any] | None = None,
    belief: Any = None,
) -> pomdp_py.Agent:
    """A problem in which nothing moves."""
    believed = pomdp_py.Histogram({states[0]: 1.0}) if belief is None else belief
    return pomdp_py.Agent(believed, policy or Acts(GO), Stays(states), Sees(observations or [SEEN]), reward)


def test_what_prints_alike_is_told_apart() -> None:
    rooms = [Room("hall", False), Room("hall (1)", True), Room("hall", True), Room("attic", False)]
    numbers = [pomdp_py.SimpleObservation("1"), pomdp_py.SimpleObservation(1)]
    problem = agent(rooms, Earns(lambda room: 10.0 * room.lit), observations=numbers)
    model = tabular(problem, 0.9, terminal=[rooms[3]])
    assert model.states == ("hall (2)", "hall (1)", "hall (3)", "attic")
    assert model.observations == ("1 (1)", "1 (2)")
    assert model.reward.tolist() == [[0, 10, 10, 0]]
    again = TabularAgent(model, model.start, np.random.default_rng(0))
    states = again.transition_model.get_all_states()
    assert [again.reward_model.sample(state, GO, None) for state in states] == [0, 10, 10, 0]
    assert len(set(states)) == 4


def test_equal_things_are_one() -> None:
    zero = Earns(lambda _: 0.0)
    with pytest.raises(UserError, match="the state a is listed twice"):
        tabular(agent([A, B, pomdp_py.SimpleState("a")], zero), 0.9)
    with pytest.raises(UserError, match="the action go is listed twice"):
        tabular(agent([A], zero, Acts(GO, pomdp_py.SimpleAction("go"))), 0.9)
    with pytest.raises(UserError, match="the observation seen is listed twice"):
        tabular(agent([A], zero, observations=[SEEN, SEEN]), 0.9)
    with pytest.raises(UserError, match="the terminal state b is not among the states"):
        tabular(agent([A], zero), 0.9, terminal=[B])


def test_states_without_equality_are_refused() -> None:
    class Bare(pomdp_py.State):
        pass

    problem = agent([A], Earns(lambda _: 0.0))
    with pytest.raises(UserError, match="states of class Bare need __hash__ and __eq__"):
        tabular(problem, 0.9, states=[Bare()])


@pytest.mark.parametrize(
    ("belief", "wanted"),
    [
        (pomdp_py.Histogram({A: 3.0, B: 1.0}), [0.75, 0.25]),
        (pomdp_py.Particles([B, A, B, B]), [0.25, 0.75]),
        (pomdp_py.WeightedParticles([(A, 0.5), (B, 0.5)]), [0.5, 0.5]),
    ],
)
def test_beliefs(belief: Any, wanted: list[float]) -> None:
    zero = Earns(lambda _: 0.0)
    assert tabular(agent([A, B], zero, belief=belief), 0.9).start.tolist() == wanted
    with pytest.raises(UserError, match="the belief holds b, which is not among the states"):
        tabular(agent([A], zero, belief=belief), 0.9)


class Lottery(pomdp_py.RewardModel):
    """Draws a prize from a generator of its own, or from a global one."""

    def __init__(self, prizes: dict[float, float], draw: Any) -> None:
        self.prizes, self.draw = prizes, draw

    def sample(self, state: Any, action: Any, next_state: Any) -> float:
        return float(self.draw(list(self.prizes), list(self.prizes.values())))


class OpenLottery(Lottery):
    """Tells its chances."""

    def probability(self, reward: float, state: Any, action: Any, next_state: Any) -> float:
        return self.prizes.get(reward, 0.0)


def _own(seed: int) -> Any:
    rng = np.random.default_rng(seed)
    return lambda values, chances: rng.choice(values, p=chances)


def _global(values: list[float], chances: list[float]) -> float:
    return random.choices(values, chances)[0]


@pytest.mark.parametrize("draw", [_own(0), _global], ids=["own generator", "global generator"])
@pytest.mark.parametrize("prizes", [{0.0: 0.5, 10.0: 0.5}, {0.0: 0.98, 100.0: 0.02}, {1.0: 0.2, 2.0: 0.3, 3.0: 0.5}])
def test_rewards_that_are_drawn(draw: Any, prizes: dict[float, float]) -> None:
    expected = sum(prize * chance for prize, chance in prizes.items())
    assert tabular(agent([A], OpenLottery(prizes, draw)), 0.9).reward[0, 0] == pytest.approx(expected, abs=1e-9)
    with pytest.raises(UserError, match=r"the reward of action go in state a is drawn.*give `reward_draws`"):
        tabular(agent([A], Lottery(prizes, draw)), 0.9)
    mean = tabular(agent([A], Lottery(prizes, draw)), 0.9, reward_draws=20_000).reward[0, 0]
    spread = np.sqrt(sum(chance * (prize - expected) ** 2 for prize, chance in prizes.items()) / 20_000)
    assert abs(mean - expected) < 5 * spread
    with pytest.raises(UserError, match="reward_draws must be at least 1"):
        tabular(agent([A], Lottery(prizes, draw)), 0.9, reward_draws=0)


def test_densities_are_no_probabilities() -> None:
    class Noisy(pomdp_py.RewardModel):
        def sample(self, state: Any, action: Any, next_state: Any) -> float:
            return random.gauss(5.0, 1.0)

        def probability(self, reward: float, state: Any, action: Any, next_state: Any) -> float:
            return float(np.exp(-((reward - 5) ** 2) / 2) / np.sqrt(2 * np.pi))

    with pytest.raises(UserError, match="is drawn"):
        tabular(agent([A], Noisy()), 0.9)


def test_rewards_that_are_missing() -> None:
    for reward in (pomdp_py.RewardModel(), Earns(lambda _: None)):  # type: ignore[arg-type, return-value]
        with pytest.raises(UserError, match="gives no reward for go in a"):
            tabular(agent([A], reward), 0.9)


class WantsState(Policy):
    def get_all_actions(self, state: Any, history: Any = None) -> list[Any]:
        return self.actions if state in (A, B) else []


class WantsBoth(Policy):
    def get_all_actions(self, *, state: Any, history: Any) -> list[Any]:
        return self.actions if state == A and history == () else self.actions[::-1]


class WantsNothing(Policy):
    def get_all_actions(self) -> list[Any]:
        return self.actions


class WantsAnything(Policy):
    def get_all_actions(self, **kwargs: Any) -> list[Any]:
        return self.actions if kwargs["state"] is not None else []


@pytest.mark.parametrize("policy", [WantsState, WantsBoth, WantsNothing, WantsAnything])
def test_actions_are_asked_for_as_planners_do(policy: type[Policy]) -> None:
    assert tabular(agent([A, B], Earns(lambda _: 1.0), policy(GO, STAY)), 0.9).actions == ("go", "stay")


class ByState(Policy):
    """Only `stay` outside of a."""

    def get_all_actions(self, state: Any = None, history: Any = None) -> list[Any]:
        return [STAY] if state == B else self.actions


def test_actions_that_depend_on_the_state() -> None:
    problem = agent([A, B], Earns(lambda _: 1.0), ByState(GO, STAY))
    with pytest.raises(UserError, match="state b has other actions than state a"):
        tabular(problem, 0.9)
    assert tabular(problem, 0.9, terminal=[B]).actions == ("go", "stay")
    assert tabular(problem, 0.9, actions=[GO, STAY]).actions == ("go", "stay")


def test_actions_that_cannot_be_listed() -> None:
    class Odd(Policy):
        def get_all_actions(self, where: Any) -> list[Any]:
            return self.actions

    for policy in (Odd(GO), pomdp_py.RolloutPolicy()):
        with pytest.raises(UserError, match=r"does not list the actions: give them"):
            tabular(agent([A], Earns(lambda _: 1.0), policy), 0.9)
    with pytest.raises(UserError, match="lists no actions"):
        tabular(agent([A], Earns(lambda _: 1.0), Acts()), 0.9)
