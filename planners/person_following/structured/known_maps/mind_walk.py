"""One simulated step of the local model of minds, for planners.search.walk."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from domains.core import STAY
from nesy.compiled import njit
from planners.person_following.structured.known_maps.ways import PackedWays, feature, moved_chance
from planners.search.random_bits import drawn, uniform
from planners.search.walk import Kernels, register

KEYS = 1 << 20
"""Keys that a code's number is multiplied by in an observation: those of the person's pose."""


class MindTree(NamedTuple):
    """The model, and what its leaves are worth, as a search needs them."""

    ways: PackedWays


class MindParticles(NamedTuple):
    """A belief: H hypotheses.

    Attributes:
        cumulative: float64 [H].
        node: int64 [H], numbers of nodes.
        station: int64 [H], the robot's.
        lost: int64 [H], the lost counter.
    """

    cumulative: np.ndarray
    node: np.ndarray
    station: np.ndarray
    lost: np.ndarray


def mind_room(model: MindTree) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A state (node, station, lost), the next one, and scratch."""
    return np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(1, np.int64)


def mind_begin(model: MindTree, belief: MindParticles, state: np.ndarray, bits: np.ndarray) -> bool:
    """Draw a hypothesis."""
    i = drawn(belief.cumulative, bits)
    state[0], state[1], state[2] = belief.node[i], belief.station[i], belief.lost[i]
    return True


def mind_advance(
    model: MindTree, state: np.ndarray, action: int, after: np.ndarray, scratch: np.ndarray, bits: np.ndarray
) -> tuple[float, bool, int, float]:
    """Draw a step: reward, whether it ended, what is seen, and V of what is reached."""
    ways = model.ways
    node, q, lost = state[0], state[1], state[2]
    if ways.successor[node, 0] < 0:  # beyond the longest episode
        after[0], after[1], after[2] = node, q, lost
        return 0.0, True, 0, 0.0
    s = ways.node[node, 0]
    then = q
    if action != STAY and uniform(bits) < moved_chance(ways, node, q, action):
        then = ways.follows[s, q, action]
    number = uniform(bits)
    m = 0
    while m < ways.successor.shape[1] - 1 and number >= ways.chance[node, m]:
        m += 1
    reached = ways.successor[node, m]
    walk, sight, at, stands, enters, ahead, same = feature(ways, node, q, then, action, reached)
    judged = ways.judgement[walk, sight, at, stands, lost, enters, ahead, same]
    ended = uniform(bits) >= judged[1]
    after[0], after[1], after[2] = reached, then, ways.next_lost[walk, lost]
    return judged[0], ended, seen_from(ways, reached, then, sight), ways.value[reached, then, after[2]]


@njit(cache=True)
def seen_from(ways: PackedWays, node: int, q: int, sight: int) -> int:
    """What a step shows, as one integer: the code, and the person's relative pose if it is in view."""
    s, p = ways.node[node, 0], ways.node[node, 2]
    hidden = 0
    if ways.node[node, 5] >= 0:
        hidden = 1 << ways.node[node, 5]
    key = 0
    if sight != 0:
        for k in range(ways.goals.shape[1]):
            if ways.goals[s, k] == ways.cell[s, p]:
                hidden |= 1 << k
        dx, dy = int(ways.pose[s, p, 0]) - ways.pose[s, q, 0], int(ways.pose[s, p, 1]) - ways.pose[s, q, 1]
        turned = (int(ways.pose[s, p, 2]) - ways.pose[s, q, 2]) & 3
        # stations that look alike have their sides alike, so offsets in the frame will do with the heading there
        key = (((dx + 64) * 128 + dy + 64) * 4 + ways.pose[s, q, 2]) * 4 + turned + 1
    return ways.shows[s, q, hidden] * KEYS + key


register(MindTree, Kernels(mind_room, mind_begin, mind_advance))
