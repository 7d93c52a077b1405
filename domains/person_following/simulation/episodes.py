"""Beginning episodes: the map, the candidate goals, where everybody starts."""

from __future__ import annotations

import numpy as np

from domains.core import EMPTY, GOAL, WALL
from domains.person_following.simulation.compiled import entry, inner
from domains.person_following.simulation.map_generation import draw_crossing
from domains.person_following.simulation.people import plan_route
from domains.person_following.simulation.random_numbers import draw_below
from domains.person_following.simulation.rules import measure
from domains.person_following.simulation.store import enter_map, hash_of_map
from domains.person_following.simulation.views import configuration_of, look, relative
from domains.person_following.simulation.world import (
    AT_GOAL,
    BELIEVED_X,
    BELIEVED_Y,
    EPISODE,
    GOAL_X,
    GOAL_Y,
    HEADING,
    LAST_ACTION,
    LOST,
    MOVES,
    OWN,
    PLAN_AT,
    PLAN_LENGTH,
    SLOT,
    TIME,
    WAITING,
    X,
    Y,
)
from domains.person_following.variants import (
    DRAWN,
    GENERATED,
    R_FOLLOWING,
    R_KEEP_WAITING,
    R_MAP_SOURCE,
    R_NUM_CROSSINGS,
    R_NUM_GOALS,
    R_SEE_THROUGH,
)

NO_ACTION = -1


@entry
def choose_batch(rules, world, maps, chosen):  # type: ignore[no-untyped-def]
    """Put the maps of the next episodes into the grids where `chosen` [B]."""
    grid, robot = world.grid, world.robot
    source = rules[R_MAP_SOURCE]
    for b in range(chosen.shape[0]):
        if not chosen[b]:
            continue
        if source == GENERATED:
            draw_crossing(world.stream, grid, b, rules[R_NUM_CROSSINGS])
        else:
            if source == DRAWN:
                m = draw_below(world.stream, b, maps.shape[0])
            else:
                m = (b + robot[b, EPISODE] * grid.shape[0]) % maps.shape[0]
            for x in range(maps.shape[1]):
                for y in range(maps.shape[2]):
                    grid[b, x, y] = maps[m, x, y]
        robot[b, EPISODE] += 1


@entry
def place_goals(rules, world, store, chosen, starts):  # type: ignore[no-untyped-def]
    """List the candidate goals of the maps where `chosen` [B], persons at `starts` [B, 2].

    Where a map has too few, the reachable free cells farthest off are added: each is the one whose distance, in
    cells, to the start and to all candidates so far is greatest; the first in map order among equals. So a map has
    always the same candidates.
    """
    for b in range(chosen.shape[0]):
        if chosen[b]:
            world.grid[b, starts[b, 0], starts[b, 1]] = EMPTY
            _list_goals(world, b)
            _add_goals(rules, world, store, b, starts[b, 0], starts[b, 1])


@inner
def _list_goals(world, b):  # type: ignore[no-untyped-def]
    """List the goal cells of map b in map order; unused places hold (0, 0)."""
    grid, goals = world.grid, world.goals
    size = grid.shape[1]
    for k in range(goals.shape[1]):
        goals[b, k, 0], goals[b, k, 1] = 0, 0
    count = 0
    for x in range(size):
        for y in range(size):
            if grid[b, x, y] == GOAL and count < goals.shape[1]:
                goals[b, count, 0], goals[b, count, 1] = x, y
                count += 1


@inner
def _count_goals(world, b):  # type: ignore[no-untyped-def]
    count = 0
    while count < world.goals.shape[1] and world.goals[b, count, 0] > 0:
        count += 1
    return count


