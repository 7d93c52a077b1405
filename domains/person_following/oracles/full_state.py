"""The exact optimum with the full state, by dynamic programming backward over time.

    V_t(s) = max_a E[ r + gamma * V_{t+1}(s') ], with V = 0 after the episode's end

The states are those of `dynamic_programming`. The policy is kept for the states that it reaches itself; asked
about another state, it solves that map once more and keeps the whole table.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from domains.core import LEFT, BatchedEnvironment, DomainError, OracleResult
from domains.person_following.oracles.dynamic_programming import (
    follow_policy,
    reachable_states,
    step_tables,
    sweep_backward,
)
from domains.person_following.oracles.person_chain import (
    PENDING_LEFT,
    PENDING_NONE,
    PENDING_RIGHT,
    PersonChain,
    person_chains,
)
from domains.person_following.simulation.store import map_hash
from domains.person_following.simulation.world import (
    AT_GOAL,
    HEADING,
    LOST,
    MOVES,
    OWN,
    PLAN_AT,
    PLAN_LENGTH,
    TIME,
    WAITING,
    World,
    X,
    Y,
)
from domains.person_following.variants import Parameters

_ROBOT_START = (1, 1, 0)
_MAX_REACHED = 1 << 20


class _Solved:
    """One world: what the policy does in the states it reaches, and what is needed to ask about others."""

    def __init__(self, chain: PersonChain, parameters: Parameters, policy: NDArray[np.int8]) -> None:
        states = np.empty((_MAX_REACHED, 6), np.int32)
        actions = np.empty(_MAX_REACHED, np.int8)
        start = chain.pose_index[_ROBOT_START]
        count = follow_policy(
            parameters.rules(following=True), step_tables(chain, parameters), policy, start, states, actions
        )
        self.chain = chain
        self.actions = {
            tuple(state): int(action) for state, action in zip(states[:count].tolist(), actions[:count], strict=True)
        }

    def state_of(self, world: World, parameters: Parameters, b: int) -> tuple[int, ...]:
        """(t, p, w, c, g, l) of environment b."""
        robot, person = world.robot[b].tolist(), world.person[b].tolist()
        length = self.chain.route_length
        person_state = min(person[MOVES], length)
        if person_state == length and parameters.turns_at_goal:
            at = person[PLAN_AT]
            pending = PENDING_NONE
            if person[MOVES] > length and at < person[PLAN_LENGTH]:
                pending = PENDING_LEFT if world.plan[b, at] == LEFT else PENDING_RIGHT
            person_state = length + 1 + person[HEADING] * 3 + pending
        return (
            robot[TIME],
            person_state,
            person[WAITING] if parameters.look_back else 0,
            int(self.chain.pose_index[robot[X], robot[Y], robot[HEADING]]),
            min(robot[AT_GOAL], parameters.goal_patience + 1),
            robot[LOST],
        )


class FullStatePolicy:
    """The optimal policy of some worlds, for evaluation on any environment that plays them."""

    def __init__(self, parameters: Parameters, discount: float, solved: list[_Solved]) -> None:
        """Keep the worlds and, for each, the actions in the states that the policy reaches."""
        self._parameters, self._discount, self._solved = parameters, discount, solved
        self._index = {(int(map_hash(one.chain.grid[None], 0)), one.chain.own): i for i, one in enumerate(solved)}
        self._whole_policy = lru_cache(maxsize=8)(self._solve_again)

    def actions(self, env: BatchedEnvironment) -> NDArray[np.int64]:
        """`[B]`: an optimal action in each environment's present state.

        Raises:
            DomainError: the environment plays a map, or rules, that this policy was not solved for.
        """
        batch = env.batch  # type: ignore[attr-defined]
        if batch.parameters != self._parameters:
            raise DomainError("the environment's parameters are not those that this optimum was solved for")
        world: World = batch.world
        actions = np.empty(batch.num_envs, np.int64)
        for b in range(batch.num_envs):
            i = self._index.get((int(world.map_id[b]), int(world.person[b, OWN])))
            if i is None:
                raise DomainError("the environment plays a map that this optimum was not solved for")
            state = self._solved[i].state_of(world, self._parameters, b)
            action = self._solved[i].actions.get(state)
            actions[b] = self._whole_policy(i)[state] if action is None else action
        return actions

    def _solve_again(self, i: int) -> NDArray[np.int8]:
        return sweep(self._solved[i].chain, self._parameters, self._discount)[0]


def full_state_optimum(
    grids: NDArray[np.uint8], weights: NDArray[np.float64], parameters: Parameters, discount: float
) -> OracleResult:
    """Solve every world: every raw map [M, size, size] with each of its candidate goals.

    Averages are taken with `weights` [M], the candidates of a map being equally likely; the arrays by map have
    one entry per world, the candidates of a map side by side.

    Raises:
        DomainError: a discount outside 0..1, or rules that dynamic programming does not cover.
    """
    if not 0.0 <= discount <= 1.0:
        raise DomainError(f"discount must be in 0..1, got {discount}")
    chains = person_chains(grids, parameters)
    values, returns, successes = (np.empty(len(chains)) for _ in range(3))
    solved = []
    for i, chain in enumerate(chains):
        policy, *tables = sweep(chain, parameters, discount)
        start = chain.pose_index[_ROBOT_START]
        values[i], returns[i], successes[i] = (table[0, 0, 0, start, 0, 0] for table in tables)
        solved.append(_Solved(chain, parameters, policy))
    shares = np.repeat(weights / parameters.num_goals, parameters.num_goals)
    return OracleResult(
        value=float(values @ shares),
        mean_return=float(returns @ shares),
        success=float(successes @ shares),
        map_value=values,
        map_return=returns,
        map_success=successes,
        weights=shares,
        discount=discount,
        policy=FullStatePolicy(parameters, discount, solved),
    )


def sweep(
    chain: PersonChain,
    parameters: Parameters,
    discount: float,
    kept: NDArray[np.float32] | None = None,
    reached: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.int8], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Policy [T, P, W, C, G, L], and tables of which [0] is t = 0: value, undiscounted return, success.

    `kept` [K, P, W, C, G, L], if given, is filled with the values of the first K steps, and `reached` [T, P, W] with
    where that is so.
    """
    shape = state_shape(chain, parameters)
    people, waits = shape[:2]
    rules = parameters.rules(following=True)
    if reached is None:
        reached = np.zeros((parameters.max_steps, people, waits), np.bool_)
    reachable_states(rules, chain.successors, reached)
    # Most of these entries are never touched, so they are reserved and not cleared.
    policy = np.empty((parameters.max_steps, *shape), np.int8)
    value, total, success = (np.zeros((2, *shape)) for _ in range(3))
    if kept is None:
        kept = np.empty((0, *shape), np.float32)
    tables = step_tables(chain, parameters)
    sweep_backward(rules, tables, reached, discount, policy, value, total, success, kept)
    return policy, value, total, success


def state_shape(chain: PersonChain, parameters: Parameters) -> tuple[int, int, int, int, int]:
    """Sizes (P, W, C, G, L) of a world's tables."""
    people, poses = chain.distance.shape
    return people, 3 if parameters.look_back else 1, poses, parameters.goal_patience + 2, parameters.max_lost
