"""The optimum of an agent with a wrong model of the person, evaluated in the true task.

The egocentric agent takes the person to believe what it knows itself: as soon as the goal has moved, it expects
the person to turn to the new place. It has the full state, plans by dynamic programming with this model, takes
the first action, sees what really happens, and plans again. So what it loses against the full-state optimum, it
loses by its model of the person's mind alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from domains.core import FORWARD, LEFT, DomainError
from domains.person_following.beliefs import LOST_COUNT, PERSON, POSE, STOOD, WAIT, Belief, Worlds
from domains.person_following.oracles import sweep
from domains.person_following.paths import allocate_scratch, astar, step_x, step_y
from domains.person_following.person_chain import NEVER, PersonChain, chain_of
from domains.person_following.variants import Parameters


@dataclass(frozen=True)
class WrongModelResult:
    """Averages over worlds, and the share of steps at which the model was wrong about the person's way."""

    value: float
    mean_return: float
    success: float
    map_return: NDArray[np.float64]


def egocentric_optimum(worlds: Worlds) -> WrongModelResult:
    """Play every world with the egocentric agent.

    Raises:
        DomainError: rules under which the person turns about or waits, so that time does not tell where it is.
    """
    parameters = worlds.parameters
    if parameters.turns_at_goal or parameters.look_back or parameters.person_rest:
        raise DomainError("the egocentric oracle needs turns_at_goal=False, look_back=False and person_rest=0")
    rows = [_play(worlds, i) for i in range(len(worlds.chains))]
    value, total, success = np.array(rows).T
    weights = worlds.weights
    return WrongModelResult(float(value @ weights), float(total @ weights), float(success @ weights), total)


def _play(worlds: Worlds, i: int) -> tuple[float, float, float]:
    """Discounted and undiscounted return, and success, in world i."""
    chain, parameters = worlds.chains[i], worlds.parameters
    particles = np.zeros((1, 6), np.int32)
    particles[0, 0] = i
    particles[0, POSE] = chain.pose_index[1, 1, 0]
    belief = Belief(0, particles, np.ones(1))
    value = total = success = 0.0
    plans: dict[int, tuple[NDArray[np.int8], PersonChain]] = {}
    for t in range(parameters.max_steps):
        # Before the move the model is one and the same; after it, the person is seen to do something else.
        told = min(chain.moved_at, chain.route_length)
        since = max(min(t, chain.route_length), told)
        if since not in plans:
            believed = _told_at(chain, since, parameters) if chain.moved_at < NEVER else chain
            plans = {since: (sweep(believed, parameters, worlds.discount)[0], believed)}
        policy, believed = plans[since]
        _, p, w, c, g, lost = belief.particles[0].tolist()
        assert (p, w) == (belief.particles[0, PERSON], belief.particles[0, WAIT])
        assert (g, lost) == (belief.particles[0, STOOD], belief.particles[0, LOST_COUNT])
        state = min(p, believed.route_length)
        stood = g if believed.at_goal[state] == chain.at_goal[p] else int(believed.at_goal[state])
        action = int(policy[t, state, 0, c, stood, lost])
        successor = worlds.step(belief, action)
        value += worlds.discount**t * successor.reward
        total += successor.reward
        success += successor.success
        if not successor.beliefs:
            break
        belief = successor.beliefs[0]
    return value, total, success


def _told_at(chain: PersonChain, k: int, parameters: Parameters) -> PersonChain:
    """The chain of a person that learns of the move after k actions and takes the shortest path from there."""
    goal_x, goal_y = (int(v) for v in chain.goals[1])
    scratch = allocate_scratch(len(chain.grid))
    x, y, h = (int(v) for v in chain.person[k])
    length = astar(chain.grid_after[None], 0, x, y, h, goal_x, goal_y, -1, False, scratch)
    route = chain.person[: k + 1].tolist()
    for action in scratch.path[: max(length, 0)].tolist():
        if action == FORWARD:
            x, y = x + step_x(h), y + step_y(h)
        else:
            h = (h + (3 if action == LEFT else 1)) % 4
        route.append([x, y, h])
    return chain_of(
        chain.grid,
        chain.grid_after,
        chain.goals,
        chain.moved_at,
        chain.own,
        np.array(route, np.int64),
        parameters,
        [(cx, cy) == (goal_x, goal_y) for cx, cy, _ in route] if k >= chain.moved_at else None,
    )
