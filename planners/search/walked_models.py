"""Models that searches by sampled walks can go through: explicit POMDPs, and 2DBNs with rewards on their factors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planners.search.code_sampling import CodeSampler, next_code
from planners.search.random_bits import drawn, uniform
from planners.search.walk import Kernels, register


class PackedPOMDP(NamedTuple):
    """A `TabularPOMDP` in flat arrays; successors of (a, s) lie at begin[a, s] : begin[a, s + 1]."""

    begin: np.ndarray
    successor: np.ndarray
    cumulative: np.ndarray
    observation: np.ndarray  # float64 [A, S', O], cumulative
    reward: np.ndarray
    terminal: np.ndarray
    leaf: np.ndarray


class TabularBelief(NamedTuple):
    """A belief over states: those it allows, int64 [n], and their cumulative probabilities."""

    support: np.ndarray
    cumulative: np.ndarray


class FactoredModel(NamedTuple):
    """A 2DBN as a decision problem; beliefs are particles int16 [P, N]. Leaves are worth nothing.

    Attributes:
        codes: the 2DBN, for drawing.
        reward: float64 [N, K], what each value of each factor earns in the state reached.
        paid: int64 [R], the factors that earn anything.
        seen: int64 [M], the factors that the robot observes.
    """

    codes: CodeSampler
    reward: np.ndarray
    paid: np.ndarray
    seen: np.ndarray

    @classmethod
    def of(cls, codes: CodeSampler, reward: np.ndarray, seen: np.ndarray) -> FactoredModel:
        """The model of a sampler with these rewards and these observed factors."""
        return cls(codes, reward, np.flatnonzero(reward.any(axis=1)), seen)


def _tabular_room(model: PackedPOMDP) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1, np.int64)


def _tabular_begin(model: PackedPOMDP, belief: TabularBelief, state: np.ndarray, bits: np.ndarray) -> bool:
    state[0] = belief.support[drawn(belief.cumulative, bits)]
    return not model.terminal[state[0]]


def _tabular_advance(
    model: PackedPOMDP, state: np.ndarray, action: int, after: np.ndarray, scratch: np.ndarray, bits: np.ndarray
) -> tuple[float, bool, int, float]:
    entry, end = model.begin[action, state[0]], model.begin[action, state[0] + 1]
    number = uniform(bits)
    while entry < end - 1 and number >= model.cumulative[entry]:
        entry += 1
    reached = model.successor[entry]
    number = uniform(bits)
    seen, last = 0, model.observation.shape[2] - 1
    while seen < last and number >= model.observation[action, reached, seen]:
        seen += 1
    after[0] = reached
    return model.reward[action, state[0]], model.terminal[reached], seen, model.leaf[reached]


def _factored_room(model: FactoredModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = model.codes.plan.shape[1]
    return np.zeros(n, np.int16), np.zeros(n, np.int16), np.zeros(1, np.int16)


def _factored_begin(model: FactoredModel, belief: np.ndarray, state: np.ndarray, bits: np.ndarray) -> bool:
    particle = np.int64(uniform(bits) * belief.shape[0])
    for i in range(state.shape[0]):
        state[i] = belief[particle, i]
    return True


def _factored_advance(
    model: FactoredModel, state: np.ndarray, action: int, after: np.ndarray, scratch: np.ndarray, bits: np.ndarray
) -> tuple[float, bool, int, float]:
    next_code(model.codes, state, 0, action, after, 0, bits)
    reward, key = 0.0, 0
    for j in range(model.paid.shape[0]):
        reward += model.reward[model.paid[j], after[model.paid[j]]]
    for j in range(model.seen.shape[0]):
        key = key * model.reward.shape[1] + after[model.seen[j]]
    return reward, False, key, 0.0


register(PackedPOMDP, Kernels(_tabular_room, _tabular_begin, _tabular_advance))
register(FactoredModel, Kernels(_factored_room, _factored_begin, _factored_advance))
