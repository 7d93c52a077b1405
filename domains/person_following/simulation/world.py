"""The state of all environments of a batch, as arrays, and the arrays that a step fills."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from domains.core import UNSEEN
from domains.person_following.simulation.random_numbers import STREAM_WIDTH
from domains.person_following.simulation.store import longest_plan
from domains.person_following.variants import MAX_GOALS, Parameters

# Columns of `World.robot`; SLOT is the map's place in the store, AT_GOAL counts steps of the person at its goal.
X, Y, HEADING, LOST, TIME, SLOT, EPISODE, AT_GOAL, ROBOT_COLUMNS = range(9)
# Columns of `World.person`; the first three are X, Y, HEADING too. OWN is the number of the candidate that was the
# person's goal at first, MOVES counts its actions other than waiting.
(
    WAITING,
    PLAN_AT,
    PLAN_LENGTH,
    GOAL_X,
    GOAL_Y,
    LAST_ACTION,
    BELIEVED_X,
    BELIEVED_Y,
    OWN,
    MOVES,
    PERSON_COLUMNS,
) = range(3, 14)


class World(NamedTuple):
    """The state of B environments."""

    grid: NDArray[np.uint8]  # [B, size, size]: cell kinds, the cell freed where the person started
    robot: NDArray[np.int64]  # [B, ROBOT_COLUMNS]: see above
    person: NDArray[np.int64]  # [B, PERSON_COLUMNS]
    plan: NDArray[np.int8]  # [B, longest plan]: the person's actions
    known: NDArray[np.uint8]  # [B, size, size]: cells as the person believes them; [0, ...] where it knows all
    sight: NDArray[np.uint8]  # [B, v, v]: the persons' views, where the rules need them
    others: NDArray[np.int64]  # [B, N - 1, PERSON_COLUMNS]: persons who are not to be followed
    other_plan: NDArray[np.int8]  # [B, N - 1, longest plan]
    goals: NDArray[np.int64]  # [B, MAX_GOALS, 2]: candidate cells, the first `num_goals` of them in use
    stream: NDArray[np.uint64]  # [B, 6]: random streams
    map_id: NDArray[np.int64]  # [B]


class Results(NamedTuple):
    """What a step reports of B environments; `final` means after the step and before any reset."""

    robot_view: NDArray[np.uint8]  # [B, v, v]
    configuration: NDArray[np.int64]  # [B]
    reward: NDArray[np.float64]  # [B]
    terminated: NDArray[np.bool_]  # [B]
    truncated: NDArray[np.bool_]  # [B]
    outcome: NDArray[np.int8]  # [B]
    distance: NDArray[np.int64]  # [B]
    visible: NDArray[np.bool_]  # [B]
    person_action: NDArray[np.int8]  # [B]
    acted: NDArray[np.int64]  # [B]: what the robot did, resting included
    entered: NDArray[np.bool_]  # [B]: whether it entered the goal
    ended: NDArray[np.bool_]  # [B]: whether the episode ended
    final_view: NDArray[np.uint8]  # [B, v, v]
    final_configuration: NDArray[np.int64]  # [B]
    final_person_view: NDArray[np.uint8]  # [B, v, v]
    final_pose: NDArray[np.int16]  # [B, 3]
    final_counters: NDArray[np.int16]  # [B, 2]


def allocate_world(num_envs: int, parameters: Parameters) -> World:
    """A world of empty maps; episodes have yet to begin."""
    size = parameters.size
    return World(
        grid=np.zeros((num_envs, size, size), np.uint8),
        robot=np.zeros((num_envs, ROBOT_COLUMNS), np.int64),
        person=np.zeros((num_envs, PERSON_COLUMNS), np.int64),
        plan=np.zeros((num_envs, longest_plan(size)), np.int8),
        known=np.zeros((num_envs if parameters.person_knows == "seen" else 0, size, size), np.uint8),
        sight=np.zeros((num_envs, parameters.view_size, parameters.view_size), np.uint8),
        others=np.zeros((num_envs, parameters.num_persons - 1, PERSON_COLUMNS), np.int64),
        other_plan=np.zeros((num_envs, parameters.num_persons - 1, longest_plan(size)), np.int8),
        goals=np.zeros((num_envs, MAX_GOALS, 2), np.int64),
        stream=np.zeros((num_envs, STREAM_WIDTH), np.uint64),
        map_id=np.zeros(num_envs, np.int64),
    )


def allocate_results(num_envs: int, view_size: int) -> Results:
    """Arrays for the results of one step."""
    return Results(
        robot_view=np.empty((num_envs, view_size, view_size), np.uint8),
        configuration=np.empty(num_envs, np.int64),
        reward=np.empty(num_envs, np.float64),
        terminated=np.empty(num_envs, np.bool_),
        truncated=np.empty(num_envs, np.bool_),
        outcome=np.empty(num_envs, np.int8),
        distance=np.empty(num_envs, np.int64),
        visible=np.empty(num_envs, np.bool_),
        person_action=np.empty(num_envs, np.int8),
        acted=np.empty(num_envs, np.int64),
        entered=np.empty(num_envs, np.bool_),
        ended=np.empty(num_envs, np.bool_),
        final_view=np.empty((num_envs, view_size, view_size), np.uint8),
        final_configuration=np.empty(num_envs, np.int64),
        # the crossing task has no person and leaves these three as they are
        final_person_view=np.full((num_envs, view_size, view_size), UNSEEN, np.uint8),
        final_pose=np.zeros((num_envs, 3), np.int16),
        final_counters=np.zeros((num_envs, 2), np.int16),
    )