@inner
def _add_goals(rules, world, store, b, start_x, start_y):  # type: ignore[no-untyped-def]
    grid, goals = world.grid, world.goals
    size = grid.shape[1]
    count = _count_goals(world, b)
    if count >= rules[R_NUM_GOALS]:
        return
    # `cost` gathers the distance of each cell to the nearest of start and candidates.
    cost, queue, field = store.scratch.cost, store.scratch.heap, store.scratch.came_from
    cells = size * size
    for cell in range(cells):
        cost[cell] = 1 << 20
    source = 0
    while True:
        x, y = (start_x, start_y) if source == 0 else (goals[b, source - 1, 0], goals[b, source - 1, 1])
        for cell in range(cells):
            field[cell] = 1 << 20
        queue[0] = x * size + y
        field[x * size + y] = 0
        begin, end = 0, 1
        while begin < end:
            cell = queue[begin]
            begin += 1
            for step in range(4):
                cx, cy = cell // size, cell % size
                if step == 0:
                    cx += 1
                elif step == 1:
                    cx -= 1
                elif step == 2:
                    cy += 1
                else:
                    cy -= 1
                following = cx * size + cy
                if grid[b, cx, cy] != WALL and field[following] == 1 << 20:
                    field[following] = field[cell] + 1
                    queue[end] = following
                    end += 1
        best, chosen = -1, -1
        for cell in range(cells):
            cost[cell] = min(cost[cell], field[cell])
            if cost[cell] < 1 << 20 and cost[cell] > best and grid[b, cell // size, cell % size] == EMPTY:
                best, chosen = cost[cell], cell
        if source == count:
            if count >= rules[R_NUM_GOALS] or chosen < 0:
                return
            goals[b, count, 0], goals[b, count, 1] = chosen // size, chosen % size
            grid[b, chosen // size, chosen % size] = GOAL
            count += 1
        source += 1


@inner
def _begin(rules, world, store, b, x, y, own):  # type: ignore[no-untyped-def]
    """Start an episode of environment b on the map in its grid, the person at (x, y)."""
    grid, robot, person, plan = world.grid, world.robot, world.person, world.plan
    robot[b, X], robot[b, Y], robot[b, HEADING] = 1, 1, 0
    robot[b, LOST], robot[b, TIME], robot[b, AT_GOAL] = 0, 0, 0
    person[b, LAST_ACTION] = NO_ACTION
    if not rules[R_KEEP_WAITING]:
        person[b, WAITING] = 0
    person[b, X], person[b, Y], person[b, HEADING] = x, y, 0
    if rules[R_FOLLOWING]:
        # The person replaces whatever stood on its cell, and leaves it empty.
        grid[b, x, y] = EMPTY
    if rules[R_NUM_GOALS] == 1:
        _list_goals(world, b)
    if own < 0:
        own = draw_below(world.stream, b, _count_goals(world, b))
    person[b, OWN], person[b, MOVES] = own, 0
    goal_x, goal_y = world.goals[b, own, 0], world.goals[b, own, 1]
    person[b, GOAL_X], person[b, GOAL_Y] = goal_x, goal_y
    person[b, BELIEVED_X], person[b, BELIEVED_Y] = goal_x, goal_y
    world.map_id[b] = hash_of_map(grid, b)
    slot = enter_map(store, grid, b, world.map_id[b], x, y, np.int64(0), goal_x, goal_y)
    robot[b, SLOT] = slot
    person[b, PLAN_AT], person[b, PLAN_LENGTH] = 0, 0
    if not rules[R_FOLLOWING]:
        return
    if slot >= 0:
        person[b, PLAN_LENGTH] = store.plan_length[slot]
        for i in range(store.plan_length[slot]):
            plan[b, i] = store.plan[slot, i]
    else:
        plan_route(rules, world, store, b)


@entry
def begin_batch(rules, world, store, chosen, starts, own, out, gaps):  # type: ignore[no-untyped-def]
    """Begin episodes where `chosen` [B], persons at `starts` [B, 2], on the maps that lie in the grids.

    `own` [B] says which candidate is the person's goal; where it is negative, that is drawn. Where there are several
    candidates, `place_goals` comes first. `gaps` [B] gets the distances of all; [0] where they are not wanted.
    """
    grid, robot, person = world.grid, world.robot, world.person
    see_through = rules[R_SEE_THROUGH] != 0
    views, configurations = out.robot_view, out.configuration
    for b in range(chosen.shape[0]):
        if not chosen[b]:
            continue
        _begin(rules, world, store, b, starts[b, 0], starts[b, 1], own[b])
        look(grid, b, robot[b, X], robot[b, Y], robot[b, HEADING], see_through, views, b)
        configurations[b] = 0
        if rules[R_FOLLOWING]:
            side, ahead, heading = relative(1, 1, 0, person[b, X], person[b, Y], person[b, HEADING])
            configurations[b] = configuration_of(views, b, side, ahead, heading, see_through)
    if gaps.shape[0] > 0 and rules[R_FOLLOWING]:
        measure(store, grid, robot, person, gaps)
