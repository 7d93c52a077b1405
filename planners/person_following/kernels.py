"""Compiled kernels of the influence-augmented local model: draw one step, and weigh a step against evidence.

A state is a vector int16 [2N + 5]: x, y, side, ahead, heading, waiting, lost, with side and ahead counted from
0 (`RelativeMotion.shifted`). A step's variables are laid out as planners.person_following.ialm says.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from domains.core import STAY
from nesy.compiled import njit
from nesy.dbn.inference.kernels import Packed
from planners.models.tables import PackedTables, locate
from planners.person_following import ialm
from planners.person_following.ialm import IALM
from planners.person_following.motion import WAIT
from planners.search.code_sampling import CodeSampler, next_code, sampler
from planners.search.random_bits import uniform

_FLOOR = 1e-6  # a transition that the 2DBN calls impossible is only very improbable: the model is learned


class Model(NamedTuple):
    """The IALM in flat arrays."""

    dbn: Packed
    codes: CodeSampler
    tables: PackedTables
    coefficients: np.ndarray
    next_heading: np.ndarray
    window: int


def compile_model(model: IALM) -> Model:
    """The arrays of `model` for kernels."""
    return Model(
        model.packed_dbn,
        sampler(model.packed_dbn),
        model.packed_tables,
        np.ascontiguousarray(model.motion.coefficients, np.int64),
        np.ascontiguousarray(model.motion.next_heading, np.int64),
        int(model.motion.window),
    )


@njit(cache=True)
def draw(tables: PackedTables, table: int, variables: np.ndarray, rng: np.ndarray) -> int:
    """Draw a class from one learned distribution."""
    node = locate(tables, table, variables)
    number = uniform(rng)
    k = 0
    last = tables.estimate.shape[1] - 1
    while k < last and number >= tables.estimate[node, k]:
        k += 1
    return k


@njit(cache=True)
def chance(tables: PackedTables, table: int, variables: np.ndarray, k: int) -> float:
    """Probability of class k under one learned distribution."""
    node = locate(tables, table, variables)
    below = tables.estimate[node, k - 1] if k > 0 else 0.0
    return tables.estimate[node, k] - below


@njit(cache=True)
def code_chance(dbn: Packed, now: np.ndarray, action: int, then: np.ndarray) -> float:
    """T(then | now, action) under the 2DBN, for codes [N], floored per factor."""
    num_factors = dbn.order.shape[0]
    product = 1.0
    for i in range(num_factors):
        row = dbn.offsets[action, i]
        for j in range(dbn.num_parents[action, i]):
            p = dbn.parents[action, i, j]
            value = now[p] if p < num_factors else then[p - num_factors]
            row += dbn.strides[action, i, j] * value
        product *= max(dbn.probabilities[row, then[i]], _FLOOR)
    return product


@njit(cache=True)
def move_pose(model: Model, variables: np.ndarray, source: int, target: int, motion: int, person: int) -> None:
    """Write the pose at `target` (3 slots) that follows from the one at `source` under (motion, person)."""
    side = variables[source] - model.window
    ahead = variables[source + 1] - model.window
    heading = variables[source + 2]
    a = model.coefficients[motion, person, heading]
    next_side = a[0, 0] * side + a[0, 1] * ahead + a[0, 2]
    next_ahead = a[1, 0] * side + a[1, 1] * ahead + a[1, 2]
    variables[target] = min(max(next_side, -model.window), model.window) + model.window
    variables[target + 1] = min(max(next_ahead, -model.window), model.window) + model.window
    variables[target + 2] = model.next_heading[motion, person, heading]


@njit(cache=True)
def load_state(model: Model, state: np.ndarray, action: int, v: np.ndarray) -> None:
    """Write a state and the robot's action into the variables `v`."""
    n = model.dbn.order.shape[0]
    for i in range(n):
        v[i] = state[i]
        v[2 * n + i] = state[n + i]
    for i in range(3):
        v[3 * n + ialm.SIDE + i] = state[2 * n + i]
    v[3 * n + ialm.IS_WAITING] = state[2 * n + 3]
    v[3 * n + ialm.LOST_COUNT] = state[2 * n + 4]
    v[3 * n + ialm.ACTION] = action


@njit(cache=True)
def step(
    model: Model, state: np.ndarray, action: int, after: np.ndarray, v: np.ndarray, rng: np.ndarray
) -> tuple[float, int, int]:
    """Draw one step of the model.

    Args:
        model: the packed IALM.
        state: int16 [2N + 5].
        action: the robot's action.
        after: int16 [2N + 5], the next state is written here.
        v: int16 [3N + len(SCALARS)], scratch; holds the step's variables afterwards.
        rng: the random stream.

    Returns:
        (reward, outcome (0 while the episode goes on), 1 if the person is seen after the step).
    """
    n = model.dbn.order.shape[0]
    b = 3 * n
    load_state(model, state, action, v)
    motion = action
    if action != STAY and draw(model.tables, ialm.MOVED, v, rng) == 0:
        motion = STAY
    v[b + ialm.MOTION] = motion
    next_code(model.codes, v, 0, motion, v, n, rng)
    move_pose(model, v, b + ialm.SIDE, b + ialm.MID_SIDE, motion, WAIT)
    person = WAIT
    if draw(model.tables, ialm.WAITS, v, rng) == 0:
        person = draw(model.tables, ialm.INFLUENCE, v, rng)
    v[b + ialm.PERSON] = person
    move_pose(model, v, b + ialm.SIDE, b + ialm.NEXT_SIDE, motion, person)
    return finish(model, v, after, rng)


