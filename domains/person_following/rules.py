"""The rules of the task, compiled: beginning an episode and taking a step, for one or many environments.

    S   map, poses of robot and person, the person's plan and waiting counter, lost counter, time
    A   left, right, forward, stay
    O   the view [v, v] without the person, and the person's configuration where it is in view
    T   deterministic but for the person's turning about at its goal
    R   see `_reward`: closeness, visibility, 100 for arriving together, penalties for bumping and for losing

One implementation serves the single and the batched environment.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from domains.core import EMPTY, FORWARD, GOAL, LEFT, RIGHT, STAY, WALL
from domains.person_following.map_generation import generate_crossing
from domains.person_following.paths import astar, step_x, step_y
from domains.person_following.random_numbers import draw_below
from domains.person_following.store import distance, enter_map, first_action, first_action_to_goal, map_hash
from domains.person_following.variants import (
    DRAWN,
    GENERATED,
    R_FOLLOW_DISTANCE,
    R_FOLLOWING,
    R_GOAL_PATIENCE,
    R_KEEP_WAITING,
    R_LOOK_BACK,
    R_MAP_SOURCE,
    R_MAX_LOST,
    R_MAX_STEPS,
    R_NUM_CROSSINGS,
    R_PERSON_REST,
    R_ROBOT_REST,
    R_SEE_THROUGH,
)
from domains.person_following.views import configuration_of, look, relative
from domains.person_following.world import (
    AT_GOAL,
    EPISODE,
    GOAL_X,
    GOAL_Y,
    HEADING,
    LAST_ACTION,
    LOST,
    PLAN_AT,
    PLAN_LENGTH,
    SLOT,
    TIME,
    WAITING,
    X,
    Y,
)

SUCCESS, AGENT_AT_GOAL, LOST_PERSON, UNESCORTED, TIMEOUT = 1, 2, 3, 4, 5
"""Indices into `domains.core.OUTCOMES`."""

NO_ACTION = -1


@njit(cache=True)
def _begin(rules, world, store, b):  # type: ignore[no-untyped-def]
    """Start an episode of environment b on the map that lies in its grid."""
    grid, robot, person = world.grid[b], world.robot[b], world.person[b]
    size = grid.shape[0]
    robot[X], robot[Y], robot[HEADING] = 1, 1, 0
    robot[LOST], robot[TIME], robot[AT_GOAL] = 0, 0, 0
    person[LAST_ACTION] = NO_ACTION
    if not rules[R_KEEP_WAITING]:
        person[WAITING] = 0
    goal_x, goal_y = 0, 0
    for x in range(size):
        for y in range(size):
            if grid[x, y] == GOAL:
                goal_x, goal_y = x, y
    person[GOAL_X], person[GOAL_Y] = goal_x, goal_y
    person[X], person[Y], person[HEADING] = 2, 2, 0
    if rules[R_FOLLOWING]:
        # The person replaces whatever stood on its cell, and leaves it empty.
        grid[2, 2] = EMPTY
    world.map_id[b] = map_hash(grid)
    slot = enter_map(store, grid, world.map_id[b], 2, 2, 0, goal_x, goal_y)
    robot[SLOT] = slot
    person[PLAN_AT] = 0
    if slot >= 0:
        person[PLAN_LENGTH] = store.plan_length[slot]
        for i in range(person[PLAN_LENGTH]):
            world.plan[b, i] = store.plan[slot, i]
    else:
        _plan(world, store, b)


@njit(cache=True)
def _plan(world, store, b):  # type: ignore[no-untyped-def]
    """Make the person a new plan from where it stands to its goal; at the goal, to turn about twice."""
    person, plan = world.person[b], world.plan[b]
    length = astar(
        world.grid[b],
        person[X],
        person[Y],
        person[HEADING],
        person[GOAL_X],
        person[GOAL_Y],
        -1,
        False,
        store.scratch,
    )
    if length > 0:
        for i in range(length):
            plan[i] = store.scratch.path[i]
    else:
        length = 2
        turn = LEFT if draw_below(world.stream[b], 2) == 0 else RIGHT
        plan[0] = turn
        plan[1] = turn
    person[PLAN_AT], person[PLAN_LENGTH] = 0, length


@njit(cache=True)
def _choose_map(rules, world, maps, b):  # type: ignore[no-untyped-def]
    """Put the map of environment b's next episode into its grid."""
    source = rules[R_MAP_SOURCE]
    if source == GENERATED:
        generate_crossing(world.stream[b], world.grid[b], rules[R_NUM_CROSSINGS])
    else:
        if source == DRAWN:
            chosen = draw_below(world.stream[b], maps.shape[0])
        else:
            chosen = (b + world.robot[b, EPISODE] * world.grid.shape[0]) % maps.shape[0]
        for x in range(maps.shape[1]):
            for y in range(maps.shape[2]):
                world.grid[b, x, y] = maps[chosen, x, y]
    world.robot[b, EPISODE] += 1


