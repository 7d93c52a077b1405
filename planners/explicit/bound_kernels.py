"""Compiled bounds of an explicit POMDP's value at sparse beliefs, and one-step backups of both.

    L(b) = max_alpha alpha . b                          U(b) = corner . b + min(0, min_p gain_p min_s b(s) / p(s))
    Q(b, a) = R(b, a) + discount sum_o P(o | b, a) V(b^ao), with V = L or V = U

A belief is (index int64 [n], value float64 [n]): the states it allows and their probabilities. The upper bound is
the sawtooth interpolation over points p (Hauskrecht 2000); points outside a belief's support say nothing about it.
Vectors that a backup makes are kept only for the states that its belief allows, and hold for beliefs that allow no
others ("masked" vectors, Smith and Simmons 2005); those of blind policies hold everywhere.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nesy.compiled import njit
from planners.explicit.pomdp import TabularPOMDP

_LEAST = 1e-12  # chance below which an observation counts as impossible


class FlatPOMDP(NamedTuple):
    """A `TabularPOMDP` in flat arrays; successors of (a, s) lie at begin[a, s] : begin[a, s + 1]."""

    begin: np.ndarray
    successor: np.ndarray
    probability: np.ndarray
    observation: np.ndarray  # float64 [A, S', O]
    reward: np.ndarray  # float64 [A, S]
    discount: float


class BoundSet(NamedTuple):
    """Both bounds as arrays; `used` int64 [2] says how many vectors and points are in use.

    Attributes:
        blind: float64 [A, S], value of always doing one action.
        alpha_begin: int64 [M + 1], where each vector's entries lie in `alpha_index` and `alpha_value`.
        alpha_action: int64 [M], the action that each stands for.
        corner: float64 [S], upper bound at the corners of the belief simplex.
        point_begin: int64 [P + 1], where each point's entries lie in `point_index` and `point_value`.
        point_gain: float64 [P], how far each point lies below the plane through the corners (at most 0).
    """

    blind: np.ndarray
    alpha_begin: np.ndarray
    alpha_index: np.ndarray
    alpha_value: np.ndarray
    alpha_action: np.ndarray
    corner: np.ndarray
    point_begin: np.ndarray
    point_index: np.ndarray
    point_value: np.ndarray
    point_gain: np.ndarray
    used: np.ndarray


def flatten(model: TabularPOMDP) -> FlatPOMDP:
    """The arrays of `model` for these kernels."""
    begins, offset = [], 0
    for matrix in model.transition:
        matrix.sum_duplicates()
        begins.append(matrix.indptr.astype(np.int64) + offset)
        offset += len(matrix.data)
    return FlatPOMDP(
        np.stack(begins),
        np.concatenate([m.indices for m in model.transition]).astype(np.int64),
        np.concatenate([m.data for m in model.transition]).astype(np.float64),
        np.ascontiguousarray(model.observation, np.float64),
        np.ascontiguousarray(model.reward, np.float64),
        float(model.discount),
    )


@njit(cache=True)
def lower_at(bounds: BoundSet, index: np.ndarray, value: np.ndarray, dense: np.ndarray) -> tuple[float, int]:
    """(L(b), what gives it: an action's blind policy, or A + the number of a vector); also for unnormalised beliefs.

    `dense` float64 [S] is scratch, all zero before and after.
    """
    size = index.shape[0]
    best, which = -np.inf, 0
    for a in range(bounds.blind.shape[0]):
        total = 0.0
        for i in range(size):
            total += bounds.blind[a, index[i]] * value[i]
        if total > best:
            best, which = total, a
    for i in range(size):
        dense[index[i]] = value[i]
    for m in range(bounds.used[0]):
        begin, end = bounds.alpha_begin[m], bounds.alpha_begin[m + 1]
        if end - begin < size or bounds.alpha_index[begin] > index[0] or bounds.alpha_index[end - 1] < index[size - 1]:
            continue
        total, covered = 0.0, 0
        for j in range(begin, end):
            mass = dense[bounds.alpha_index[j]]
            if mass > 0.0:
                covered += 1
                total += mass * bounds.alpha_value[j]
        if covered == size and total > best:
            best, which = total, bounds.blind.shape[0] + m
    for i in range(size):
        dense[index[i]] = 0.0
    return best, which


@njit(cache=True)
def upper_at(bounds: BoundSet, index: np.ndarray, value: np.ndarray, dense: np.ndarray) -> float:
    """U(b); also for unnormalised beliefs. `dense` float64 [S] is scratch, all zero before and after."""
    base = 0.0
    for i in range(index.shape[0]):
        base += bounds.corner[index[i]] * value[i]
        dense[index[i]] = value[i]
    best = 0.0
    for p in range(bounds.used[1]):
        gain = bounds.point_gain[p]
        ratio = np.inf
        for j in range(bounds.point_begin[p], bounds.point_begin[p + 1]):
            ratio = min(ratio, dense[bounds.point_index[j]] / bounds.point_value[j])
            if ratio * gain >= best:
                break
        if ratio * gain < best:
            best = ratio * gain
    for i in range(index.shape[0]):
        dense[index[i]] = 0.0
    return base + best


@njit(cache=True)
def predict(flat: FlatPOMDP, index: np.ndarray, value: np.ndarray, action: int, dense: np.ndarray) -> np.ndarray:
    """Fill `dense` with the belief after `action`, before the observation; the states it allows, in order."""
    room = 0
    for i in range(index.shape[0]):
        room += flat.begin[action, index[i] + 1] - flat.begin[action, index[i]]
    reached = np.empty(room, np.int64)
    count = 0
    for i in range(index.shape[0]):
        for entry in range(flat.begin[action, index[i]], flat.begin[action, index[i] + 1]):
            mass = value[i] * flat.probability[entry]
            if mass > 0.0:
                after = flat.successor[entry]
                if dense[after] == 0.0:
                    reached[count] = after
                    count += 1
                dense[after] += mass
    reached = reached[:count]
    reached.sort()
    return reached


@njit(cache=True)
def observe(
    flat: FlatPOMDP, reached: np.ndarray, dense: np.ndarray, action: int, seen: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """The part of a prediction that explains an observation: (index, value, chance); value sums to chance."""
    index = np.empty(reached.shape[0], np.int64)
    value = np.empty(reached.shape[0])
    count, chance = 0, 0.0
    for i in range(reached.shape[0]):
        mass = dense[reached[i]] * flat.observation[action, reached[i], seen]
        if mass > 0.0:
            index[count], value[count] = reached[i], mass
            count += 1
            chance += mass
    return index[:count], value[:count], chance


@njit(cache=True)
def follow(
    flat: FlatPOMDP, index: np.ndarray, value: np.ndarray, action: int, seen: int, dense: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Bayes: (index, value, chance) of the belief after action and observation; the value sums to 1."""
    reached = predict(flat, index, value, action, dense)
    then, mass, chance = observe(flat, reached, dense, action, seen)
    for i in range(reached.shape[0]):
        dense[reached[i]] = 0.0
    return then, mass / max(chance, _LEAST), chance


@njit(cache=True)
def look(
    flat: FlatPOMDP,
    bounds: BoundSet,
    index: np.ndarray,
    value: np.ndarray,
    dense: np.ndarray,
    other: np.ndarray,
    q_lower: np.ndarray,
    q_upper: np.ndarray,
    chosen: np.ndarray,
    chances: np.ndarray,
    lowers: np.ndarray,
    uppers: np.ndarray,
) -> None:
    """One step ahead from a belief: fills q_lower, q_upper [A], and per (a, o): chosen vector, chance, L and U.

    `lowers` and `uppers` hold values of the normalised followers; `dense` and `other` are scratch, all zero.
    """
    for a in range(flat.reward.shape[0]):
        gain = 0.0
        for i in range(index.shape[0]):
            gain += flat.reward[a, index[i]] * value[i]
        reached = predict(flat, index, value, a, dense)
        low, high = gain, gain
        for o in range(flat.observation.shape[2]):
            then, mass, chance = observe(flat, reached, dense, a, o)
            chances[a, o] = chance if chance > _LEAST else 0.0
            chosen[a, o] = 0
            if chance <= _LEAST:
                continue
            below, chosen[a, o] = lower_at(bounds, then, mass, other)
            above = upper_at(bounds, then, mass, other)
            lowers[a, o], uppers[a, o] = below / chance, above / chance
            low += flat.discount * below
            high += flat.discount * above
        for i in range(reached.shape[0]):
            dense[reached[i]] = 0.0
        q_lower[a], q_upper[a] = low, high


@njit(cache=True)
def backed_up(flat: FlatPOMDP, bounds: BoundSet, action: int, chosen: np.ndarray, index: np.ndarray) -> np.ndarray:
    """The vector of doing `action` and then following vector chosen[o] after observation o, at the states `index`."""
    num_actions, num_states = flat.reward.shape
    num_observations = flat.observation.shape[2]
    followed = np.zeros((num_observations, num_states))
    for o in range(num_observations):
        if chosen[o] < num_actions:
            followed[o] = bounds.blind[chosen[o]]
            continue
        m = chosen[o] - num_actions
        for j in range(bounds.alpha_begin[m], bounds.alpha_begin[m + 1]):
            followed[o, bounds.alpha_index[j]] = bounds.alpha_value[j]
    out = np.empty(index.shape[0])
    for i in range(index.shape[0]):
        s = index[i]
        future = 0.0
        for entry in range(flat.begin[action, s], flat.begin[action, s + 1]):
            after = flat.successor[entry]
            inner = 0.0
            for o in range(num_observations):
                inner += flat.observation[action, after, o] * followed[o, after]
            future += flat.probability[entry] * inner
        out[i] = flat.reward[action, s] + flat.discount * future
    return out


@njit(cache=True)
def undominated(bounds: BoundSet, group: np.ndarray) -> np.ndarray:
    """Which vectors, bool [M], no other one of their group (those over the same states) is at least as good as.

    Of equal ones the first stays.
    """
    count = bounds.used[0]
    keep = np.ones(count, np.bool_)
    for i in range(count):
        at, size = bounds.alpha_begin[i], bounds.alpha_begin[i + 1] - bounds.alpha_begin[i]
        for j in range(count):
            if i == j or not keep[j] or group[i] != group[j]:
                continue
            other = bounds.alpha_begin[j]
            worse, equal = True, True
            for k in range(size):
                if bounds.alpha_value[at + k] > bounds.alpha_value[other + k] + 1e-12:
                    worse = False
                    break
                if bounds.alpha_value[at + k] < bounds.alpha_value[other + k] - 1e-12:
                    equal = False
            if worse and (not equal or j < i):
                keep[i] = False
                break
    return keep
