"""What the persons do: plans, what they see and believe, moves; and the others who only stand in the way.

The first person follows an open-loop plan to where it BELIEVES its goal to be. It makes a new one where its view
shows a wall on the plan, and where its view shows that the goal is not there. Minds, moving goals and other persons
are kernels of their own, which are compiled only where the rules ask for them.
"""

from __future__ import annotations

import numpy as np

from domains.core import EMPTY, FORWARD, GOAL, LEFT, RIGHT, STAY, UNSEEN, WALL
from domains.person_following.simulation.compiled import entry, inner
from domains.person_following.simulation.paths import step_x, step_y, way_to_cell
from domains.person_following.simulation.random_numbers import draw_below
from domains.person_following.simulation.views import look
from domains.person_following.simulation.world import (
    BELIEVED_X,
    BELIEVED_Y,
    GOAL_X,
    GOAL_Y,
    HEADING,
    LAST_ACTION,
    MOVES,
    PLAN_AT,
    PLAN_LENGTH,
    TIME,
    WAITING,
    X,
    Y,
)
from domains.person_following.variants import (
    R_FOLLOW_DISTANCE,
    R_GOAL_MOVES_AT,
    R_LOOK_BACK,
    R_NUM_GOALS,
    R_PERSON_REST,
    R_PERSON_SEES_ONLY,
    R_SEE_THROUGH,
    R_TURNS_AT_GOAL,
)


@inner
def plan_route(rules, world, store, b):  # type: ignore[no-untyped-def]
    """Make person b a new plan to where it believes its goal to be; none where it is there, or sees no way."""
    person, plan = world.person, world.plan
    x, y, heading = person[b, X], person[b, Y], person[b, HEADING]
    goal_x, goal_y = person[b, BELIEVED_X], person[b, BELIEVED_Y]
    grids = world.known if rules[R_PERSON_SEES_ONLY] else world.grid
    length = max(way_to_cell(grids, b, x, y, heading, goal_x, goal_y, store.scratch), 0)
    for i in range(length):
        plan[b, i] = store.scratch.path[i]
    person[b, PLAN_AT], person[b, PLAN_LENGTH] = 0, length


@inner
def _sees(sight, b, dx, dy, heading):  # type: ignore[no-untyped-def]
    """What person b's view shows of the cell at a map offset (dx, dy): a cell kind, UNSEEN if out of view."""
    width = sight.shape[1]
    half = width // 2
    fx, fy = step_x(heading), step_y(heading)
    side, ahead = -dx * fy + dy * fx, dx * fx + dy * fy
    if ahead < 0 or ahead >= width or side < -half or side > half:
        return UNSEEN
    return sight[b, half + side, width - 1 - ahead]


@inner
def _learn(rules, world, store, b):  # type: ignore[no-untyped-def]
    """Person b looks: it keeps what it sees, and plans anew where its view contradicts its plan or its belief."""
    grid, person, sight, known = world.grid, world.person, world.sight, world.known
    x, y, heading = person[b, X], person[b, Y], person[b, HEADING]
    look(grid, b, x, y, heading, rules[R_SEE_THROUGH] != 0, sight, b)
    stale = False
    if rules[R_PERSON_SEES_ONLY]:
        width = sight.shape[1]
        half = width // 2
        size = grid.shape[1]
        fx, fy = step_x(heading), step_y(heading)
        walled = False
        for vx in range(width):
            for vy in range(width):
                side, ahead = vx - half, width - 1 - vy
                cx, cy = x - side * fy + ahead * fx, y + side * fx + ahead * fy
                inside = 0 <= cx < size and 0 <= cy < size
                if inside and sight[b, vx, vy] != UNSEEN and known[b, cx, cy] != grid[b, cx, cy]:
                    known[b, cx, cy] = grid[b, cx, cy]
                    walled = walled or grid[b, cx, cy] == WALL
        stale = walled and _plan_is_blocked(world, b)
    if rules[R_GOAL_MOVES_AT]:
        goal_x, goal_y = person[b, BELIEVED_X], person[b, BELIEVED_Y]
        there = goal_x == x and goal_y == y
        shown = EMPTY if there else _sees(sight, b, goal_x - x, goal_y - y, heading)
        if shown != UNSEEN and grid[b, goal_x, goal_y] != GOAL:
            person[b, BELIEVED_X], person[b, BELIEVED_Y] = person[b, GOAL_X], person[b, GOAL_Y]
            stale = True
    if stale or person[b, PLAN_AT] >= person[b, PLAN_LENGTH]:
        plan_route(rules, world, store, b)


@inner
def _plan_is_blocked(world, b):  # type: ignore[no-untyped-def]
    """Whether the rest of person b's plan runs into a wall it knows of."""
    person, plan, known = world.person, world.plan, world.known
    x, y, heading = person[b, X], person[b, Y], person[b, HEADING]
    for i in range(person[b, PLAN_AT], person[b, PLAN_LENGTH]):
        if plan[b, i] == LEFT:
            heading = (heading + 3) & 3
        elif plan[b, i] == RIGHT:
            heading = (heading + 1) & 3
        else:
            x, y = x + step_x(heading), y + step_y(heading)
            if known[b, x, y] == WALL:
                return True
    return False