@njit(cache=True)
def finish(model: Model, v: np.ndarray, after: np.ndarray, rng: np.ndarray) -> tuple[float, int, int]:
    """Complete a step whose motions, x' and c' are in `v`: counters, y', sight, outcome, reward, next state."""
    n = model.dbn.order.shape[0]
    b = 3 * n
    v[b + ialm.THE_DISTANCE] = draw(model.tables, ialm.DISTANCE, v, rng)
    v[b + ialm.NEXT_LOST_COUNT] = draw(model.tables, ialm.NEXT_LOST, v, rng)
    v[b + ialm.IS_VISIBLE] = draw(model.tables, ialm.VISIBLE, v, rng)
    outcome = draw(model.tables, ialm.OUTCOME, v, rng)
    v[b + ialm.THE_OUTCOME] = outcome
    for i in range(n):
        after[i] = v[n + i]
    next_code(model.codes, v, 2 * n, v[b + ialm.PERSON], after, n, rng)
    for i in range(3):
        after[2 * n + i] = v[b + ialm.NEXT_SIDE + i]
    after[2 * n + 3] = draw(model.tables, ialm.NEXT_WAITING, v, rng)
    after[2 * n + 4] = v[b + ialm.NEXT_LOST_COUNT]
    reward = model.tables.estimate[locate(model.tables, ialm.REWARD, v), 0]
    return reward, outcome, v[b + ialm.IS_VISIBLE]


@njit(cache=True)
def explain_step(
    model: Model,
    state: np.ndarray,
    moves: np.ndarray,
    action: int,
    then: np.ndarray,
    seen: np.ndarray,
    after: np.ndarray,
    v: np.ndarray,
    rng: np.ndarray,
) -> float:
    """Draw the step of one particle given what was observed, and return how probable the observation was.

    All (motion, person's action) pairs are weighed and one is drawn in proportion, so that no particle is
    wasted on moves that the observation excludes.

    Args:
        model: the packed IALM.
        state: int16 [2N + 5], the particle before the step.
        moves: float64 [U], pi(u | y) of the particle.
        action: the robot's action.
        then: int16 [N], the robot's next code, observed.
        seen: int16 [3], the person's next pose (shifted), or all -1 if the person was not in view.
        after: int16 [2N + 5], the particle after the step is written here.
        v: scratch.
        rng: the random stream.

    Returns:
        P(then, seen, the episode goes on | state, action); 0 leaves `after` unspecified.
    """
    n = model.dbn.order.shape[0]
    b = 3 * n
    load_state(model, state, action, v)
    for i in range(n):
        v[n + i] = then[i]
    weights = np.zeros(8)
    total = 0.0
    moved = chance(model.tables, ialm.MOVED, v, 1) if action != STAY else 1.0
    for stays in range(2):
        motion = STAY if stays == 1 else action
        share = 1.0 - moved if stays == 1 else moved
        if share <= 0.0:
            continue
        v[b + ialm.MOTION] = motion
        share *= code_chance(model.dbn, v[:n], motion, v[n : 2 * n])
        move_pose(model, v, b + ialm.SIDE, b + ialm.MID_SIDE, motion, WAIT)
        waits = chance(model.tables, ialm.WAITS, v, 1)
        for person in range(4):
            v[b + ialm.PERSON] = person
            move_pose(model, v, b + ialm.SIDE, b + ialm.NEXT_SIDE, motion, person)
            if seen[2] >= 0 and (
                v[b + ialm.NEXT_SIDE] != seen[0]
                or v[b + ialm.NEXT_AHEAD] != seen[1]
                or v[b + ialm.NEXT_HEADING] != seen[2]
            ):
                continue
            weight = share * waits
            if person != WAIT:
                weight = share * (1.0 - waits) * moves[person]
            visible = 1 if seen[2] >= 0 else 0
            v[b + ialm.IS_VISIBLE] = visible
            weight *= chance(model.tables, ialm.VISIBLE, v, visible)
            v[b + ialm.THE_DISTANCE] = draw(model.tables, ialm.DISTANCE, v, rng)
            v[b + ialm.NEXT_LOST_COUNT] = draw(model.tables, ialm.NEXT_LOST, v, rng)
            weight *= chance(model.tables, ialm.OUTCOME, v, 0)
            weights[4 * stays + person] = weight
            total += weight
    if total <= 0.0:
        return 0.0
    number = uniform(rng) * total
    chosen = 0
    while chosen < 7 and number >= weights[chosen]:
        number -= weights[chosen]
        chosen += 1
    while weights[chosen] <= 0.0:  # rounding may carry the draw past the last possible pair
        chosen -= 1
    motion = STAY if chosen >= 4 else action
    v[b + ialm.MOTION] = motion
    v[b + ialm.PERSON] = chosen % 4
    move_pose(model, v, b + ialm.SIDE, b + ialm.MID_SIDE, motion, WAIT)
    move_pose(model, v, b + ialm.SIDE, b + ialm.NEXT_SIDE, motion, chosen % 4)
    finish(model, v, after, rng)
    return total
