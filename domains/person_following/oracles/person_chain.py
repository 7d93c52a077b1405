"""The person as a Markov chain of its own: what it does next depends on the robot only through waiting.

    states      0..L: that many actions done on the way to the goal; then, if it turns about there,
                heading x pending turn
    successors  one each, but two equally likely ones where the person draws the way to turn about

The way is found by playing: the compiled rules walk the person of every world once, with nobody to wait for.
The oracles need these chains, and distances and visibility from every robot pose to every state of them.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from domains.core import STAY, WALL, DomainError
from domains.person_following.simulation.batch import Batch
from domains.person_following.simulation.compiled import entry
from domains.person_following.simulation.paths import (
    HEADING_ALWAYS,
    HEADING_NEVER,
    NO_PATH,
    allocate_scratch,
    distance_field,
    step_x,
    step_y,
)
from domains.person_following.simulation.views import configuration_of, look, relative
from domains.person_following.simulation.world import BELIEVED_X, BELIEVED_Y, GOAL_X, GOAL_Y
from domains.person_following.variants import Parameters

PENDING_NONE, PENDING_LEFT, PENDING_RIGHT = 0, 1, 2
NEVER = 1 << 30
MAX_WORLDS = 2_000


class PersonChain(NamedTuple):
    """One world, a map with its person: P states, C robot poses on free cells (numbered by `pose_index`)."""

    grid: NDArray[np.uint8]  # [size, size]: at the start
    grid_after: NDArray[np.uint8]  # [size, size]: from step `moved_at` on
    goals: NDArray[np.int64]  # [2, 2]: the person's goal, at the start and from `moved_at` on
    moved_at: int
    own: int  # number of the candidate that is the person's goal at the start
    poses: NDArray[np.int64]  # [C, 3]
    pose_index: NDArray[np.int64]  # [size, size, 4]: number of a pose, -1 in walls
    person: NDArray[np.int64]  # [P, 3]
    at_goal: NDArray[np.bool_]  # [P]
    successors: NDArray[np.int64]  # [P, 2]; both the same where the next state is certain
    route_length: int  # L: states 0..L are on the way, L + 1 + heading * 3 + pending at the goal
    distance: NDArray[np.int16]  # [P, C]: from the robot's pose to the person's, 0 where no path exists
    configuration: NDArray[np.int64]  # [P, C]: of the person in the robot's view
    moves: NDArray[np.int64]  # [P, C, 4]: the robot's next pose


def person_chains(grids: NDArray[np.uint8], parameters: Parameters) -> list[PersonChain]:
    """The chains of all worlds on raw maps [M, size, size]: for each map, one for each candidate goal.

    Raises:
        DomainError: rules under which the person is not such a chain, or too many worlds to go through.
    """
    count = len(grids) * parameters.num_goals
    if count > MAX_WORLDS:
        raise DomainError(
            f"{count:,} worlds (size {parameters.size}, {parameters.num_crossings} crossings) are too many for an "
            f"exact optimum, at most {MAX_WORLDS:,}: take a smaller instance, such as size=9, num_crossings=1 (42 maps)"
        )
    if parameters.num_persons > 1:
        raise DomainError("oracles need num_persons = 1: the others walk at random")
    if parameters.goal_moves_at and (parameters.look_back or parameters.person_rest):
        raise DomainError("oracles need look_back=False and person_rest=0 where goal_moves_at is set")
    count = parameters.num_goals
    alone = dataclasses.replace(parameters, look_back=False, person_rest=0, max_steps=1 << 20)
    batch = Batch("following", len(grids) * count, alone)
    batch.starts = batch.starts.sharing(parameters)
    batch.begin_worlds(np.repeat(grids, count, axis=0), np.tile(np.arange(count), len(grids)))
    world = batch.world
    first_grids = world.grid.copy()
    places, beliefs = [GOAL_X, GOAL_Y], [BELIEVED_X, BELIEVED_Y]
    people, goals, grids_now = [world.person[:, :3].copy()], [world.person[:, places]], [first_grids]
    # A person may pass its goal without knowing that this is the place; it arrives where it also believes so.
    informed = [(world.person[:, beliefs] == goals[0]).all(axis=1)]
    stay = np.full(batch.num_envs, STAY, np.int64)
    arrived = np.zeros(batch.num_envs, np.bool_)
    for _ in range(16 * parameters.size**2):
        arrived |= (people[-1][:, :2] == goals[-1]).all(axis=1) & informed[-1]
        if arrived.all():
            break
        batch.step(stay, False)
        people.append(world.person[:, :3].copy())
        goals.append(world.person[:, places])
        informed.append((world.person[:, beliefs] == goals[-1]).all(axis=1))
        if parameters.goal_moves_at:
            grids_now.append(world.grid.copy())
    else:
        raise DomainError("a person never reaches its goal on some map")
    chains = []
    for i in range(batch.num_envs):
        there = [bool((p[i, :2] == g[i]).all()) for p, g in zip(people, goals, strict=True)]
        arrival = next(t for t, here in enumerate(there) if here and informed[t][i])
        route = np.array([p[i] for p in people[: arrival + 1]], np.int64)
        moved = [t for t, grid in enumerate(grids_now) if (grid[i] != first_grids[i]).any()]
        after = grids_now[moved[0]][i] if moved else first_grids[i]
        ends = np.array([goals[0][i], goals[-1][i]], np.int64)
        chains.append(
            chain_of(first_grids[i], after, ends, moved[0] if moved else NEVER, i % count, route, parameters, there)
        )
    return chains


def chain_of(
    grid: NDArray[np.uint8],
    grid_after: NDArray[np.uint8],
    goals: NDArray[np.int64],
    moved_at: int,
    own: int,
    route: NDArray[np.int64],
    parameters: Parameters,
    there: list[bool] | None = None,
) -> PersonChain:
    """The chain of a person that walks a route [L + 1, 3] to its goal.

    `there` says at which steps of the route it stands where its goal is; by default at the last one only.
    """
    size, length = len(grid), len(route) - 1
    person = route.tolist()
    successors = [(k + 1, k + 1) for k in range(length)]
    x, y, h = person[-1]
    first_turn = length + 1
    if parameters.turns_at_goal:
        for heading in range(4):
            left, right = (heading + 3) % 4, (heading + 1) % 4
            for pending in range(3):
                person.append([x, y, heading])
                if pending == PENDING_NONE:
                    pair = (first_turn + left * 3 + PENDING_LEFT, first_turn + right * 3 + PENDING_RIGHT)
                else:
                    then = left if pending == PENDING_LEFT else right
                    pair = (first_turn + then * 3, first_turn + then * 3)
                successors.append(pair)
        # Just arrived is the same as being at the goal with nothing pending.
        successors.insert(length, successors[length + h * 3])
    else:
        successors.append((length, length))
    people = np.array(person, np.int64)
    pose_index = np.full((size, size, 4), -1, np.int64)
    poses = np.array([(cx, cy, ch) for cx, cy in np.argwhere(grid != WALL) for ch in range(4)], np.int64)
    pose_index[poses[:, 0], poses[:, 1], poses[:, 2]] = np.arange(len(poses))
    shape = (len(people), len(poses))
    distance = np.empty(shape, np.int16)
    configuration = np.empty(shape, np.int64)
    moves = np.empty((*shape, 4), np.int64)
    view = np.empty((1, parameters.view_size, parameters.view_size), np.uint8)
    see_through = parameters.see_through_walls
    tables = (distance, configuration, moves)
    at_goal = np.arange(len(people)) >= length
    if there is not None:
        at_goal[: length + 1] |= there[: length + 1]
    scratch = allocate_scratch(size)
    _fill(grid[None], poses, pose_index, people, parameters.heading_rule, see_through, view, *tables, scratch)
    return PersonChain(
        grid,
        grid_after,
        goals,
        moved_at,
        own,
        poses,
        pose_index,
        people,
        at_goal,
        np.array(successors, np.int64),
        length,
        *tables,
    )


def pose_views(chain: PersonChain, parameters: Parameters) -> NDArray[np.uint8]:
    """Views [2, C, v, v] of all robot poses, before and after the goal has moved."""
    width = parameters.view_size
    views = np.empty((2, len(chain.poses), width, width), np.uint8)
    grids = np.stack([chain.grid, chain.grid_after])
    for k in range(2):
        _look_around(grids, k, chain.poses, parameters.see_through_walls, views[k])
    return views


@entry
def _look_around(grids, b, poses, see_through, views):  # type: ignore[no-untyped-def]
    for c in range(poses.shape[0]):
        look(grids, b, poses[c, 0], poses[c, 1], poses[c, 2], see_through, views, c)


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
