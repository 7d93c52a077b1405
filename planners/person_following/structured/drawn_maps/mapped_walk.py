"""One simulated step over the ways of mapped_ways, for walk."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planners.person_following.motion import NUM_MOVES
from planners.person_following.structured.drawn_maps.mapped_ways import (
    Ground,
    Layers,
    Tables,
    features,
    in_sight,
    moves,
)
from planners.search.random_bits import drawn, uniform
from planners.search.walk import Kernels, register


class MappedTree(NamedTuple):
    """The model, the map, and the ways on it with what they are worth."""

    tables: Tables
    ground: Ground
    layers: Layers


class MappedParticles(NamedTuple):
    """A belief: H hypotheses.

    Attributes:
        cumulative: float64 [H].
        node: int64 [H], nodes of the first layer.
        lost: int64 [H], the lost counter.
        robot: the robot's pose.
    """

    cumulative: np.ndarray
    node: np.ndarray
    lost: np.ndarray
    robot: int


def mapped_room(model: MappedTree) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A state (node, robot's pose, lost), the next one, and scratch."""
    return np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(1, np.int64)


def mapped_begin(model: MappedTree, belief: MappedParticles, state: np.ndarray, bits: np.ndarray) -> bool:
    """Draw a hypothesis."""
    i = drawn(belief.cumulative, bits)
    state[0], state[1], state[2] = belief.node[i], belief.robot, belief.lost[i]
    return True


def mapped_advance(
    model: MappedTree, state: np.ndarray, action: int, after: np.ndarray, scratch: np.ndarray, bits: np.ndarray
) -> tuple[float, bool, int, float]:
    """Draw a step: reward, whether it ended, the person's pose if it is in view, and V of what is reached."""
    tables, ground, layers = model.tables, model.ground, model.layers
    node, q, lost = state[0], state[1], state[2]
    if layers.successor[node, 0] < 0:  # not followed any further
        after[0], after[1], after[2] = node, q, lost
        return layers.value[node, q, lost], True, 0, 0.0
    then = q
    if uniform(bits) < moves(tables, ground, q, action, layers.place[node]):
        then = ground.follows[q, action]
    number = uniform(bits)
    m = 0
    while m < NUM_MOVES - 1 and number >= layers.chance[node, m]:
        m += 1
    reached = layers.successor[node, m]
    person, size = layers.place[reached], ground.filled.shape[0]
    walk, at, enters, ahead, same = features(
        ground.filled, ground.follows, layers.walk[layers.row[reached]], q, then, action, person
    )
    sight = 1 if in_sight(tables.chart, ground.shows, size, tables.width, then, person) else 0
    reward = tables.judgement[walk, sight, at, lost, enters, ahead, same, 0]
    ended = uniform(bits) >= tables.judgement[walk, sight, at, lost, enters, ahead, same, 1]
    after[0], after[1], after[2] = reached, then, tables.next_lost[walk, lost]
    seen = then * ground.follows.shape[0] + person if sight else -1 - then
    return reward, ended, seen, layers.value[reached, then, after[2]]


register(MappedTree, Kernels(mapped_room, mapped_begin, mapped_advance))
