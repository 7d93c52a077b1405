"""Compiled bounds of an explicit POMDP's value at sparse beliefs, and one-step backups of both.

    L(b) = max_alpha alpha . b                          U(b) = corner . b + min(0, min_p gain_p min_s b(s) / p(s))
    Q(b, a) = R(b, a) + discount sum_o P(o | b, a) V(b^ao), with V = L or V = U

A belief is (index int64 [n], value float64 [n]): the states it allows and their probabilities. The upper bound is
the sawtooth interpolation over points p (Hauskrecht 2000); points outside a belief's support say nothing about it.
Vectors that a backup makes are kept only for the states that its belief allows, and hold for beliefs that allow no
others ("masked" vectors, Smith and Simmons 2005); those of blind policies hold everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse

from nesy.compiled import njit
from planners.explicit.pomdp import TabularPOMDP

_LEAST = 1e-12  # chance below which an observation makes no branch; its worth is counted all the same


class FlatPOMDP(NamedTuple):
    """A `TabularPOMDP` in flat arrays.

    Successors of (a, s) lie at begin[a, s] : begin[a, s + 1], observations after (a, s') at shown[a, s'] :
    shown[a, s' + 1].
    """

    begin: np.ndarray
    successor: np.ndarray
    probability: np.ndarray
    shown: np.ndarray
    seen: np.ndarray
    seen_chance: np.ndarray
    num_observations: int
    reward: np.ndarray  # float64 [A, S]
    discount: float
    worst: float  # no policy is worth less in any state


class Ahead(NamedTuple):
    """What one step ahead shows, and room to work in.

    Attributes:
        q_lower, q_upper: float64 [A].
        chosen: int64 [A, O], what gives the lower bound after each observation, numbered as by `lower_at`.
        chances: float64 [A, O], of the observations that make a branch; 0 for others.
        lowers, uppers: float64 [A, O], bounds of the beliefs that follow.
        dense, other: float64 [S], scratch, all zero before and after.
        counts: int64 [O], scratch, all zero before and after.
    """

    q_lower: np.ndarray
    q_upper: np.ndarray
    chosen: np.ndarray
    chances: np.ndarray
    lowers: np.ndarray
    uppers: np.ndarray
    dense: np.ndarray
    other: np.ndarray
    counts: np.ndarray


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
    tables = [sparse.csr_array(table) for table in model.observation]
    worst = min(float(model.reward.min()), 0.0) / (1 - model.discount)
    return FlatPOMDP(
        *_joined(model.transition),
        *_joined(tables),
        len(model.observations),
        np.ascontiguousarray(model.reward, np.float64),
        float(model.discount),
        worst * (1 + 1e-9),
    )


def _joined(matrices: Sequence[sparse.csr_array]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each row of each matrix begins, int64 [A, S + 1], and the columns and entries of all."""
    sizes = np.cumsum([0, *(len(matrix.data) for matrix in matrices)])
    return (
        np.stack([matrix.indptr.astype(np.int64) + before for matrix, before in zip(matrices, sizes, strict=False)]),
        np.concatenate([matrix.indices for matrix in matrices]).astype(np.int64),
        np.concatenate([matrix.data for matrix in matrices]).astype(np.float64),
    )


def room_ahead(flat: FlatPOMDP) -> Ahead:
    """Room for `look`."""
    num_actions, num_states = flat.reward.shape
    shape = (num_actions, flat.num_observations)
    return Ahead(
        np.zeros(num_actions),
        np.zeros(num_actions),
        np.zeros(shape, np.int64),
        np.zeros(shape),
        np.zeros(shape),
        np.zeros(shape),
        np.zeros(num_states),
        np.zeros(num_states),
        np.zeros(flat.num_observations, np.int64),
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
def lower_corner(bounds: BoundSet, state: int, value: float) -> None:
    """A better upper bound of one state; points keep their values, so their gains shrink."""
    drop = bounds.corner[state] - value
    bounds.corner[state] = value
    for p in range(bounds.used[1]):
        for j in range(bounds.point_begin[p], bounds.point_begin[p + 1]):
            if bounds.point_index[j] == state:
                bounds.point_gain[p] = min(bounds.point_gain[p] + drop * bounds.point_value[j], 0.0)


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
def explain(
    flat: FlatPOMDP, reached: np.ndarray, dense: np.ndarray, action: int, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A prediction by what is seen: (observations [n], begin [n + 1], index, value); parts sum to their chances.

    `counts` int64 [O] is scratch, all zero before and after.
    """
    room = 0
    for i in range(reached.shape[0]):
        room += flat.shown[action, reached[i] + 1] - flat.shown[action, reached[i]]
    seen = np.empty(min(room, flat.num_observations), np.int64)
    kinds = 0
    for i in range(reached.shape[0]):
        for entry in range(flat.shown[action, reached[i]], flat.shown[action, reached[i] + 1]):
            o = flat.seen[entry]
            if counts[o] == 0:
                seen[kinds] = o
                kinds += 1
            counts[o] += 1
    seen = seen[:kinds]
    seen.sort()
    begin = np.zeros(kinds + 1, np.int64)
    for k in range(kinds):
        begin[k + 1] = begin[k] + counts[seen[k]]
        counts[seen[k]] = begin[k]
    index, value = np.empty(room, np.int64), np.empty(room)
    for i in range(reached.shape[0]):
        for entry in range(flat.shown[action, reached[i]], flat.shown[action, reached[i] + 1]):
            at = counts[flat.seen[entry]]
            index[at], value[at] = reached[i], dense[reached[i]] * flat.seen_chance[entry]
            counts[flat.seen[entry]] = at + 1
    for k in range(kinds):
        counts[seen[k]] = 0
    return seen, begin, index, value


@njit(cache=True)
def follow(
    flat: FlatPOMDP, index: np.ndarray, value: np.ndarray, action: int, seen: int, dense: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Bayes: (index, value, chance) of the belief after action and observation; the value sums to 1."""
    reached = predict(flat, index, value, action, dense)
    then, mass = np.empty(reached.shape[0], np.int64), np.empty(reached.shape[0])
    count, chance = 0, 0.0
    for i in range(reached.shape[0]):
        for entry in range(flat.shown[action, reached[i]], flat.shown[action, reached[i] + 1]):
            joint = dense[reached[i]] * flat.seen_chance[entry]
            if flat.seen[entry] == seen and joint > 0.0:
                then[count], mass[count] = reached[i], joint
                count += 1
                chance += joint
        dense[reached[i]] = 0.0
    return then[:count], mass[:count] / max(chance, _LEAST), chance


@njit(cache=True)
def look(flat: FlatPOMDP, bounds: BoundSet, index: np.ndarray, value: np.ndarray, ahead: Ahead) -> None:
    """One step ahead from a belief: fills `ahead`."""
    for a in range(flat.reward.shape[0]):
        gain = 0.0
        for i in range(index.shape[0]):
            gain += flat.reward[a, index[i]] * value[i]
        reached = predict(flat, index, value, a, ahead.dense)
        seen, begin, then, mass = explain(flat, reached, ahead.dense, a, ahead.counts)
        for i in range(reached.shape[0]):
            ahead.dense[reached[i]] = 0.0
        ahead.chances[a], ahead.chosen[a] = 0.0, 0
        low, high = gain, gain
        for k in range(seen.shape[0]):
            o, at, end = seen[k], begin[k], begin[k + 1]
            below, ahead.chosen[a, o] = lower_at(bounds, then[at:end], mass[at:end], ahead.other)
            above = upper_at(bounds, then[at:end], mass[at:end], ahead.other)
            low += flat.discount * below
            high += flat.discount * above
            chance = mass[at:end].sum()
            if chance > _LEAST:
                ahead.chances[a, o] = chance
                ahead.lowers[a, o], ahead.uppers[a, o] = below / chance, above / chance
        ahead.q_lower[a], ahead.q_upper[a] = low, high


@njit(cache=True)
def upper_ahead(flat: FlatPOMDP, bounds: BoundSet, index: np.ndarray, value: np.ndarray, ahead: Ahead) -> float:
    """The greatest q_upper of `look`, alone."""
    best = -np.inf
    for a in range(flat.reward.shape[0]):
        high = 0.0
        for i in range(index.shape[0]):
            high += flat.reward[a, index[i]] * value[i]
        reached = predict(flat, index, value, a, ahead.dense)
        seen, begin, then, mass = explain(flat, reached, ahead.dense, a, ahead.counts)
        for i in range(reached.shape[0]):
            ahead.dense[reached[i]] = 0.0
        for k in range(seen.shape[0]):
            at, end = begin[k], begin[k + 1]
            high += flat.discount * upper_at(bounds, then[at:end], mass[at:end], ahead.other)
        best = max(best, high)
    return best


@njit(cache=True)
def tighten(flat: FlatPOMDP, bounds: BoundSet, states: np.ndarray, ahead: Ahead) -> float:
    """Back up the upper bound at these states and at all points, in place; the greatest improvement."""
    gained, sure = 0.0, np.ones(1)
    for i in range(states.shape[0]):
        value = upper_ahead(flat, bounds, states[i : i + 1], sure, ahead)
        before = bounds.corner[states[i]]
        if value < before:
            lower_corner(bounds, states[i], value)
            gained = max(gained, before - value)
    for p in range(bounds.used[1]):
        begin, end = bounds.point_begin[p], bounds.point_begin[p + 1]
        index, mass = bounds.point_index[begin:end], bounds.point_value[begin:end]
        gain = upper_ahead(flat, bounds, index, mass, ahead)
        for i in range(index.shape[0]):
            gain -= bounds.corner[index[i]] * mass[i]
        if gain < bounds.point_gain[p]:
            gained = max(gained, bounds.point_gain[p] - gain)
            bounds.point_gain[p] = gain
    return gained


@njit(cache=True)
def backed_up(flat: FlatPOMDP, bounds: BoundSet, action: int, chosen: np.ndarray, index: np.ndarray) -> np.ndarray:
    """The vector of doing `action` and then following vector chosen[o] after observation o, at the states `index`.

    Where a vector says nothing of a state (one so improbable that its share was lost), the worst is assumed.
    """
    num_actions, num_states = flat.reward.shape
    place = np.full(num_actions + bounds.used[0], -1, np.int64)  # of what follows, among what was laid out so far
    followed = np.empty((min(flat.num_observations, place.shape[0]), num_states))
    laid = 0
    out = np.empty(index.shape[0])
    for i in range(index.shape[0]):
        s = index[i]
        future = 0.0
        for entry in range(flat.begin[action, s], flat.begin[action, s + 1]):
            after = flat.successor[entry]
            inner = 0.0
            for e in range(flat.shown[action, after], flat.shown[action, after + 1]):
                which = chosen[flat.seen[e]]
                if place[which] < 0:
                    place[which] = laid
                    if which < num_actions:
                        followed[laid] = bounds.blind[which]
                    else:
                        followed[laid] = flat.worst
                        m = which - num_actions
                        for j in range(bounds.alpha_begin[m], bounds.alpha_begin[m + 1]):
                            followed[laid, bounds.alpha_index[j]] = bounds.alpha_value[j]
                    laid += 1
                inner += flat.seen_chance[e] * followed[place[which], after]
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
