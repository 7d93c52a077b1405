"""The ways that the person may go on the map so far, and what a robot can still earn on each.

    node    (t, p): how many steps from now, the person's pose
    V       [node, q, lost]: the value of the robot's best way from pose q if it saw the person all along

Nodes are made layer by layer from where the person may be now, and given up where fewer than `_LEAST` of the belief go
on. V goes backwards through the layers, over the poses that the robot can have reached by then and that are near enough
to the person; behind the last layer it is the learned return of what comes afterwards.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from domains.core import FORWARD, GOAL, STAY, WALL
from nesy.compiled import njit
from planners.models.tables import PackedTables, locate
from planners.person_following.motion import NUM_HEADINGS, NUM_MOVES
from planners.person_following.structured.drawn_maps.mapped_model import (
    AROUND,
    BACK,
    FRONT,
    MAX_WALK,
    REACH,
    MappedModel,
)
from planners.person_following.structured.drawn_maps.mapping import Chart, patch, walks_to, ways_on
from planners.person_following.structured.frames import FAR

_LEAST = 0.01
_RARE = 0.02
"""Moves of the person below this share of pi are left out of what is imagined."""
_MOST = 400
"""Nodes from which on no further layer is made: whoever may go anywhere is not imagined far."""
_NEAR = 6
"""Longest imagined walk to the person at which a way of the robot still counts."""


class Ground(NamedTuple):
    """A map as kernels read it; Q poses, V the width of a view.

    Attributes:
        kinds: uint8 [F, F], the map.
        filled: uint8 [F, F], with what is usual where the map knows nothing.
        follows, comes: int32 [Q, motions], where motions lead, and from where they come.
        shows: bool [Q, V * V], which cells of its view are shown at a pose, row by row from the viewer's own.
    """

    kinds: np.ndarray
    filled: np.ndarray
    follows: np.ndarray
    comes: np.ndarray
    shows: np.ndarray


class Tables(NamedTuple):
    """What kernels read of a `MappedModel`."""

    chart: Chart
    person: PackedTables
    policy: np.ndarray  # float64 [nodes, 4]
    sight: PackedTables
    moved: np.ndarray  # float64 [A, 2, 2]
    next_lost: np.ndarray  # int64 [D, L]
    judgement: np.ndarray  # float64 [D, 2, 2, L, 2, 2, 2, 2]
    afterwards: np.ndarray  # float64 [D, 2, L]
    width: int


class Layers(NamedTuple):
    """N nodes; P different poses of the person among them.

    Attributes:
        place: int64 [N], the person's pose.
        row: int64 [N], which row of `walk`.
        successor: int64 [N, 4], -1 for none: where there is none at all, the node is not followed any further.
        chance: float64 [N, 4], cumulative.
        begin: int64 [T + 1], the first node of each layer, and N; T is the horizon + 1, or less.
        walk: uint8 [P, Q], least number of actions from each pose of the robot.
        value: float32 [N, Q, L].
    """

    place: np.ndarray
    row: np.ndarray
    successor: np.ndarray
    chance: np.ndarray
    begin: np.ndarray
    walk: np.ndarray
    value: np.ndarray


def tables_of(model: MappedModel, informed: bool = False) -> Tables:
    """What kernels read; `informed`: with pi on maps of what both have seen."""
    person, policy = model.policy(informed)
    return Tables(
        model.chart,
        person,
        policy,
        model.sight,
        model.moved_chance,
        model.lost_after,
        model.judgement,
        model.afterwards,
        model.view_size,
    )


def ground_of(tables: Tables, kinds: np.ndarray) -> Ground:
    """A map made ready for kernels."""
    filled = tables.chart.filled(kinds)
    follows, comes = ways_on(tables.chart, filled)
    return Ground(kinds, filled, follows, comes, shown_from(tables.chart, filled, tables.sight, tables.width))


@njit(cache=True)
def shown_from(chart: Chart, filled: np.ndarray, sight: PackedTables, width: int) -> np.ndarray:
    """Which cells of its view each pose shows: bool [Q, V * V]; none where a wall stands."""
    size = filled.shape[0]
    out = np.zeros((size * size * NUM_HEADINGS, width * width), np.bool_)
    around = np.zeros(width * width, np.int32)
    for q in range(out.shape[0]):
        if filled[q // NUM_HEADINGS // size, q // NUM_HEADINGS % size] == WALL:
            continue
        walls_in_view(chart, filled, q, width, around)
        for i in range(width * width):
            out[q, i] = sight.estimate[locate(sight, i, around), 0] < 0.5
    return out


@njit(cache=True)
def walls_in_view(chart: Chart, filled: np.ndarray, number: int, width: int, out: np.ndarray) -> None:
    """Which cells of the view from a pose are wall: 0 or 1 [V * V]; outside the map is wall."""
    patch(chart, filled, number, width // 2, 0, width - 1, WALL, out)
    for i in range(out.shape[0]):
        out[i] = 1 if out[i] == WALL else 0


@njit(cache=True)
def in_sight(chart: Chart, shows: np.ndarray, size: int, width: int, robot: int, other: int) -> bool:
    """Whether a robot at a pose sees whoever is at another."""
    here, there, h = robot // NUM_HEADINGS, other // NUM_HEADINGS, robot % NUM_HEADINGS
    x, y = there // size - here // size, there % size - here % size
    s = x * chart.side[h, 0] + y * chart.side[h, 1]
    f = x * chart.ahead[h, 0] + y * chart.ahead[h, 1]
    if here == there or f < 0 or f >= width or s < -(width // 2) or s > width // 2:
        return False
    return bool(shows[robot, f * width + s + width // 2])


@njit(cache=True)
def expected_move(tables: Tables, kinds: np.ndarray, number: int, seen_from: int, variables: np.ndarray) -> int:
    """The row of pi for a person at a pose; it is taken to see what lies around `seen_from`, mostly that pose."""
    patch(tables.chart, kinds, seen_from, REACH, BACK, FRONT, WALL, variables)
    size = kinds.shape[0]
    variables[AROUND] = number // NUM_HEADINGS // size
    variables[AROUND + 1] = number // NUM_HEADINGS % size
    variables[AROUND + 2] = number % NUM_HEADINGS
    return locate(tables.person, 0, variables)


@njit(cache=True)
def features(
    filled: np.ndarray, follows: np.ndarray, walk: np.ndarray, q: int, then: int, action: int, person: int
) -> tuple[int, int, int, int, int]:
    """What a step is judged by but for sight and the lost counter: walk, at goal, enters, ahead, same place.

    `walk` uint8 [Q] leads to the person's pose after the step; the robot was at q and is at `then`.
    """
    size = filled.shape[0]
    cell, person_cell = then // NUM_HEADINGS, person // NUM_HEADINGS
    at_goal = 1 if filled[person_cell // size, person_cell % size] == GOAL else 0
    enters = 1 if action == FORWARD and then != q and filled[cell // size, cell % size] == GOAL else 0
    faced = follows[then, FORWARD]
    ahead = 1 if action == FORWARD and faced != then and faced // NUM_HEADINGS == person_cell else 0
    return min(int(walk[then]), MAX_WALK), at_goal, enters, ahead, 1 if cell == person_cell else 0


@njit(cache=True)
def moves(tables: Tables, ground: Ground, q: int, action: int, person: int) -> float:
    """How probably an action moves the robot from pose q, with the person at a pose."""
    if action == STAY:
        return 0.0
    faced = ground.follows[q, FORWARD]
    wall = 1 if action == FORWARD and faced == q else 0
    blocked = 1 if faced != q and faced // NUM_HEADINGS == person // NUM_HEADINGS else 0
    return tables.moved[action, wall, blocked]


@njit(cache=True)
def reachable(ground: Ground, start: int, most: int) -> np.ndarray:
    """In how many actions the robot can be at each pose: uint8 [Q], FAR beyond `most`."""
    out = np.full(ground.follows.shape[0], FAR, np.uint8)
    queue = np.zeros(ground.follows.shape[0], np.int64)
    out[start], queue[0] = 0, start
    head, tail = 0, 1
    while head < tail:
        q = queue[head]
        head += 1
        if out[q] >= most:
            break
        for m in range(FORWARD + 1):
            then = ground.follows[q, m]
            if out[then] == FAR:
                out[then] = out[q] + 1
                queue[tail] = then
                tail += 1
    return out


@njit(cache=True)
def unroll(
    tables: Tables, ground: Ground, chances: np.ndarray, people: np.ndarray, weights: np.ndarray, horizon: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The nodes of all layers from persons at poses [n] with probabilities [n]: place, successor, chance, begin.

    `chances` float64 [Q, 4] is P(u | p).
    """
    count = ground.follows.shape[0]
    most = people.shape[0] + horizon * min(count, int(1.0 / _LEAST) * NUM_MOVES)
    place, mass = np.zeros(most, np.int64), np.zeros(most)
    successor = np.full((most, NUM_MOVES), -1, np.int64)
    chance = np.ones((most, NUM_MOVES))
    begin = np.zeros(horizon + 2, np.int64)
    known = np.full(count, -1, np.int64)
    for i in range(people.shape[0]):
        place[i], mass[i] = people[i], weights[i]
    first, end = 0, people.shape[0]
    for t in range(horizon):
        begin[t] = first
        if t > 1 and end > _MOST:
            begin[t + 1] = end
            return place[:end], successor[:end], chance[:end], begin[: t + 2]
        size = end
        for i in range(first, end):
            if mass[i] < _LEAST:
                continue
            p, total, m = place[i], 0.0, 0
            for u in range(NUM_MOVES):
                if chances[p, u] >= _RARE:
                    total += chances[p, u]
            share = 0.0
            for u in range(NUM_MOVES):
                if chances[p, u] < _RARE:
                    continue
                then = ground.follows[p, u] if u != STAY else p
                if known[then] < 0:
                    known[then] = size
                    place[size] = then
                    size += 1
                successor[i, m] = known[then]
                mass[known[then]] += mass[i] * chances[p, u] / total
                share += chances[p, u] / total
                chance[i, m] = share
                m += 1
            chance[i, m - 1] = 1.0
        for i in range(end, size):
            known[place[i]] = -1
        first, end = end, size
    begin[horizon] = first
    begin[horizon + 1] = end
    return place[:end], successor[:end], chance[:end], begin


