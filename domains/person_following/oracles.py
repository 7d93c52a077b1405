"""The exact optimum with the full state, by dynamic programming backward over time.

    V_t(s) = max_a E[ r + gamma * V_{t+1}(s') ], with V = 0 after the episode's end

The states are those of `dynamic_programming`. The policy is kept for the states that it reaches itself; asked
about another state, it solves that map once more and keeps the whole table.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from domains.core import GOAL, LEFT, BatchedEnvironment, DomainError, OracleResult
from domains.person_following.dynamic_programming import (
    follow_policy,
    reachable_states,
    step_tables,
    sweep_backward,
)
from domains.person_following.person_chain import (
    PENDING_LEFT,
    PENDING_NONE,
    PENDING_RIGHT,
    PersonChain,
    person_chain,
)
from domains.person_following.store import map_hash
from domains.person_following.variants import Parameters
from domains.person_following.world import (
    AT_GOAL,
    HEADING,
    LOST,
    PLAN_AT,
    PLAN_LENGTH,
    TIME,
    WAITING,
    World,
    X,
    Y,
)

_ROBOT_START = (1, 1, 0)
_PERSON_START = (2, 2, 0)
_MAX_REACHED = 1 << 20


class _Solved:
    """One map: what the policy does in the states it reaches, and what is needed to ask about others."""

    def __init__(self, chain: PersonChain, parameters: Parameters, policy: NDArray[np.int8]) -> None:
        states = np.empty((_MAX_REACHED, 6), np.int32)
        actions = np.empty(_MAX_REACHED, np.int8)
        start = chain.pose_index[_ROBOT_START]
        count = follow_policy(
            parameters.rules(following=True), step_tables(chain, parameters), policy, start, states, actions
        )
        self.pose_index = chain.pose_index
        self.route_length = chain.route_length
        self.goal = tuple(int(v) for v in np.argwhere(chain.grid == GOAL)[0])
        self.actions = {
            tuple(state): int(action) for state, action in zip(states[:count].tolist(), actions[:count], strict=True)
        }

    def state_of(self, world: World, parameters: Parameters, b: int) -> tuple[int, ...]:
        """(t, p, w, c, g, l) of environment b."""
        robot, person = world.robot[b].tolist(), world.person[b].tolist()
        at, length = person[PLAN_AT], person[PLAN_LENGTH]
        if (person[X], person[Y]) != self.goal:
            person_state = at
        else:
            pending = PENDING_NONE
            if at < length:
                pending = PENDING_LEFT if world.plan[b, at] == LEFT else PENDING_RIGHT
            person_state = self.route_length + 1 + person[HEADING] * 3 + pending
        return (
            robot[TIME],
            person_state,
            person[WAITING] if parameters.look_back else 0,
            int(self.pose_index[robot[X], robot[Y], robot[HEADING]]),
            min(robot[AT_GOAL], parameters.goal_patience + 1),
            robot[LOST],
        )


class FullStatePolicy:
    """The optimal policy of some maps, for evaluation on any environment that plays them."""

    def __init__(
        self, grids: NDArray[np.uint8], parameters: Parameters, discount: float, solved: list[_Solved]
    ) -> None:
        """Keep the maps as played, and the actions in the states that the policy reaches on each."""
        self._grids, self._parameters, self._discount, self._solved = grids, parameters, discount, solved
        self._index = {int(map_hash(grids, m)): m for m in range(len(grids))}
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
        actions = np.empty(env.num_envs, np.int64)
        for b in range(env.num_envs):
            m = self._index.get(int(world.map_id[b]))
            if m is None:
                raise DomainError("the environment plays a map that this optimum was not solved for")
            state = self._solved[m].state_of(world, self._parameters, b)
            action = self._solved[m].actions.get(state)
            actions[b] = self._whole_policy(m)[state] if action is None else action
        return actions

    def _solve_again(self, m: int) -> NDArray[np.int8]:
        chain = person_chain(self._grids[m], _PERSON_START, self._parameters)
        return _sweep(chain, self._parameters, self._discount)[0]


def full_state_optimum(
    grids: NDArray[np.uint8], weights: NDArray[np.float64], parameters: Parameters, discount: float
) -> OracleResult:
    """Solve every map [M, size, size]; averages are taken with `weights` [M].

    Raises:
        DomainError: a discount outside 0..1.
    """
    if not 0.0 <= discount <= 1.0:
        raise DomainError(f"discount must be in 0..1, got {discount}")
    played = grids.copy()
    played[:, _PERSON_START[0], _PERSON_START[1]] = 0
    values, returns, successes = (np.empty(len(grids)) for _ in range(3))
    solved = []
    for m, grid in enumerate(played):
        chain = person_chain(grid, _PERSON_START, parameters)
        policy, *tables = _sweep(chain, parameters, discount)
        start = chain.pose_index[_ROBOT_START]
        values[m], returns[m], successes[m] = (table[0, 0, 0, start, 0, 0] for table in tables)
        solved.append(_Solved(chain, parameters, policy))
    return OracleResult(
        value=float(values @ weights),
        mean_return=float(returns @ weights),
        success=float(successes @ weights),
        map_value=values,
        map_return=returns,
        map_success=successes,
        weights=weights,
        discount=discount,
        policy=FullStatePolicy(played, parameters, discount, solved),
    )


def _sweep(
    chain: PersonChain, parameters: Parameters, discount: float
) -> tuple[NDArray[np.int8], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Policy [T, P, W, C, G, L], and tables of which [0] is t = 0: value, undiscounted return, success."""
    people, poses = chain.distance.shape
    waits = 3 if parameters.look_back else 1
    shape = (people, waits, poses, parameters.goal_patience + 2, parameters.max_lost)
    rules = parameters.rules(following=True)
    reached = np.zeros((parameters.max_steps, people, waits), np.bool_)
    reachable_states(rules, chain.successors, reached)
    # Most of these entries are never touched, so they are reserved and not cleared.
    policy = np.empty((parameters.max_steps, *shape), np.int8)
    value, total, success = (np.zeros((2, *shape)) for _ in range(3))
    sweep_backward(rules, step_tables(chain, parameters), reached, discount, policy, value, total, success)
    return policy, value, total, success
