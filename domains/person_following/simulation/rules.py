"""The rules of the task, compiled: one step, for one or many environments.

    S   map, poses of robot and person, the person's plan and waiting counter, lost counter, time
    A   left, right, forward, stay
    O   the view [v, v] without the person, and the person's configuration where it is in view
    T   deterministic but for the person's turning about at its goal
    R   see `_judge`: closeness, visibility, 100 for arriving together, penalties for bumping and for losing

A step goes through all environments phase by phase: robots move, robots look, persons move, rewards. One
implementation serves the single and the batched environment. Phases take whole arrays and index them, as
slices would be counted references, which cost more than the rules themselves.
"""

from __future__ import annotations

from domains.core import FORWARD, LEFT, RIGHT, STAY, WALL
from domains.person_following.simulation.compiled import entry, inner
from domains.person_following.simulation.paths import HEADING_ALWAYS, HEADING_NEVER, step_x, step_y
from domains.person_following.simulation.people import move_persons
from domains.person_following.simulation.store import distance, first_action, first_action_to_goal
from domains.person_following.simulation.views import configuration_of, look, relative, remove_person
from domains.person_following.simulation.world import (
    AT_GOAL,
    GOAL_X,
    GOAL_Y,
    HEADING,
    LAST_ACTION,
    LOST,
    SLOT,
    TIME,
    WAITING,
    X,
    Y,
)
from domains.person_following.variants import (
    R_FOLLOW_DISTANCE,
    R_FOLLOWING,
    R_GOAL_PATIENCE,
    R_LOOK_BACK,
    R_MAX_LOST,
    R_MAX_STEPS,
    R_ROBOT_REST,
    R_SEE_THROUGH,
)

SUCCESS, AGENT_AT_GOAL, LOST_PERSON, UNESCORTED, TIMEOUT = 1, 2, 3, 4, 5
"""Indices into `domains.core.OUTCOMES`."""


@inner
def _move_robots(rules, world, actions, out):  # type: ignore[no-untyped-def]
    """The robots' part of a step; `out.acted` gets what they did, `out.entered` who entered the goal."""
    grid, robot, person, others = world.grid, world.robot, world.person, world.others
    acted, entered = out.acted, out.entered
    rest = rules[R_ROBOT_REST]
    following = rules[R_FOLLOWING] != 0
    for b in range(actions.shape[0]):
        robot[b, TIME] += 1
        action = actions[b]
        if rest > 0 and robot[b, TIME] % rest == 0:
            action = STAY
        acted[b] = action
        entered[b] = False
        heading = robot[b, HEADING]
        if action == LEFT:
            robot[b, HEADING] = (heading + 3) & 3
        elif action == RIGHT:
            robot[b, HEADING] = (heading + 1) & 3
        elif action == FORWARD:
            x = robot[b, X] + step_x(heading)
            y = robot[b, Y] + step_y(heading)
            blocked = following and person[b, X] == x and person[b, Y] == y
            for k in range(others.shape[1]):
                blocked = blocked or (others[b, k, X] == x and others[b, k, Y] == y)
            if grid[b, x, y] != WALL and not blocked:
                robot[b, X], robot[b, Y] = x, y
                # Candidates that are not the person's goal are floor like any other.
                entered[b] = x == person[b, GOAL_X] and y == person[b, GOAL_Y]


@inner
def _look(see_through, grid, whose, views):  # type: ignore[no-untyped-def]
    """Fill `views` with what `whose` (the array of robots or of persons) see."""
    for b in range(views.shape[0]):
        look(grid, b, whose[b, X], whose[b, Y], whose[b, HEADING], see_through, views, b)


@inner
def _configure_one(see_through, robot, person, views, b):  # type: ignore[no-untyped-def]
    side, ahead, heading = relative(
        robot[b, X], robot[b, Y], robot[b, HEADING], person[b, X], person[b, Y], person[b, HEADING]
    )
    return configuration_of(views, b, side, ahead, heading, see_through)


@inner
def _configure(see_through, robot, person, views, configurations):  # type: ignore[no-untyped-def]
    """Fill `configurations` with where the robots, seeing `views`, see the persons."""
    for b in range(views.shape[0]):
        configurations[b] = _configure_one(see_through, robot, person, views, b)


@inner
def _gap(store, grid, robot, person, b):  # type: ignore[no-untyped-def]
    found = distance(
        store,
        grid,
        b,
        robot[b, SLOT],
        robot[b, X],
        robot[b, Y],
        robot[b, HEADING],
        person[b, X],
        person[b, Y],
        person[b, HEADING],
    )
    return max(found, 0)


@inner
def measure(store, grid, robot, person, gaps):  # type: ignore[no-untyped-def]
    """Fill `gaps` with the robots' distances to the persons; 0 where no path exists."""
    row_of, table, visits = store.row_of, store.distance, store.visits
    rule = store.heading_rule[0]
    size = grid.shape[1]
    for b in range(gaps.shape[0]):
        slot = robot[b, SLOT]
        row = -1
        if slot >= 0 and visits[slot] >= 2:
            heading = person[b, HEADING]
            compare = rule == HEADING_ALWAYS or (rule != HEADING_NEVER and heading != 0)
            row = row_of[slot, (person[b, X] * size + person[b, Y]) * 4 + (heading if compare else 0)]
        if row >= 0:
            gaps[b] = max(table[row, (robot[b, X] * size + robot[b, Y]) * 4 + robot[b, HEADING]], 0)
        else:
            gaps[b] = _gap(store, grid, robot, person, b)