@entry
def move_goals(rules, world):  # type: ignore[no-untyped-def]
    """Move each person's goal to the next candidate at its time, unless the person sees the old place."""
    grid, person, goals, sight = world.grid, world.person, world.goals, world.sight
    count = rules[R_NUM_GOALS]
    for b in range(grid.shape[0]):
        if world.robot[b, TIME] + 1 != rules[R_GOAL_MOVES_AT]:
            continue
        goal_x, goal_y = person[b, GOAL_X], person[b, GOAL_Y]
        x, y, heading = person[b, X], person[b, Y], person[b, HEADING]
        look(grid, b, x, y, heading, rules[R_SEE_THROUGH] != 0, sight, b)
        there = goal_x == x and goal_y == y
        if there or _sees(sight, b, goal_x - x, goal_y - y, heading) != UNSEEN:
            continue
        for k in range(count):
            if goals[b, k, 0] == goal_x and goals[b, k, 1] == goal_y:
                after = (k + 1) % count
                grid[b, goal_x, goal_y] = EMPTY
                person[b, GOAL_X], person[b, GOAL_Y] = goals[b, after, 0], goals[b, after, 1]
                break


@inner
def move_persons(rules, world, configurations, gaps):  # type: ignore[no-untyped-def]
    """The persons' part of a step; what they do is kept as LAST_ACTION.

    Whoever has used up its plan is at its goal, and turns about twice, or stands still.
    """
    robot, person, plan = world.robot, world.person, world.plan
    rest, look_back, limit = rules[R_PERSON_REST], rules[R_LOOK_BACK] != 0, rules[R_FOLLOW_DISTANCE]
    for b in range(gaps.shape[0]):
        person[b, LAST_ACTION] = STAY
        if rest > 0 and robot[b, TIME] % rest == 0:
            continue
        if look_back and (configurations[b] == 0 or gaps[b] > limit):
            person[b, WAITING] += 1
            if person[b, WAITING] < 3:
                continue
        person[b, WAITING] = 0
        if person[b, PLAN_AT] >= person[b, PLAN_LENGTH]:
            if rules[R_TURNS_AT_GOAL] == 0:
                continue
            turn = LEFT if draw_below(world.stream, b, np.int64(2)) == 0 else RIGHT
            plan[b, 0], plan[b, 1] = turn, turn
            person[b, PLAN_AT], person[b, PLAN_LENGTH] = 0, 2
        action = plan[b, person[b, PLAN_AT]]
        person[b, PLAN_AT] += 1
        person[b, MOVES] += 1
        person[b, LAST_ACTION] = action
        heading = person[b, HEADING]
        if action == LEFT:
            person[b, HEADING] = (heading + 3) & 3
        elif action == RIGHT:
            person[b, HEADING] = (heading + 1) & 3
        else:
            person[b, X] += step_x(heading)
            person[b, Y] += step_y(heading)


@entry
def think_batch(rules, world, store):  # type: ignore[no-untyped-def]
    """Every person that has moved looks, learns, and plans anew where that is needed."""
    person = world.person
    for b in range(person.shape[0]):
        if person[b, LAST_ACTION] != STAY:
            _learn(rules, world, store, b)


@entry
def begin_to_think(rules, world, store, chosen):  # type: ignore[no-untyped-def]
    """Persons of new episodes, where `chosen` [B], know the border of the map and what they see, and plan with it."""
    size = world.known.shape[1]
    for b in range(chosen.shape[0]):
        if chosen[b]:
            for x in range(size):
                for y in range(size):
                    border = x == 0 or y == 0 or x == size - 1 or y == size - 1
                    world.known[b, x, y] = WALL if border else EMPTY
            world.person[b, PLAN_AT], world.person[b, PLAN_LENGTH] = 0, 0
            _learn(rules, world, store, b)


@entry
def place_others(world, chosen):  # type: ignore[no-untyped-def]
    """Put the other persons of new episodes, where `chosen` [B], on random free cells, without plans."""
    others = world.others
    for b in range(chosen.shape[0]):
        if chosen[b]:
            for k in range(others.shape[1]):
                x, y = _free_cell(world, b)
                others[b, k, X], others[b, k, Y] = x, y
                others[b, k, HEADING] = draw_below(world.stream, b, np.int64(4))
                others[b, k, PLAN_AT], others[b, k, PLAN_LENGTH] = 0, 0


@inner
def _free_cell(world, b):  # type: ignore[no-untyped-def]
    """A random cell that is neither wall nor goal nor taken by the robot."""
    grid, robot = world.grid, world.robot
    size = grid.shape[1]
    while True:
        x, y = draw_below(world.stream, b, size), draw_below(world.stream, b, size)
        if grid[b, x, y] == EMPTY and not (robot[b, X] == x and robot[b, Y] == y):
            return x, y


@entry
def move_others(world, store):  # type: ignore[no-untyped-def]
    """The other persons walk shortest paths from one random free cell to the next; the robot gives way."""
    grid, robot, others, plan = world.grid, world.robot, world.others, world.other_plan
    for b in range(others.shape[0]):
        for k in range(others.shape[1]):
            x, y, heading = others[b, k, X], others[b, k, Y], others[b, k, HEADING]
            if others[b, k, PLAN_AT] >= others[b, k, PLAN_LENGTH]:
                to_x, to_y = _free_cell(world, b)
                length = way_to_cell(grid, b, x, y, heading, to_x, to_y, store.scratch)
                others[b, k, PLAN_AT], others[b, k, PLAN_LENGTH] = 0, max(length, 0)
                for i in range(length):
                    plan[b, k, i] = store.scratch.path[i]
                if length <= 0:
                    continue
            action = plan[b, k, others[b, k, PLAN_AT]]
            if action == FORWARD:
                x, y = x + step_x(heading), y + step_y(heading)
                if robot[b, X] == x and robot[b, Y] == y:
                    continue
                others[b, k, X], others[b, k, Y] = x, y
            else:
                others[b, k, HEADING] = (heading + (3 if action == LEFT else 1)) & 3
            others[b, k, PLAN_AT] += 1
