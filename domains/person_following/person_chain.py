"""The person as a Markov chain of its own: what it does next depends on the robot only through waiting.

    states      0..L: k actions of the plan are done; then, at the goal, heading x pending turn
    successors  one each, but two equally likely ones where the person draws the way to turn about

The oracles need this chain, and distances and visibility from every robot pose to every state of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from domains.core import FORWARD, LEFT, RIGHT, WALL
from domains.person_following.compiled import entry
from domains.person_following.paths import (
    HEADING_ALWAYS,
    HEADING_NEVER,
    NO_PATH,
    Scratch,
    allocate_scratch,
    astar,
    distance_field,
    step_x,
    step_y,
)
from domains.person_following.variants import Parameters
from domains.person_following.views import configuration_of, look, relative

PENDING_NONE, PENDING_LEFT, PENDING_RIGHT = 0, 1, 2


class PersonChain(NamedTuple):
    """One map with its person: P states, C robot poses on free cells (numbered by `pose_index`)."""

    grid: NDArray[np.uint8]  # [size, size]
    poses: NDArray[np.int64]  # [C, 3]
    pose_index: NDArray[np.int64]  # [size, size, 4]: number of a pose, -1 in walls
    person: NDArray[np.int64]  # [P, 3]
    at_goal: NDArray[np.bool_]  # [P]
    successors: NDArray[np.int64]  # [P, 2]; both the same where the next state is certain
    route_length: int  # L: states 0..L are on the way, L + 1 + heading * 3 + pending at the goal
    distance: NDArray[np.int16]  # [P, C]: from the robot's pose to the person's, 0 where no path exists
    visible: NDArray[np.bool_]  # [P, C]
    configuration: NDArray[np.int64]  # [P, C]: of the person in the robot's view
    moves: NDArray[np.int64]  # [P, C, 4]: the robot's next pose


def person_chain(grid: NDArray[np.uint8], start: tuple[int, int, int], parameters: Parameters) -> PersonChain:
    """The chain of a person that starts somewhere on a map as played (its start cell free)."""
    size = len(grid)
    goal_x, goal_y = (int(v) for v in np.argwhere(grid == 2)[0])
    scratch = allocate_scratch(size)
    length = astar(grid[None], 0, *start, goal_x, goal_y, -1, False, scratch)
    route = scratch.path[: max(length, 0)].tolist()
    person = [start]
    for action in route:
        x, y, h = person[-1]
        if action == FORWARD:
            x, y = x + step_x(h), y + step_y(h)
        else:
            h = (h + (3 if action == LEFT else 1)) % 4
        person.append((x, y, h))
    length = len(route)
    first_turn = length + 1
    successors = [(k + 1, k + 1) for k in range(length)]
    x, y, h = person[-1]
    if (x, y) != (goal_x, goal_y):
        raise ValueError("the person cannot reach its goal on this map")
    # State L (just arrived) is the same as "at the goal, nothing pending".
    arrived = first_turn + h * 3
    successors.append((-1, -1))
    for heading in range(4):
        left, right = (heading + 3) % 4, (heading + 1) % 4
        for pending in range(3):
            person.append((goal_x, goal_y, heading))
            if pending == PENDING_NONE:
                pair = (first_turn + left * 3 + PENDING_LEFT, first_turn + right * 3 + PENDING_RIGHT)
            else:
                then = left if pending == PENDING_LEFT else right
                pair = (first_turn + then * 3, first_turn + then * 3)
            successors.append(pair)
    successors[length] = successors[arrived]
    people = np.array(person, np.int64)
    at_goal = (people[:, 0] == goal_x) & (people[:, 1] == goal_y)
    pose_index = np.full((size, size, 4), -1, np.int64)
    free = np.argwhere(grid != WALL)
    poses = np.array([(x, y, h) for x, y in free for h in range(4)], np.int64)
    pose_index[poses[:, 0], poses[:, 1], poses[:, 2]] = np.arange(len(poses))
    shape = (len(people), len(poses))
    distance = np.empty(shape, np.int16)
    configuration = np.empty(shape, np.int64)
    moves = np.empty((*shape, 4), np.int64)
    view = np.empty((1, parameters.view_size, parameters.view_size), np.uint8)
    _fill(
        grid[None],
        poses,
        pose_index,
        people,
        parameters.heading_rule,
        parameters.see_through_walls,
        view,
        distance,
        configuration,
        moves,
        scratch,
    )
    return PersonChain(
        grid,
        poses,
        pose_index,
        people,
        at_goal,
        np.array(successors, np.int64),
        length,
        distance,
        configuration > 0,
        configuration,
        moves,
    )


@entry
def _fill(  # type: ignore[no-untyped-def]
    grids, poses, pose_index, people, heading_rule, see_through, view, distance, configuration, moves, scratch
):
    grid = grids[0]
    size = grid.shape[0]
    field = np.empty(size * size * 4, np.int16)
    for c in range(poses.shape[0]):
        x, y, h = poses[c, 0], poses[c, 1], poses[c, 2]
        look(grids, 0, x, y, h, see_through, view, 0)
        for p in range(people.shape[0]):
            side, ahead, heading = relative(x, y, h, people[p, 0], people[p, 1], people[p, 2])
            configuration[p, c] = configuration_of(view, 0, side, ahead, heading, see_through)
            moves[p, c, 0] = pose_index[x, y, (h + 3) & 3]
            moves[p, c, 1] = pose_index[x, y, (h + 1) & 3]
            fx, fy = x + step_x(h), y + step_y(h)
            blocked = grid[fx, fy] == WALL or (people[p, 0] == fx and people[p, 1] == fy)
            moves[p, c, 2] = c if blocked else pose_index[fx, fy, h]
            moves[p, c, 3] = c
    for p in range(people.shape[0]):
        heading = people[p, 2]
        compare = heading_rule == HEADING_ALWAYS or (heading_rule != HEADING_NEVER and heading != 0)
        distance_field(grids, 0, people[p, 0], people[p, 1], heading, compare, -1, field, scratch)
        for c in range(poses.shape[0]):
            found = field[(poses[c, 0] * size + poses[c, 1]) * 4 + poses[c, 2]]
            distance[p, c] = 0 if found == NO_PATH else found


__all__ = ["PENDING_LEFT", "PENDING_NONE", "PENDING_RIGHT", "RIGHT", "PersonChain", "Scratch", "person_chain"]
