"""Models of the person that an agent may hold, and what an agent with such a model believes.

    explanations    of one world: the ways that its person may go, by order of surprise; the true one is among them
    belief          the worlds that fit all that was seen, each with its least surprising way that fits

The egocentric model takes the person to know what is really so: nobody is ever mistaken about where the goal is. A
person who walks on to where the goal was surprises an agent with this model; it then takes the person to have
learnt of the move only now, and is as sure as before that from now on it knows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from domains.core import FORWARD, LEFT, DomainError
from domains.person_following.oracles.bayes import BayesSearch
from domains.person_following.oracles.beliefs import POSE, WORLD, Belief, Gains, Worlds
from domains.person_following.oracles.full_state import sweep
from domains.person_following.oracles.person_chain import NEVER, PersonChain, chain_of
from domains.person_following.simulation.paths import STEPS, allocate_scratch, find_path
from domains.person_following.variants import Parameters

Explanations: TypeAlias = Callable[[PersonChain, Parameters], list[PersonChain]]
"""The ways of a world's person, least surprising first, the true one last."""
Observation: TypeAlias = tuple[NDArray[np.uint8], int]
"""A view [v, v] and a configuration."""


def true_person(chain: PersonChain, parameters: Parameters) -> list[PersonChain]:
    """The right model: the person does what it does."""
    return [chain]


def egocentric_person(chain: PersonChain, parameters: Parameters) -> list[PersonChain]:
    """The person knows of a moved goal at once; else one step later, two steps later, and so on."""
    if chain.moved_at == NEVER:
        return [chain]
    ways: list[PersonChain] = []
    for k in range(min(chain.moved_at, chain.route_length), chain.route_length):
        told = told_at(chain, k, parameters)
        if np.array_equal(told.person, chain.person) and np.array_equal(told.at_goal, chain.at_goal):
            break
        if not ways or not np.array_equal(told.person, ways[-1].person):
            ways.append(told)
    return [*ways, chain]


def told_at(chain: PersonChain, k: int, parameters: Parameters) -> PersonChain:
    """The chain of a person that learns of the move after k actions and takes the shortest path from there."""
    goal_x, goal_y = (int(v) for v in chain.goals[1])
    scratch = allocate_scratch(len(chain.grid))
    x, y, h = (int(v) for v in chain.person[k])
    length = find_path(chain.grid_after[None], 0, x, y, h, goal_x, goal_y, -1, False, scratch)
    route = chain.person[: k + 1].tolist()
    for action in scratch.path[: max(length, 0)].tolist():
        if action == FORWARD:
            x, y = x + STEPS[h][0], y + STEPS[h][1]
        else:
            h = (h + (3 if action == LEFT else 1)) % 4
        route.append([x, y, h])
    goals = chain.goals.tolist()
    there = [[cx, cy] == goals[t >= chain.moved_at] for t, (cx, cy, _) in enumerate(route)]
    way = np.array(route, np.int64)
    return chain_of(chain.grid, chain.grid_after, chain.goals, chain.moved_at, chain.own, way, parameters, there)


def egocentric_full_state(worlds: Worlds) -> Gains:
    """What the egocentric agent earns in every world where it sees the full state at every step.

    So what it loses against the full-state optimum, it loses by its model of the person's mind alone.

    Raises:
        DomainError: the person does not go its way by time alone.
    """
    parameters = worlds.parameters
    if parameters.turns_at_goal or parameters.look_back or parameters.person_rest:
        raise DomainError("the egocentric oracle needs turns_at_goal=False, look_back=False and person_rest=0")
    gains = Gains(*(np.zeros(len(worlds.chains)) for _ in range(3)))
    for i, chain in enumerate(worlds.chains):
        _play_full_state(worlds, i, chain, gains)
    return gains


