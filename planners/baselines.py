"""Reference agents: they say what a comparison's numbers mean.

`optimum` and `greedy-follower` look at the full state through the domain's oracles; `greedy-last-seen` has what
the learning agents have, the view and the configuration, and one memory: where it last saw the person.
"""

from __future__ import annotations

import heapq

import numpy as np

from domains.core import WALL, OraclePolicy, ViewGeometry
from planners.agents import Situation

LEFT, RIGHT, FORWARD, STAY = 0, 1, 2, 3
Pose = tuple[int, int, int]  # (side, ahead, heading), heading 3 = the robot's own


class RandomAgent:
    """Acts uniformly at random, with a random stream per episode."""

    def __init__(self, num_actions: int, seed: int) -> None:
        self.num_actions, self.seed = num_actions, seed
        self.streams: list[np.random.Generator] = []

    def actions(self, situation: Situation) -> np.ndarray:
        """Random actions."""
        count = len(situation.active)
        if situation.last_actions is None:
            self.streams = [np.random.default_rng([self.seed, i]) for i in range(count)]
        return np.array([stream.integers(self.num_actions) for stream in self.streams], np.int64)


class OracleFollower:
    """First action of the shortest path to the person's pose on the full map; stays when there."""

    def actions(self, situation: Situation) -> np.ndarray:
        """The expert's actions."""
        return np.asarray(situation.env.expert_actions("follower"), np.int64)


class OptimalAgent:
    """The exact full-state optimum."""

    def __init__(self, policy: OraclePolicy) -> None:
        self.policy = policy

    def actions(self, situation: Situation) -> np.ndarray:
        """The oracle's actions."""
        return np.asarray(self.policy.actions(situation.env), np.int64)


class LastSeenFollower:
    """Walks to where it last saw the person, by a shortest path past the walls that it sees now, and stays there.

    With nothing to remember, or no way there, it goes straight ahead, and turns left where that is blocked.
    """

    reach = 6  # cells around the robot that the path search considers

    def __init__(self, geometry: ViewGeometry) -> None:
        self.geometry = geometry
        self.memory: list[Pose | None] = []

    def actions(self, situation: Situation) -> np.ndarray:
        """Actions by the last seen pose."""
        views = situation.observation["view"]
        configurations = np.asarray(situation.observation["configuration"])
        if situation.last_actions is None:
            self.memory = [None] * len(views)
            self._fronts = np.zeros(len(views), np.bool_)
        poses = self.geometry.relative(configurations)
        actions = np.full(len(views), STAY, np.int64)
        for i in np.flatnonzero(situation.active):
            if configurations[i] > 0:
                self.memory[i] = (int(poses[i, 0]), int(poses[i, 1]), int(poses[i, 2]))
            elif situation.last_actions is not None:
                self.memory[i] = _carried(self.memory[i], int(situation.last_actions[i]), bool(self._fronts[i]))
            walls = self._walls(views[i])
            blocked = (0, 1) in walls or (configurations[i] > 0 and tuple(poses[i, :2]) == (0, 1))
            self._fronts[i] = not blocked
            actions[i] = self._towards(self.memory[i], walls)
        return actions

    def _walls(self, view: np.ndarray) -> set[tuple[int, int]]:
        """Cells (side, ahead) where the view shows a wall."""
        x0, y0 = self.geometry.viewer
        return {(int(vx) - x0, y0 - int(vy)) for vx, vy in np.argwhere(view == WALL)}

    def _towards(self, goal: Pose | None, walls: set[tuple[int, int]]) -> int:
        searching = LEFT if (0, 1) in walls else FORWARD
        if goal is None:
            return searching
        start: Pose = (0, 0, 3)
        if goal == start:
            return STAY
        # A* with the tie-breaking of the task's own paths: among shortest ways, the one that turns late keeps the
        # person in view; one that turns first loses it (12.8 instead of 90.5 on `paper`).
        first: dict[Pose, int] = {start: STAY}
        cost = {start: 0}
        queue = [(_estimate(start, goal), start)]
        while queue:
            _, pose = heapq.heappop(queue)
            if pose == goal:
                return first[pose]
            for action in (LEFT, RIGHT, FORWARD):
                after = _moved(pose, action)
                side, ahead, _ = after
                if (side, ahead) in walls or max(abs(side), abs(ahead)) > self.reach:
                    continue
                if cost[pose] + 1 < cost.get(after, 1 << 30):
                    cost[after] = cost[pose] + 1
                    first[after] = action if pose == start else first[pose]
                    heapq.heappush(queue, (cost[after] + _estimate(after, goal), after))
        return searching


def _estimate(pose: Pose, goal: Pose) -> float:
    """The task's heuristic: city-block distance, and half the turns left."""
    turns = abs(pose[2] - goal[2])
    return abs(pose[0] - goal[0]) + abs(pose[1] - goal[1]) + 0.5 * min(turns, 4 - turns)


_AHEAD = ((1, 0), (0, -1), (-1, 0), (0, 1))  # heading -> (side, ahead); 3 is the robot's own direction


def _moved(pose: Pose, action: int) -> Pose:
    side, ahead, heading = pose
    if action == LEFT:
        return side, ahead, (heading - 1) % 4
    if action == RIGHT:
        return side, ahead, (heading + 1) % 4
    step = _AHEAD[heading]
    return side + step[0], ahead + step[1], heading


def _carried(pose: Pose | None, action: int, free: bool) -> Pose | None:
    """A remembered pose as the robot sees it after its own action."""
    if pose is None:
        return None
    side, ahead, heading = pose
    if action == LEFT:
        return ahead, -side, (heading + 1) % 4
    if action == RIGHT:
        return -ahead, side, (heading - 1) % 4
    if action == FORWARD and free:
        return side, ahead - 1, heading
    return pose
