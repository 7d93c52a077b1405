"""Crossing maps: rivers of wall with openings, equal to Minigrid's `CrossingEnv` for the same stream."""

from __future__ import annotations

import numpy as np

from domains.core import EMPTY, GOAL, WALL
from domains.person_following.simulation.compiled import entry, inner
from domains.person_following.simulation.random_numbers import draw_below, shuffle

MAX_SIZE = 31
_MAX_RIVERS = MAX_SIZE


@inner
def draw_crossing(streams, grids, b, num_crossings):  # type: ignore[no-untyped-def]
    """Fill `grids[b]` with a new crossing map; the goal is at (size-2, size-2).

    The order of the draws is Minigrid's: shuffle the rivers (vertical ones first), shuffle the directions of
    the path from room to room, then one opening per step of that path.
    """
    size = grids.shape[1]
    last = size - 1
    for x in range(size):
        for y in range(size):
            border = x == 0 or y == 0 or x == last or y == last
            grids[b, x, y] = WALL if border else EMPTY
    grids[b, size - 2, size - 2] = GOAL

    per_direction = (size - 3) // 2
    rivers = np.empty(_MAX_RIVERS, np.int64)
    for i in range(per_direction):
        rivers[i] = 2 + 2 * i
        rivers[per_direction + i] = -(2 + 2 * i)
    shuffle(streams, b, rivers, 2 * per_direction)

    # Coordinates at which a river stands; limits between rooms follow from walking over them in order.
    vertical = np.zeros(MAX_SIZE + 1, np.bool_)
    horizontal = np.zeros(MAX_SIZE + 1, np.bool_)
    num_vertical = 0
    for k in range(num_crossings):
        if rivers[k] > 0:
            vertical[rivers[k]] = True
            num_vertical += 1
        else:
            horizontal[-rivers[k]] = True
    for k in range(1, last):
        for m in range(1, last):
            if vertical[k] or horizontal[m]:
                grids[b, k, m] = WALL

    # 1: a step through a vertical river, to the next room on the right.
    path = np.zeros(_MAX_RIVERS, np.int64)
    for k in range(num_vertical):
        path[k] = 1
    shuffle(streams, b, path, num_crossings)
    left, top = 0, 0
    for k in range(num_crossings):
        right, bottom = left + 1, top + 1
        while right < last and not vertical[right]:
            right += 1
        while bottom < last and not horizontal[bottom]:
            bottom += 1
        if path[k]:
            grids[b, right, top + 1 + draw_below(streams, b, bottom - top - 1)] = EMPTY
            left = right
        else:
            grids[b, left + 1 + draw_below(streams, b, right - left - 1), bottom] = EMPTY
            top = bottom


@entry
def generate_crossing(streams, grids, b, num_crossings):  # type: ignore[no-untyped-def]
    """`draw_crossing` for callers in Python."""
    draw_crossing(streams, grids, b, num_crossings)