def _play_full_state(worlds: Worlds, i: int, chain: PersonChain, gains: Gains) -> None:
    parameters = worlds.parameters
    particles = np.zeros((1, 6), np.int32)
    particles[0, WORLD], particles[0, POSE] = i, chain.pose_index[1, 1, 0]
    belief = Belief(0, particles, np.ones(1))
    planned = -1
    for t in range(parameters.max_steps):
        # Before the move the model is one and the same; after it, the person is seen to do something else.
        since = max(min(t, chain.route_length), min(chain.moved_at, chain.route_length))
        if since != planned:
            believed = told_at(chain, since, parameters) if chain.moved_at < NEVER else chain
            policy, planned = sweep(believed, parameters, worlds.discount)[0], since
        _, p, _, c, g, lost = belief.particles[0].tolist()
        state = min(p, believed.route_length)
        stood = g if believed.at_goal[state] == chain.at_goal[p] else int(believed.at_goal[state])
        successor = worlds.step(belief, int(policy[t, state, 0, c, stood, lost]), gains)
        if not successor.beliefs:
            break
        belief = successor.beliefs[0]


class Mind:
    """What all agents with one model of the person share: worlds by degree of surprise, and searches in them.

    A degree is only laid out when somebody is surprised so much.
    """

    def __init__(
        self,
        true: list[PersonChain],
        weights: NDArray[np.float64],
        parameters: Parameters,
        discount: float,
        explanations: Explanations,
    ) -> None:
        """Explain every world."""
        self.parameters, self.discount = parameters, discount
        self._weights = weights
        self._ways = [explanations(chain, parameters) for chain in true]
        self._degrees: list[BayesSearch] = []

    @property
    def num_degrees(self) -> int:
        """How many degrees of surprise there are."""
        return max(len(ways) for ways in self._ways)

    def degree(self, k: int) -> BayesSearch:
        """The search in the worlds whose persons go their k-th way, for the worlds that have so many."""
        while len(self._degrees) <= k:
            level = len(self._degrees)
            some = [i for i, ways in enumerate(self._ways) if len(ways) > level]
            ways = [self._ways[i][level] for i in some]
            worlds = Worlds(ways, self._weights[some], self.parameters, self.discount)
            self._degrees.append(BayesSearch(worlds))
        return self._degrees[k]


class Memory:
    """One agent's episode so far: the belief of the least degree of surprise that fits what it has seen."""

    def __init__(self, mind: Mind, first: Observation, waiting: int = 0) -> None:
        """Begin with the first observation; the person's waiting counter is taken as known."""
        self._mind, self._first, self._waiting = mind, first, waiting
        self._history: list[tuple[int, Observation]] = []
        self._degree = 0
        self.belief = self._fit()

    def action(self) -> int:
        """What is best in this belief, by the agent's model of the person."""
        search = self._mind.degree(self._degree)
        return search.action(self.belief) if self._degree == 0 else search.solve(self.belief)

    def observe(self, acted: int, seen: Observation) -> None:
        """Note an action and what was seen after it."""
        self._history.append((acted, seen))
        after = _stepped(self._mind.degree(self._degree).worlds, self.belief, acted, seen)
        if after is None:
            self._degree += 1
            after = self._fit()
        self.belief = after

    def _fit(self) -> Belief:
        """The belief of the least degree, from the present one on, in which all that was seen is possible."""
        while self._degree < self._mind.num_degrees:
            worlds = self._mind.degree(self._degree).worlds
            start = worlds.start(self._waiting)
            label = worlds.label(*self._first)
            belief = dict(zip(start.labels, start.beliefs, strict=True)).get(label)
            for acted, seen in self._history:
                belief = None if belief is None else _stepped(worlds, belief, acted, seen)
            if belief is not None:
                return belief
            self._degree += 1
        raise DomainError("what was seen is possible in none of the worlds that this optimum was solved for")


def _stepped(worlds: Worlds, belief: Belief, action: int, seen: Observation) -> Belief | None:
    """The belief after an action and an observation; None where that is impossible."""
    successor = worlds.step(belief, action)
    return dict(zip(successor.labels, successor.beliefs, strict=True)).get(worlds.label(*seen))