@njit(cache=True)
def layers_of(
    tables: Tables,
    ground: Ground,
    chances: np.ndarray,
    people: np.ndarray,
    weights: np.ndarray,
    robot: int,
    horizon: int,
    discount: float,
) -> Layers:
    """All that may follow, with values: arguments as in `unroll`, and the robot's pose."""
    place, successor, chance, begin = unroll(tables, ground, chances, people, weights, horizon)
    poses, lost = ground.follows.shape[0], tables.next_lost.shape[1]
    row, index = np.zeros(place.shape[0], np.int64), np.full(poses, -1, np.int64)
    different = 0
    for i in range(place.shape[0]):
        if index[place[i]] < 0:
            index[place[i]] = different
            different += 1
        row[i] = index[place[i]]
    walk, queue = np.zeros((different, poses), np.uint8), np.zeros(poses, np.int64)
    for p in range(poses):
        if index[p] >= 0:
            walks_to(ground.comes, p, MAX_WALK, walk[index[p]], queue)
    value = np.zeros((place.shape[0], poses, lost), np.float32)
    layers = Layers(place, row, successor, chance, begin, walk, value)
    _fill(tables, ground, layers, reachable(ground, robot, horizon), discount)
    return layers


@njit(cache=True)
def _fill(tables: Tables, ground: Ground, layers: Layers, soonest: np.ndarray, discount: float) -> None:
    """V, from the last layer back to the first."""
    lost = tables.next_lost.shape[1]
    best, here = np.zeros(lost), np.zeros(lost)
    size = ground.filled.shape[0]
    for t in range(layers.begin.shape[0] - 2, -1, -1):
        for i in range(layers.begin[t], layers.begin[t + 1]):
            p, walk = layers.place[i], layers.walk[layers.row[i]]
            for q in range(soonest.shape[0]):
                if soonest[q] > t or walk[q] > _NEAR:
                    continue
                if layers.successor[i, 0] < 0:
                    sight = 1 if in_sight(tables.chart, ground.shows, size, tables.width, q, p) else 0
                    for k in range(lost):
                        layers.value[i, q, k] = tables.afterwards[min(int(walk[q]), MAX_WALK), sight, k]
                    continue
                for a in range(NUM_MOVES):
                    here[:] = 0.0
                    moved = moves(tables, ground, q, a, p)
                    _earn(tables, ground, layers, i, q, ground.follows[q, a], a, moved, discount, here)
                    _earn(tables, ground, layers, i, q, q, a, 1.0 - moved, discount, here)
                    for k in range(lost):
                        best[k] = here[k] if a == 0 else max(best[k], here[k])
                for k in range(lost):
                    layers.value[i, q, k] = best[k]


@njit(cache=True)
def _earn(
    tables: Tables,
    ground: Ground,
    layers: Layers,
    i: int,
    q: int,
    then: int,
    action: int,
    share: float,
    discount: float,
    out: np.ndarray,
) -> None:
    """Add to out [L] what a step from node i brings that leaves the robot at `then`, times `share`."""
    if share < 0.01:
        return
    below = 0.0
    for m in range(NUM_MOVES):
        after = layers.successor[i, m]
        if after < 0:
            break
        weight = share * (layers.chance[i, m] - below)
        below = layers.chance[i, m]
        p, to_person = layers.place[after], layers.walk[layers.row[after]]
        walk, at, enters, ahead, same = features(ground.filled, ground.follows, to_person, q, then, action, p)
        sight = 1 if in_sight(tables.chart, ground.shows, ground.filled.shape[0], tables.width, then, p) else 0
        for k in range(out.shape[0]):
            reward = tables.judgement[walk, sight, at, k, enters, ahead, same, 0]
            goes_on = tables.judgement[walk, sight, at, k, enters, ahead, same, 1]
            later = layers.value[after, then, tables.next_lost[walk, k]]
            out[k] += weight * (reward + discount * goes_on * later)
