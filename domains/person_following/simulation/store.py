"""What is worth computing once per map: person plans, distances and first actions of paths.

Environments of one size and heading rule share a store. A map enters it at its first episode, with the
person's plan; from its second episode on, distances to each person pose met are kept as rows, filled by one
breadth-first search each. Capacity is reserved, not committed: memory is touched only as far as it is used.
A map that no longer fits is simply computed again every time.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from domains.core import STAY
from domains.person_following.simulation.compiled import entry, inner
from domains.person_following.simulation.paths import (
    HEADING_ALWAYS,
    HEADING_NEVER,
    NO_PATH,
    Scratch,
    allocate_scratch,
    astar,
    distance_field,
    way_to_cell,
)

MAPS_USED, ROWS_USED = 0, 1
_EXTRA_KEY = 5  # person start x, y, heading, goal x, y
_MAX_MAPS = 1 << 16
_BYTES_FOR_MAPS = 160 << 20
_BYTES_FOR_ROWS = 128 << 20


class Store(NamedTuple):
    """Tables by map; `poses` = size * size * 4."""

    buckets: NDArray[np.int32]  # [power of two]: slot of a map by hash, -1 empty
    keys: NDArray[np.uint8]  # [maps, size * size + 5]
    plan: NDArray[np.int8]  # [maps, longest plan]
    plan_length: NDArray[np.int32]  # [maps]
    visits: NDArray[np.int32]  # [maps]: episodes begun, counted up to 2
    row_of: NDArray[np.int32]  # [maps, poses]: row of a target pose, -1 none
    distance: NDArray[np.int16]  # [rows, poses]
    first: NDArray[np.int8]  # [rows, poses]: first action of the A* path to the row's pose, -1 not yet known
    goal_first: NDArray[np.int8]  # [maps, poses]: the same towards the goal
    used: NDArray[np.int64]  # [2]: maps, rows
    heading_rule: NDArray[np.int64]  # [1]: when a path must end in the target's heading
    scratch: Scratch


def longest_plan(size: int) -> int:
    """An upper bound on the length of a shortest path: every cell once, a turn in each."""
    return 2 * (size - 2) ** 2 + 4


@cache
def shared_store(size: int, heading_rule: int) -> Store:
    """The store of all environments of this process with a size and heading rule."""
    poses = size * size * 4
    per_map = size * size + _EXTRA_KEY + longest_plan(size) + 8 + 5 * poses
    maps = min(_MAX_MAPS, _BYTES_FOR_MAPS // per_map)
    rows = _BYTES_FOR_ROWS // (3 * poses)
    num_buckets = 1 << (2 * maps - 1).bit_length()
    return Store(
        buckets=np.full(num_buckets, -1, np.int32),
        keys=np.empty((maps, size * size + _EXTRA_KEY), np.uint8),
        plan=np.empty((maps, longest_plan(size)), np.int8),
        plan_length=np.empty(maps, np.int32),
        visits=np.empty(maps, np.int32),
        row_of=np.empty((maps, poses), np.int32),
        distance=np.empty((rows, poses), np.int16),
        first=np.empty((rows, poses), np.int8),
        goal_first=np.empty((maps, poses), np.int8),
        used=np.zeros(2, np.int64),
        heading_rule=np.array([heading_rule], np.int64),
        scratch=allocate_scratch(size),
    )


@inner
def hash_of_map(grids, b):  # type: ignore[no-untyped-def]
    """A stable hash of a grid: 64-bit FNV-1a over its bytes in C order, without the sign bit."""
    value = np.uint64(0xCBF29CE484222325)
    size = grids.shape[1]
    for x in range(size):
        for y in range(size):
            value = (value ^ np.uint64(grids[b, x, y])) * np.uint64(0x100000001B3)
    return np.int64(value & np.uint64(0x7FFFFFFFFFFFFFFF))


@entry
def map_hash(grids, b):  # type: ignore[no-untyped-def]
    """`hash_of_map` for callers in Python."""
    return hash_of_map(grids, b)


@inner
def enter_map(store, grids, b, grid_hash, x, y, heading, goal_x, goal_y):  # type: ignore[no-untyped-def]
    """Slot of a map with a person's start and goal, its plan computed; -1 where the store is full."""
    size = grids.shape[1]
    extra = (np.int64(x), np.int64(y), np.int64(heading), np.int64(goal_x), np.int64(goal_y))
    mixed = np.uint64(grid_hash)
    for value in extra:
        mixed = (mixed ^ np.uint64(value)) * np.uint64(0x100000001B3)
    mask = store.buckets.shape[0] - 1
    bucket = np.int64((mixed >> np.uint64(20)) & np.uint64(mask))
    keys = store.keys
    while store.buckets[bucket] >= 0:
        slot = store.buckets[bucket]
        same = True
        for i in range(5):
            same = same and keys[slot, size * size + i] == extra[i]
        if same:
            for cx in range(size):
                for cy in range(size):
                    if keys[slot, cx * size + cy] != grids[b, cx, cy]:
                        same = False
                        break
                if not same:
                    break
        if same:
            if store.visits[slot] == 1:
                store.visits[slot] = 2
                for pose in range(store.row_of.shape[1]):
                    store.row_of[slot, pose] = -1
                    store.goal_first[slot, pose] = -1
            return slot
        bucket = (bucket + 1) & mask
    slot = store.used[MAPS_USED]
    if slot >= keys.shape[0]:
        return np.int64(-1)
    store.used[MAPS_USED] += 1
    store.buckets[bucket] = slot
    for cx in range(size):
        for cy in range(size):
            keys[slot, cx * size + cy] = grids[b, cx, cy]
    for i in range(5):
        keys[slot, size * size + i] = extra[i]
    length = max(way_to_cell(grids, b, x, y, heading, goal_x, goal_y, store.scratch), 0)
    for i in range(length):
        store.plan[slot, i] = store.scratch.path[i]
    store.plan_length[slot] = length
    store.visits[slot] = 1
    return slot


