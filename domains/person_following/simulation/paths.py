"""Shortest paths over poses: the A* whose tie-breaking decides the person's path, and distances.

A pose is (x, y, heading), numbered `(x * size + y) * 4 + heading`. Turning left, turning right and stepping
forward cost 1 each; walls block. The A* heuristic is consistent (a step changes it by at most 1), also where
the final heading is not compared but still enters the heuristic, and headings at equal cells differ in parity
exactly as path lengths do; so the length of the A* path is the breadth-first distance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from domains.core import WALL
from domains.person_following.simulation.compiled import entry, inner

HEADING_NEVER, HEADING_ALWAYS, HEADING_UNLESS_0 = 0, 1, 2
"""When a path must end in the target's heading; the last is the quirk of the `paper` variant."""

NO_PATH = -1


class Scratch(NamedTuple):
    """Working memory of the searches, for one map size; stamped, so that nothing needs clearing."""

    stamp: NDArray[np.int64]  # [poses + 1]: the search that last touched a pose; the last entry counts searches
    cost: NDArray[np.int32]  # [poses]
    came_from: NDArray[np.int32]  # [poses]: predecessor * 4 + action
    heap: NDArray[np.int64]  # [4 * poses]
    path: NDArray[np.int8]  # [poses]: actions of the path found last


def allocate_scratch(size: int) -> Scratch:
    """Working memory for maps of a size."""
    poses = size * size * 4
    return Scratch(
        np.zeros(poses + 1, np.int64),
        np.empty(poses, np.int32),
        np.empty(poses, np.int32),
        np.empty(4 * poses + 8, np.int64),
        np.empty(poses, np.int8),
    )


STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Change of (x, y) by one step forward, by heading."""


@inner
def step_x(heading):  # type: ignore[no-untyped-def]
    """Change of x by one step forward."""
    return 1 if heading == 0 else (-1 if heading == 2 else 0)


@inner
def step_y(heading):  # type: ignore[no-untyped-def]
    """Change of y by one step forward."""
    return 1 if heading == 1 else (-1 if heading == 3 else 0)


@inner
def _push(heap, count, key):  # type: ignore[no-untyped-def]
    position = count
    while position > 0:
        parent = (position - 1) >> 1
        if heap[parent] <= key:
            break
        heap[position] = heap[parent]
        position = parent
    heap[position] = key
    return count + 1


@inner
def _pop(heap, count):  # type: ignore[no-untyped-def]
    top = heap[0]
    count -= 1
    if count > 0:
        key = heap[count]
        position = 0
        while True:
            child = 2 * position + 1
            if child >= count:
                break
            if child + 1 < count and heap[child + 1] < heap[child]:
                child += 1
            if key <= heap[child]:
                break
            heap[position] = heap[child]
            position = child
        heap[position] = key
    return top, count


@inner
def astar(grids, b, x, y, heading, goal_x, goal_y, goal_heading, compare, scratch):  # type: ignore[no-untyped-def]
    """A* from a pose to a cell; the actions go to `scratch.path`.

    Args:
        grids: cell kinds [B, size, size].
        b: which of them.
        x: of the start.
        y: of the start.
        heading: of the start.
        goal_x: of the target cell.
        goal_y: of the target cell.
        goal_heading: heading that enters the heuristic; -1 for none.
        compare: whether the path must end in `goal_heading`.
        scratch: working memory for this size.

    Returns:
        The number of actions; NO_PATH where there is none.
    """
    size = grids.shape[1]
    stamp, cost, came_from, heap, path = scratch
    last = stamp.shape[0] - 1
    stamp[last] += 1
    search = stamp[last]
    start = (x * size + y) * 4 + heading
    stamp[start] = search
    cost[start] = 0
    came_from[start] = -1
    # Priorities are doubled, so that half steps of the heuristic stay whole; a key orders by
    # (priority, x, y, heading), which is the order in which the original's heap compares its entries.
    count = _push(heap, np.int64(0), np.int64(((0 * 64 + x) * 64 + y) * 4 + heading))
    while count > 0:
        key, count = _pop(heap, count)
        h = key & 3
        cy = (key >> 2) & 63
        cx = (key >> 8) & 63
        if cx == goal_x and cy == goal_y and (not compare or h == goal_heading):
            node = (cx * size + cy) * 4 + h
            length = cost[node]
            for i in range(length - 1, -1, -1):
                path[i] = came_from[node] & 3
                node = came_from[node] >> 2
            return length
        node = (cx * size + cy) * 4 + h
        next_cost = cost[node] + 1
        for action in range(3):
            nx, ny, nh = cx, cy, h
            if action == 0:
                nh = (h + 3) & 3
            elif action == 1:
                nh = (h + 1) & 3
            else:
                nx += step_x(h)
                ny += step_y(h)
                if nx < 0 or ny < 0 or nx >= size or ny >= size or grids[b, nx, ny] == WALL:
                    continue
            following = (nx * size + ny) * 4 + nh
            if stamp[following] == search and next_cost >= cost[following]:
                continue
            stamp[following] = search
            cost[following] = next_cost
            came_from[following] = node * 4 + action
            priority = 2 * (next_cost + abs(nx - goal_x) + abs(ny - goal_y))
            if goal_heading >= 0:
                turn = (nh - goal_heading) & 3
                priority += min(turn, 4 - turn)
            count = _push(heap, count, np.int64(((priority * 64 + nx) * 64 + ny) * 4 + nh))
    return NO_PATH


@inner
def way_to_cell(grids, b, x, y, heading, goal_x, goal_y, scratch):  # type: ignore[no-untyped-def]
    """`astar` to a cell, in whatever heading; returns the number of actions."""
    return astar(grids, b, x, y, heading, goal_x, goal_y, np.int64(-1), np.bool_(False), scratch)


@entry
def find_path(grids, b, x, y, heading, goal_x, goal_y, goal_heading, compare, scratch):  # type: ignore[no-untyped-def]
    """`astar` for callers in Python."""
    return astar(grids, b, x, y, heading, goal_x, goal_y, goal_heading, compare, scratch)


@inner
def distance_field(grids, b, x, y, heading, compare, until, distances, scratch):  # type: ignore[no-untyped-def]
    """Breadth-first distances TO a pose, backward from it.

    Args:
        grids: cell kinds [B, size, size].
        b: which of them.
        x: of the target pose.
        y: of the target pose.
        heading: of the target pose.
        compare: whether the final heading must be the target's.
        until: stop as soon as this pose is reached; -1 to reach all.
        distances: int16 [poses] to fill with distances (NO_PATH where none), or an empty array.
        scratch: working memory for this size.

    Returns:
        The distance of `until`, NO_PATH where there is none.
    """
    size = grids.shape[1]
    stamp, cost, queue = scratch.stamp, scratch.cost, scratch.heap
    last = stamp.shape[0] - 1
    stamp[last] += 1
    search = stamp[last]
    fill = distances.shape[0] > 0
    if fill:
        for node in range(last):
            distances[node] = NO_PATH
    end = 0
    for h in range(4):
        if h == heading or not compare:
            node = (x * size + y) * 4 + h
            stamp[node] = search
            cost[node] = 0
            queue[end] = node
            end += 1
    begin = 0
    while begin < end:
        node = queue[begin]
        begin += 1
        reached = cost[node]
        if fill:
            distances[node] = reached
        if node == until:
            return reached
        h = node & 3
        cx = (node >> 2) // size
        cy = (node >> 2) - cx * size
        for way in range(3):
            if way == 0:
                before = (node & ~3) | ((h + 1) & 3)
            elif way == 1:
                before = (node & ~3) | ((h + 3) & 3)
            else:
                bx = cx - step_x(h)
                by = cy - step_y(h)
                if bx < 0 or by < 0 or bx >= size or by >= size or grids[b, bx, by] == WALL:
                    continue
                before = (bx * size + by) * 4 + h
            if stamp[before] != search:
                stamp[before] = search
                cost[before] = reached + 1
                queue[end] = before
                end += 1
    return NO_PATH