@njit(cache=True)
def _act_robot(rules, world, b, action):  # type: ignore[no-untyped-def]
    """The robot's part of a step; returns whether it entered the goal."""
    grid, robot, person = world.grid[b], world.robot[b], world.person[b]
    if action == LEFT:
        robot[HEADING] = (robot[HEADING] + 3) & 3
    elif action == RIGHT:
        robot[HEADING] = (robot[HEADING] + 1) & 3
    elif action == FORWARD:
        x = robot[X] + step_x(robot[HEADING])
        y = robot[Y] + step_y(robot[HEADING])
        blocked = rules[R_FOLLOWING] and person[X] == x and person[Y] == y
        if grid[x, y] != WALL and not blocked:
            robot[X], robot[Y] = x, y
            return grid[x, y] == GOAL
    return False


@njit(cache=True)
def _act_person(rules, world, store, b, in_view, far):  # type: ignore[no-untyped-def]
    """The person's part of a step; returns what it did."""
    person = world.person[b]
    if rules[R_PERSON_REST] > 0 and world.robot[b, TIME] % rules[R_PERSON_REST] == 0:
        return STAY
    if rules[R_LOOK_BACK] and (not in_view or far):
        person[WAITING] += 1
        if person[WAITING] < 3:
            return STAY
    person[WAITING] = 0
    if person[PLAN_AT] >= person[PLAN_LENGTH]:
        _plan(world, store, b)
    action = world.plan[b, person[PLAN_AT]]
    person[PLAN_AT] += 1
    if action == LEFT:
        person[HEADING] = (person[HEADING] + 3) & 3
    elif action == RIGHT:
        person[HEADING] = (person[HEADING] + 1) & 3
    else:
        person[X] += step_x(person[HEADING])
        person[Y] += step_y(person[HEADING])
    return np.int64(action)


@njit(cache=True)
def _gap(world, store, b):  # type: ignore[no-untyped-def]
    """The robot's distance to the person; 0 where no path exists."""
    robot, person = world.robot[b], world.person[b]
    return max(
        distance(
            store,
            world.grid[b],
            robot[SLOT],
            robot[X],
            robot[Y],
            robot[HEADING],
            person[X],
            person[Y],
            person[HEADING],
        ),
        0,
    )


@njit(cache=True)
def _configure(rules, world, view, b):  # type: ignore[no-untyped-def]
    """The person's configuration in the robot's view."""
    robot, person = world.robot[b], world.person[b]
    side, ahead, heading = relative(robot[X], robot[Y], robot[HEADING], person[X], person[Y], person[HEADING])
    return configuration_of(view, side, ahead, heading, rules[R_SEE_THROUGH])


@njit(cache=True)
def _step_crossing(rules, world, out, b, action):  # type: ignore[no-untyped-def]
    """One step of the crossing task: Minigrid's reward at the goal, nothing before."""
    robot = world.robot[b]
    entered = _act_robot(rules, world, b, action)
    out.terminated[b] = entered
    out.truncated[b] = robot[TIME] >= rules[R_MAX_STEPS]
    out.reward[b] = 1.0 - 0.9 * (robot[TIME] / rules[R_MAX_STEPS]) if entered else 0.0
    out.outcome[b] = SUCCESS if entered else (TIMEOUT if out.truncated[b] else 0)
    out.distance[b], out.visible[b], out.person_action[b] = 0, False, NO_ACTION
    out.final_configuration[b] = 0
    look(world.grid[b], robot[X], robot[Y], robot[HEADING], rules[R_SEE_THROUGH] != 0, out.final_view[b])


@njit(cache=True)
def _step_following(rules, world, store, out, b, action):  # type: ignore[no-untyped-def]
    """One step of person following, in the order of the rules: robot, person, rewards."""
    grid, robot, person = world.grid[b], world.robot[b], world.person[b]
    see_through = rules[R_SEE_THROUGH] != 0
    if rules[R_ROBOT_REST] > 0 and robot[TIME] % rules[R_ROBOT_REST] == 0:
        action = STAY
    entered = _act_robot(rules, world, b, action)
    reward = 1.0 - 0.9 * (robot[TIME] / rules[R_MAX_STEPS]) if entered else 0.0
    view = out.final_view[b]
    look(grid, robot[X], robot[Y], robot[HEADING], see_through, view)

    in_view, far = True, False
    if rules[R_LOOK_BACK]:
        in_view = _configure(rules, world, view, b) > 0
        far = _gap(world, store, b) > rules[R_FOLLOW_DISTANCE]
    person_action = _act_person(rules, world, store, b, in_view, far)
    person[LAST_ACTION] = person_action

    configuration = _configure(rules, world, view, b)
    visible = configuration > 0
    gap = _gap(world, store, b)
    at_goal = person[X] == person[GOAL_X] and person[Y] == person[GOAL_Y]
    if at_goal:
        robot[AT_GOAL] += 1
    if action == FORWARD:
        front_x = robot[X] + step_x(robot[HEADING])
        front_y = robot[Y] + step_y(robot[HEADING])
        if person[X] == front_x and person[Y] == front_y:
            reward -= 0.01
    if person[X] == robot[X] and person[Y] == robot[Y]:
        reward -= 0.01
    terminated, truncated, outcome = entered, False, 0
    if gap <= rules[R_FOLLOW_DISTANCE]:
        robot[LOST] = 0
        if gap > 0:
            reward += 1.5 / (1 + gap)
        if visible:
            reward += 0.5
            if at_goal:
                reward += 100.0
                terminated = True
                outcome = SUCCESS
    else:
        robot[LOST] += 1
        reward -= 0.05 * gap
        if robot[LOST] >= rules[R_MAX_LOST]:
            truncated = True
            outcome = LOST_PERSON
        if at_goal and robot[AT_GOAL] > rules[R_GOAL_PATIENCE]:
            truncated = True
            if outcome == 0:
                outcome = UNESCORTED
    if robot[TIME] >= rules[R_MAX_STEPS]:
        truncated = True
        if outcome == 0:
            outcome = TIMEOUT
    if entered and outcome != SUCCESS:
        outcome = AGENT_AT_GOAL
    out.reward[b] = reward
    out.terminated[b] = terminated
    out.truncated[b] = truncated
    out.outcome[b] = outcome
    out.distance[b] = gap
    out.visible[b] = visible
    out.person_action[b] = person_action
    out.final_configuration[b] = configuration


