"""The optima of agents that see only what the robot sees: Bayes, and egocentric.

Both know the set of worlds with their probabilities, and the rules; both plan exactly in their beliefs. They differ
in their model of the person alone: `wrong_models`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from domains.core import STAY, BatchedEnvironment, DomainError, OracleResult
from domains.person_following.oracles.bayes import BayesResult
from domains.person_following.oracles.beliefs import Gains
from domains.person_following.oracles.person_chain import person_chains
from domains.person_following.oracles.wrong_models import (
    Explanations,
    Memory,
    Mind,
    Observation,
    egocentric_person,
    true_person,
)
from domains.person_following.simulation.batch import Batch
from domains.person_following.simulation.world import TIME, WAITING
from domains.person_following.variants import Parameters


class HistoryPolicy:
    """Acts in every environment of a batch on what its robot has seen since the episode began.

    It is to be asked at every step. What the robot did in between is read off the environment, so another may act
    in its place now and then.
    """

    def __init__(self, mind: Mind, parameters: Parameters) -> None:
        """Begin without memories."""
        self._mind, self._parameters = mind, parameters
        self._batch: Batch | None = None
        self._memories: list[Memory | None] = []
        self._times: list[int] = []

    def actions(self, env: BatchedEnvironment) -> NDArray[np.int64]:
        """`[B]`: the best actions for what the robots have seen.

        Raises:
            DomainError: other rules or worlds than this optimum was solved for, or a step was left out.
        """
        batch: Batch = env.batch  # type: ignore[attr-defined]
        if batch.parameters != self._parameters:
            raise DomainError("the environment's parameters are not those that this optimum was solved for")
        return self.actions_in(batch)

    def actions_in(self, batch: Batch, active: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        """`[B]`: as `actions`, for what lies under an environment; anything where not `active`."""
        if batch is not self._batch:
            self._batch = batch
            self._memories, self._times = [None] * batch.num_envs, [-1] * batch.num_envs
        last, chosen = batch.last, np.full(batch.num_envs, STAY, np.int64)
        for b in range(batch.num_envs) if active is None else np.flatnonzero(active).tolist():
            t = int(batch.world.robot[b, TIME])
            seen: Observation = (last.robot_view[b], int(last.configuration[b]))
            memory = self._memories[b]
            if t == 0:
                waiting = int(batch.world.person[b, WAITING]) if self._parameters.look_back else 0
                memory = self._memories[b] = Memory(self._mind, seen, waiting)
            elif memory is None or t - self._times[b] not in (0, 1):
                raise DomainError("a policy under partial observability must be asked at every step of an episode")
            elif t > self._times[b]:
                memory.observe(int(last.acted[b]), seen)
            self._times[b] = t
            chosen[b] = memory.action()
        return chosen


def bayes_optimum(
    grids: NDArray[np.uint8], weights: NDArray[np.float64], parameters: Parameters, discount: float
) -> OracleResult:
    """Solve the beliefs over all worlds: raw maps [M, size, size] with each of their candidate goals.

    Raises:
        DomainError: a discount outside 0..1, too many worlds, or rules that the oracles do not cover.
    """
    mind = _mind(grids, weights, parameters, discount, true_person)
    found = _closed(mind)
    shares = mind.degree(0).worlds.weights
    # gains are weighted by the probability of their world
    return _result(Gains(*(gain / shares for gain in found.gains)), shares, discount, HistoryPolicy(mind, parameters))


def egocentric_optimum(
    grids: NDArray[np.uint8], weights: NDArray[np.float64], parameters: Parameters, discount: float
) -> OracleResult:
    """Plan with the egocentric model of the person, and play every world once in the true task.

    Where no goal moves nobody can be mistaken about it, and this is the Bayes optimum.

    Raises:
        DomainError: as `bayes_optimum`; or the goal moves, and the person does not go its way by time alone.
    """
    if not parameters.goal_moves_at:
        return bayes_optimum(grids, weights, parameters, discount)
    if parameters.turns_at_goal or parameters.person_knows == "seen":
        raise DomainError("the egocentric optimum needs turns_at_goal=False and person_knows='map'")
    mind = _mind(grids, weights, parameters, discount, egocentric_person)
    _closed(mind)
    policy = HistoryPolicy(mind, parameters)
    gains = play_worlds(grids, parameters, discount, policy)
    return _result(gains, _shares(weights, parameters), discount, HistoryPolicy(mind, parameters))


def play_worlds(grids: NDArray[np.uint8], parameters: Parameters, discount: float, policy: HistoryPolicy) -> Gains:
    """What a policy earns in every world, played once by the compiled rules."""
    count = len(grids) * parameters.num_goals
    batch = Batch("following", count, parameters)
    batch.seed(list(range(count)))
    own = np.tile(np.arange(parameters.num_goals), len(grids))
    batch.begin_worlds(np.repeat(grids, parameters.num_goals, axis=0), own)
    gains = Gains(*(np.zeros(count) for _ in range(3)))
    running = np.ones(count, np.bool_)
    for t in range(parameters.max_steps):
        batch.step(policy.actions_in(batch, running), False)
        gains.value[running] += discount**t * batch.last.reward[running]
        gains.total[running] += batch.last.reward[running]
        gains.success[running] += batch.last.outcome[running] == 1
        running &= ~batch.last.ended
        if not running.any():
            break
    return gains


def _mind(
    grids: NDArray[np.uint8],
    weights: NDArray[np.float64],
    parameters: Parameters,
    discount: float,
    explanations: Explanations,
) -> Mind:
    if not 0.0 <= discount <= 1.0:
        raise DomainError(f"discount must be in 0..1, got {discount}")
    chains = person_chains(grids, parameters)
    return Mind(chains, _shares(weights, parameters), parameters, discount, explanations)


def _closed(mind: Mind) -> BayesResult:
    """The solved search in the worlds whose persons do not surprise."""
    found = mind.degree(0).run()
    if not found.solved:
        raise DomainError(
            f"the bounds did not meet within {found.beliefs} beliefs: {found.lower:.3f} to {found.upper:.3f}"
        )
    return found


def _shares(weights: NDArray[np.float64], parameters: Parameters) -> NDArray[np.float64]:
    return np.repeat(weights / parameters.num_goals, parameters.num_goals)


def _result(gains: Gains, shares: NDArray[np.float64], discount: float, policy: HistoryPolicy) -> OracleResult:
    value, total, success = (float(gain @ shares) for gain in gains)
    return OracleResult(value, total, success, *gains, weights=shares, discount=discount, policy=policy)