@inner
def _compared(store, heading):  # type: ignore[no-untyped-def]
    rule = store.heading_rule[0]
    return rule == HEADING_ALWAYS or (rule != HEADING_NEVER and heading != 0)


@inner
def _row(store, grids, b, slot, x, y, heading):  # type: ignore[no-untyped-def]
    """Row of the tables for a target pose on a map met before, filled if need be; -1 where there is none."""
    if slot < 0 or store.visits[slot] < 2:
        return -1
    size = grids.shape[1]
    compare = _compared(store, heading)
    target = (x * size + y) * 4 + (heading if compare else 0)
    row = store.row_of[slot, target]
    if row < 0 and store.used[ROWS_USED] < store.distance.shape[0]:
        row = np.int32(store.used[ROWS_USED])
        store.used[ROWS_USED] += 1
        distance_field(grids, b, x, y, heading, compare, np.int64(-1), store.distance[row], store.scratch)
        for pose in range(store.first.shape[1]):
            store.first[row, pose] = -1
        store.row_of[slot, target] = row
    return row


@inner
def distance(store, grids, b, slot, x, y, heading, to_x, to_y, to_heading):  # type: ignore[no-untyped-def]
    """Number of actions of a shortest path from a pose to another, by the store's heading rule; or NO_PATH."""
    pose = (x * grids.shape[1] + y) * 4 + heading
    row = _row(store, grids, b, slot, to_x, to_y, to_heading)
    if row >= 0:
        return np.int64(store.distance[row, pose])
    compare = _compared(store, to_heading)
    return np.int64(
        distance_field(grids, b, to_x, to_y, to_heading, compare, pose, store.distance[0, :0], store.scratch)
    )


@inner
def first_action(store, grids, b, slot, x, y, heading, to_x, to_y, to_heading):  # type: ignore[no-untyped-def]
    """First action of the A* path from a pose to a person's pose; STAY where there or where none exists."""
    pose = (x * grids.shape[1] + y) * 4 + heading
    row = _row(store, grids, b, slot, to_x, to_y, to_heading)
    if row >= 0 and store.first[row, pose] >= 0:
        return np.int64(store.first[row, pose])
    compare = _compared(store, to_heading)
    heuristic_heading = np.int64(-1) if store.heading_rule[0] == HEADING_NEVER else to_heading
    length = astar(grids, b, x, y, heading, to_x, to_y, heuristic_heading, compare, store.scratch)
    action = np.int64(store.scratch.path[0]) if length > 0 else np.int64(STAY)
    if row >= 0:
        store.first[row, pose] = action
    return action


@inner
def first_action_to_goal(store, grids, b, slot, x, y, heading, goal_x, goal_y):  # type: ignore[no-untyped-def]
    """First action of the A* path from a pose to the goal cell; STAY where there or where none exists."""
    pose = (x * grids.shape[1] + y) * 4 + heading
    kept = slot >= 0 and store.visits[slot] >= 2
    if kept and store.goal_first[slot, pose] >= 0:
        return np.int64(store.goal_first[slot, pose])
    length = way_to_cell(grids, b, x, y, heading, goal_x, goal_y, store.scratch)
    action = np.int64(store.scratch.path[0]) if length > 0 else np.int64(STAY)
    if kept:
        store.goal_first[slot, pose] = action
    return action


__all__ = [
    "NO_PATH",
    "Store",
    "distance",
    "enter_map",
    "first_action",
    "first_action_to_goal",
    "hash_of_map",
    "longest_plan",
    "map_hash",
    "shared_store",
]