@njit(cache=True)
def _observe(rules, world, view, b):  # type: ignore[no-untyped-def]
    """Fill the robot's view; returns the person's configuration."""
    robot = world.robot[b]
    look(world.grid[b], robot[X], robot[Y], robot[HEADING], rules[R_SEE_THROUGH] != 0, view)
    if not rules[R_FOLLOWING]:
        return 0
    return _configure(rules, world, view, b)


@njit(cache=True)
def _describe(rules, world, b, view, pose, counters):  # type: ignore[no-untyped-def]
    """Fill the person's view, its pose relative to the robot, and the counters."""
    robot, person = world.robot[b], world.person[b]
    look(world.grid[b], person[X], person[Y], person[HEADING], rules[R_SEE_THROUGH] != 0, view)
    pose[0], pose[1], pose[2] = relative(robot[X], robot[Y], robot[HEADING], person[X], person[Y], person[HEADING])
    counters[0], counters[1] = person[WAITING], robot[LOST]


@njit(cache=True)
def begin_batch(rules, world, store, maps, chosen, given, out):  # type: ignore[no-untyped-def]
    """Begin episodes where `chosen` [B]; on the map already in the grid if `given`, else on a new one."""
    for b in range(chosen.shape[0]):
        if chosen[b]:
            if not given:
                _choose_map(rules, world, maps, b)
            _begin(rules, world, store, b)
            out.configuration[b] = _observe(rules, world, out.robot_view[b], b)
            out.visible[b] = out.configuration[b] > 0
            out.distance[b] = _gap(world, store, b) if rules[R_FOLLOWING] else 0


@njit(cache=True)
def step_batch(rules, world, store, maps, actions, autoreset, out):  # type: ignore[no-untyped-def]
    """Take one action per environment; with `autoreset`, begin a new episode at once where one ended."""
    following = rules[R_FOLLOWING] != 0
    for b in range(actions.shape[0]):
        world.robot[b, TIME] += 1
        if following:
            _step_following(rules, world, store, out, b, actions[b])
            _describe(rules, world, b, out.final_person_view[b], out.final_pose[b], out.final_counters[b])
        else:
            _step_crossing(rules, world, out, b, actions[b])
        if autoreset and (out.terminated[b] or out.truncated[b]):
            _choose_map(rules, world, maps, b)
            _begin(rules, world, store, b)
            out.configuration[b] = _observe(rules, world, out.robot_view[b], b)
        else:
            for x in range(out.robot_view.shape[1]):
                for y in range(out.robot_view.shape[2]):
                    out.robot_view[b, x, y] = out.final_view[b, x, y]
            out.configuration[b] = out.final_configuration[b]


@njit(cache=True)
def describe_batch(rules, world, views, poses, counters):  # type: ignore[no-untyped-def]
    """Person views [B, v, v], relative poses [B, 3] and counters [B, 2] of the present states."""
    for b in range(views.shape[0]):
        _describe(rules, world, b, views[b], poses[b], counters[b])


@njit(cache=True)
def expert_batch(world, store, follower, actions):  # type: ignore[no-untyped-def]
    """First actions [B] of the A* paths to the person (`follower`) or to the goal, on the full map."""
    for b in range(actions.shape[0]):
        grid, robot, person = world.grid[b], world.robot[b], world.person[b]
        if follower:
            actions[b] = first_action(
                store,
                grid,
                robot[SLOT],
                robot[X],
                robot[Y],
                robot[HEADING],
                person[X],
                person[Y],
                person[HEADING],
            )
        else:
            actions[b] = first_action_to_goal(
                store, grid, robot[SLOT], robot[X], robot[Y], robot[HEADING], person[GOAL_X], person[GOAL_Y]
            )