@inner
def _judge(rules, robot, person, out):  # type: ignore[no-untyped-def]
    """Rewards and ends of a step of person following, from what holds after both have moved."""
    acted, entered, gaps, configurations = out.acted, out.entered, out.distance, out.final_configuration
    rewards, terminations, truncations, outcomes = out.reward, out.terminated, out.truncated, out.outcome
    visible = out.visible
    limit, max_lost, max_steps = rules[R_FOLLOW_DISTANCE], rules[R_MAX_LOST], rules[R_MAX_STEPS]
    patience = rules[R_GOAL_PATIENCE]
    for b in range(rewards.shape[0]):
        gap = gaps[b]
        seen = configurations[b] > 0
        px, py, x, y = person[b, X], person[b, Y], robot[b, X], robot[b, Y]
        at_goal = px == person[b, GOAL_X] and py == person[b, GOAL_Y]
        robot[b, AT_GOAL] = robot[b, AT_GOAL] + 1 if at_goal else 0
        reward = 1.0 - 0.9 * (robot[b, TIME] / max_steps) if entered[b] else 0.0
        if acted[b] == FORWARD:
            heading = robot[b, HEADING]
            if px == x + step_x(heading) and py == y + step_y(heading):
                reward -= 0.01
        if px == x and py == y:
            reward -= 0.01
        terminated, truncated, outcome = entered[b], False, 0
        if gap <= limit:
            robot[b, LOST] = 0
            if gap > 0:
                reward += 1.5 / (1 + gap)
            if seen:
                reward += 0.5
                if at_goal:
                    reward += 100.0
                    terminated = True
                    outcome = SUCCESS
        else:
            robot[b, LOST] += 1
            reward -= 0.05 * gap
            if robot[b, LOST] >= max_lost:
                truncated = True
                outcome = LOST_PERSON
            if at_goal and robot[b, AT_GOAL] > patience:
                truncated = True
                if outcome == 0:
                    outcome = UNESCORTED
        if robot[b, TIME] >= max_steps:
            truncated = True
            if outcome == 0:
                outcome = TIMEOUT
        if entered[b] and outcome != SUCCESS:
            outcome = AGENT_AT_GOAL
        rewards[b] = reward
        terminations[b] = terminated
        truncations[b] = truncated
        outcomes[b] = outcome
        visible[b] = seen


@inner
def _judge_crossing(rules, robot, out):  # type: ignore[no-untyped-def]
    """Rewards and ends of a step of the crossing task: Minigrid's reward at the goal, nothing before."""
    max_steps = rules[R_MAX_STEPS]
    for b in range(out.entered.shape[0]):
        entered = out.entered[b]
        out.terminated[b] = entered
        out.truncated[b] = robot[b, TIME] >= max_steps
        out.reward[b] = 1.0 - 0.9 * (robot[b, TIME] / max_steps) if entered else 0.0
        out.outcome[b] = SUCCESS if entered else (TIMEOUT if out.truncated[b] else 0)
        out.distance[b], out.visible[b], out.final_configuration[b] = 0, False, 0


@entry
def step_batch(rules, world, store, actions, out):  # type: ignore[no-untyped-def]
    """Take one action per environment; returns how many episodes ended, marked in `out.ended`."""
    grid, robot, person = world.grid, world.robot, world.person
    see_through = rules[R_SEE_THROUGH] != 0
    views, configurations = out.final_view, out.final_configuration
    _move_robots(rules, world, actions, out)
    _look(see_through, grid, robot, views)
    if rules[R_FOLLOWING]:
        if rules[R_LOOK_BACK]:
            _configure(see_through, robot, person, views, configurations)
            measure(store, grid, robot, person, out.distance)
        move_persons(rules, world, configurations, out.distance)
        _configure(see_through, robot, person, views, configurations)
        for b in range(actions.shape[0]):
            remove_person(views, b, configurations[b])
        measure(store, grid, robot, person, out.distance)
        _judge(rules, robot, person, out)
        _describe(rules, world, out.final_person_view, out.final_pose, out.final_counters)
    else:
        _judge_crossing(rules, robot, out)
    count = 0
    for b in range(actions.shape[0]):
        out.person_action[b] = person[b, LAST_ACTION]
        out.ended[b] = out.terminated[b] or out.truncated[b]
        count += out.ended[b]
    return count


@inner
def _describe(rules, world, views, poses, counters):  # type: ignore[no-untyped-def]
    """Fill the persons' views [B, v, v] and poses [B, 3] relative to the robots, and the counters [B, 2]."""
    robot, person = world.robot, world.person
    _look(rules[R_SEE_THROUGH] != 0, world.grid, person, views)
    for b in range(views.shape[0]):
        side, ahead, heading = relative(
            robot[b, X], robot[b, Y], robot[b, HEADING], person[b, X], person[b, Y], person[b, HEADING]
        )
        poses[b, 0], poses[b, 1], poses[b, 2] = side, ahead, heading
        counters[b, 0], counters[b, 1] = person[b, WAITING], robot[b, LOST]


@entry
def describe_batch(rules, world, views, poses, counters):  # type: ignore[no-untyped-def]
    """`_describe` for callers in Python."""
    _describe(rules, world, views, poses, counters)


@entry
def expert_batch(world, store, follower, actions):  # type: ignore[no-untyped-def]
    """First actions [B] of the A* paths to the person (`follower`) or to the goal, on the full map."""
    grid, robot, person = world.grid, world.robot, world.person
    for b in range(actions.shape[0]):
        slot, x, y, h = robot[b, SLOT], robot[b, X], robot[b, Y], robot[b, HEADING]
        if follower:
            to_x, to_y, to_h = person[b, X], person[b, Y], person[b, HEADING]
            actions[b] = first_action(store, grid, b, slot, x, y, h, to_x, to_y, to_h)
        else:
            to_x, to_y = person[b, GOAL_X], person[b, GOAL_Y]
            actions[b] = first_action_to_goal(store, grid, b, slot, x, y, h, to_x, to_y)
