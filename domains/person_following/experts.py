"""Behaviours that need no learning.

The greedy follower with the full state is `env.expert_actions("follower")`; the A* expert of the crossing task
is `env.expert_actions("goal")`. Here is the one with a memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from domains.core import EMPTY, FORWARD, LEFT, RIGHT, STAY, UNSEEN, WALL, ViewGeometry
from domains.person_following.simulation.paths import allocate_scratch, find_path
from domains.person_following.variants import Parameters

_REACH = 10  # cells around the robot that its path search considers


class LastSeenFollower:
    """Greedy follower under partial observability: walks to the person's last seen pose, by its view alone.

    It keeps that pose relative to itself by counting its own steps, and plans with A* over the walls in its present
    view, taking all else as free. The path must end in the person's heading: whoever arrives where a person was last
    seen, and looks where it looked, finds it again more often than not. At an empty last pose it goes straight on,
    or turns left at a wall. What this is worth: docs/notes/variants.md.
    """

    def __init__(self, num_envs: int, parameters: Parameters) -> None:
        """Begin without having seen anybody."""
        self.geometry = ViewGeometry(parameters.view_size)
        self._rest = parameters.robot_rest
        self._pose = np.zeros((num_envs, 3), np.int64)
        self._known = np.zeros(num_envs, np.bool_)
        self._action = np.full(num_envs, STAY, np.int64)
        self._front_free = np.zeros(num_envs, np.bool_)
        self._time = np.zeros(num_envs, np.int64)
        self._scratch = allocate_scratch(2 * _REACH + 1)

    def actions(
        self,
        observation: Mapping[str, NDArray[Any]],
        begun: NDArray[np.bool_] | None = None,
        acted: NDArray[np.int64] | None = None,
    ) -> NDArray[np.int64]:
        """`[B]`: actions for the present observations; see `domains.core.ObservationPolicy`."""
        views, configurations = observation["view"], np.asarray(observation["configuration"])
        if acted is not None:
            self._action = np.array(acted, np.int64)
        if self._rest:
            self._action[self._time % self._rest == 0] = STAY
        if begun is not None:
            self._known[begun] = False
            self._action[begun] = STAY
            self._time[begun] = 0
        self._advance()
        seen = configurations > 0
        self._known |= seen
        self._pose[seen] = self.geometry.relative(configurations[seen])
        half, width = self.geometry.view_size // 2, self.geometry.view_size
        occupied = seen & (self._pose[:, 0] == 0) & (self._pose[:, 1] == 1)
        self._front_free = (views[:, half, width - 2] != WALL) & ~occupied
        actions = np.full(len(views), STAY, np.int64)
        for b in np.nonzero(self._known)[0]:
            actions[b] = self._towards(views[b], self._pose[b], bool(seen[b]), bool(self._front_free[b]))
        self._time += 1
        self._action = actions.copy()
        return actions

    def _advance(self) -> None:
        """Move the remembered pose by what the robot did last."""
        side, ahead, heading = self._pose.T.copy()
        left, right = self._action == LEFT, self._action == RIGHT
        went = (self._action == FORWARD) & self._front_free
        self._pose[:, 0] = np.where(left, ahead, np.where(right, -ahead, side))
        self._pose[:, 1] = np.where(left, -side, np.where(right, side, ahead - went))
        self._pose[:, 2] = (heading + left - right) % 4

    def _towards(self, view: NDArray[np.uint8], pose: NDArray[np.int64], seen: bool, free: bool) -> int:
        half, width = self.geometry.view_size // 2, self.geometry.view_size
        grid = np.full((1, 2 * _REACH + 1, 2 * _REACH + 1), EMPTY, np.uint8)
        known = np.where(view == UNSEEN, EMPTY, view)
        grid[0, _REACH - half : _REACH + half + 1, _REACH - width + 1 : _REACH + 1] = known
        side, ahead, heading = (int(v) for v in pose)
        x = min(max(_REACH + side, 0), 2 * _REACH)
        y = min(max(_REACH - ahead, 0), 2 * _REACH)
        length = find_path(grid, 0, _REACH, _REACH, 3, x, y, heading, True, self._scratch)
        if length > 0:
            return int(self._scratch.path[0])
        if seen:
            return STAY
        return FORWARD if free else LEFT
