"""The person-following task in slow plain Python, written from the task's description alone.

Every rule is spelled out once more here, with dictionaries, lists and Python's own heapq, so that the compiled
rules can be held against it step by step.
"""

from __future__ import annotations

import heapq
from functools import lru_cache

STEPS = {0: (1, 0), 1: (0, 1), 2: (-1, 0), 3: (0, -1)}
LEFT, RIGHT, FORWARD, STAY = 0, 1, 2, 3


def astar(grid, start, goal, goal_heading, compare):
    """The A* of the task: actions from `start` (x, y, heading) to the cell `goal`, or None."""
    walls = tuple(tuple(cell == 1 for cell in column) for column in grid)
    path = _astar(walls, start, goal, goal_heading, compare)
    return None if path is None else list(path)


@lru_cache(maxsize=200_000)
def _astar(walls, start, goal, goal_heading, compare):

    def heuristic(x, y, h):
        value = abs(x - goal[0]) + abs(y - goal[1])
        if goal_heading is not None:
            difference = abs(h - goal_heading)
            value += 0.5 * min(difference, 4 - difference)
        return value

    open_heap = [(heuristic(*start), *start)]
    cost = {start: 0}
    came = {start: None}
    while open_heap:
        _, x, y, h = heapq.heappop(open_heap)
        node = (x, y, h)
        if (x, y) == goal and (not compare or h == goal_heading):
            actions = []
            while came[node] is not None:
                node, action = came[node]
                actions.append(action)
            return tuple(actions[::-1])
        forward = (x + STEPS[h][0], y + STEPS[h][1], h)
        for action, following in ((LEFT, (x, y, (h - 1) % 4)), (RIGHT, (x, y, (h + 1) % 4)), (FORWARD, forward)):
            if not (0 <= following[0] < len(walls) and 0 <= following[1] < len(walls)):
                continue
            if walls[following[0]][following[1]]:
                continue
            new_cost = cost[node] + 1
            if following not in cost or new_cost < cost[following]:
                cost[following] = new_cost
                came[following] = (node, action)
                heapq.heappush(open_heap, (new_cost + heuristic(*following), *following))
    return None


def view_of(grid, pose, view_size, see_through_walls):
    """Cell kinds seen from a pose, as a list of columns [vx][vy]."""
    x, y, h = pose
    fx, fy = STEPS[h]
    rx, ry = STEPS[(h + 1) % 4]
    view = [[1] * view_size for _ in range(view_size)]
    for vx in range(view_size):
        for vy in range(view_size):
            side, ahead = vx - view_size // 2, view_size - 1 - vy
            cx, cy = x + ahead * fx + side * rx, y + ahead * fy + side * ry
            if 0 <= cx < len(grid) and 0 <= cy < len(grid):
                view[vx][vy] = int(grid[cx][cy])
    if not see_through_walls:
        mask = visible_mask(view, view_size)
        for vx in range(view_size):
            for vy in range(view_size):
                if not mask[vx][vy]:
                    view[vx][vy] = 3
    view[view_size // 2][view_size - 1] = 0
    return view


def visible_mask(view, n):
    """Minigrid's Grid.process_vis for a viewer in the middle of the last row."""
    mask = [[False] * n for _ in range(n)]
    mask[n // 2][n - 1] = True
    for j in reversed(range(n)):
        for i in range(n - 1):
            if mask[i][j] and view[i][j] != 1:
                mask[i + 1][j] = True
                if j > 0:
                    mask[i + 1][j - 1] = True
                    mask[i][j - 1] = True
        for i in reversed(range(1, n)):
            if mask[i][j] and view[i][j] != 1:
                mask[i - 1][j] = True
                if j > 0:
                    mask[i - 1][j - 1] = True
                    mask[i][j - 1] = True
    return mask


class Reference:
    """One environment; `random_turn` supplies the person's draws at its goal (0 left, 1 right)."""

    def __init__(
        self,
        random_turn,
        view_size=5,
        see_through_walls=True,
        max_steps=200,
        follow_distance=3,
        max_lost=3,
        look_back=True,
        person_rest=0,
        robot_rest=0,
        goal_patience=0,
        compare_heading="unless-0",
        keep_waiting=True,
        person_knows="map",
        goal_moves_at=0,
        turns_at_goal=True,
        **_,
    ):
        self.__dict__.update({k: v for k, v in locals().items() if k not in ("self", "_")})
        self.waiting = 0

    def reset(self, grid, waiting=None, person=(2, 2, 0), goal=None, goals=None):
        self.grid = [[int(cell) for cell in column] for column in grid]
        self.goal = goal or next((x, y) for x, column in enumerate(self.grid) for y, c in enumerate(column) if c == 2)
        self.agent = (1, 1, 0)
        self.person = person
        self.grid[person[0]][person[1]] = 0
        if not self.keep_waiting:
            self.waiting = 0
        if waiting is not None:
            self.waiting = waiting
        self.t = self.lost = self.at_goal = 0
        self.goals = goals or [self.goal]
        self.believed = self.goal
        n = len(self.grid)
        edge = (0, n - 1)
        self.known = [[1 if x in edge or y in edge else 0 for y in range(n)] for x in range(n)]
        if self.person_knows == "seen":
            self.person_learns()
        self.plan = self.person_plans()
        return self.observe()

    def distance(self):
        heading = self.person[2]
        compare = {"always": True, "never": False, "unless-0": heading != 0}[self.compare_heading]
        in_heuristic = None if self.compare_heading == "never" else heading
        path = astar(self.grid, self.agent, self.person[:2], in_heuristic, compare)
        return 0 if path is None else len(path)

    def relative(self):
        """(side, ahead, heading) of the person."""
        fx, fy = STEPS[self.agent[2]]
        rx, ry = STEPS[(self.agent[2] + 1) % 4]
        dx, dy = self.person[0] - self.agent[0], self.person[1] - self.agent[1]
        return dx * rx + dy * ry, dx * fx + dy * fy, (self.person[2] - self.agent[2] - 1) % 4

    def configuration(self):
        side, ahead, heading = self.relative()
        half = self.view_size // 2
        if not (-half <= side <= half and 0 <= ahead < self.view_size) or (side, ahead) == (0, 0):
            return 0
        vx, vy = half + side, self.view_size - 1 - ahead
        if view_of(self.grid, self.agent, self.view_size, self.see_through_walls)[vx][vy] == 3:
            return 0
        return 1 + (vx * self.view_size + vy) * 4 + heading

    def shown(self):
        """The grid without the person, whose own cell is empty whatever it stands on."""
        grid = [column[:] for column in self.grid]
        grid[self.person[0]][self.person[1]] = 0
        return grid

    def observe(self):
        return view_of(self.shown(), self.agent, self.view_size, self.see_through_walls), self.configuration()

    def goal_hidden(self):
        """Whether the robot sees the person on a goal cell, which it then does not see."""
        return self.grid[self.person[0]][self.person[1]] == 2 and self.configuration() != 0

    def person_view(self):
        return view_of(self.grid, self.person, self.view_size, self.see_through_walls)

    def greedy(self):
        """First action of the A* path to the person's pose; stay when there."""
        heading = self.person[2]
        compare = {"always": True, "never": False, "unless-0": heading != 0}[self.compare_heading]
        in_heuristic = None if self.compare_heading == "never" else heading
        path = astar(self.grid, self.agent, self.person[:2], in_heuristic, compare)
        return path[0] if path else STAY

    def step(self, action):
        """(observation, reward, terminated, truncated, outcome, person's action)."""
        self.t += 1
        if self.t == self.goal_moves_at and not self.person_sees(self.goal):
            self.grid[self.goal[0]][self.goal[1]] = 0
            self.goal = self.goals[(self.goals.index(self.goal) + 1) % len(self.goals)]
        if self.robot_rest and self.t % self.robot_rest == 0:
            action = STAY
        x, y, h = self.agent
        entered = False
        if action == LEFT:
            self.agent = (x, y, (h - 1) % 4)
        elif action == RIGHT:
            self.agent = (x, y, (h + 1) % 4)
        elif action == FORWARD:
            nx, ny = x + STEPS[h][0], y + STEPS[h][1]
            if self.grid[nx][ny] != 1 and (nx, ny) != self.person[:2]:
                self.agent = (nx, ny, h)
                entered = (nx, ny) == self.goal
        reward = 1 - 0.9 * (self.t / self.max_steps) if entered else 0.0

        did = self.person_step()

        d, sees = self.distance(), self.configuration() != 0
        at_goal = self.person[:2] == self.goal
        self.at_goal = self.at_goal + 1 if at_goal else 0
        front = (self.agent[0] + STEPS[self.agent[2]][0], self.agent[1] + STEPS[self.agent[2]][1])
        if action == FORWARD and self.person[:2] == front:
            reward -= 0.01
        if self.person[:2] == self.agent[:2]:
            reward -= 0.01
        success = lost = unescorted = False
        if d <= self.follow_distance:
            self.lost = 0
            if d > 0:
                reward += 1.5 / (1 + d)
            if sees:
                reward += 0.5
            if at_goal and sees:
                reward += 100
                success = True
        else:
            self.lost += 1
            reward -= 0.05 * d
            lost = self.lost >= self.max_lost
            unescorted = at_goal and self.at_goal > self.goal_patience
        timeout = self.t >= self.max_steps
        outcomes = (
            ("success", success),
            ("agent_at_goal", entered),
            ("lost", lost),
            ("unescorted", unescorted),
            ("timeout", timeout),
        )
        outcome = next((name for name, holds in outcomes if holds), "")
        return self.observe(), reward, success or entered, lost or unescorted or timeout, outcome, did

    def person_step(self):
        if self.person_rest and self.t % self.person_rest == 0:
            return STAY
        if self.look_back and (self.configuration() == 0 or self.distance() > self.follow_distance):
            self.waiting += 1
            if self.waiting < 3:
                return STAY
        self.waiting = 0
        if not self.plan:
            self.plan = self.person_plans()
            if not self.plan and self.turns_at_goal:
                self.plan = [self.random_turn()] * 2
            if not self.plan:
                return STAY
        action = self.plan.pop(0)
        x, y, h = self.person
        if action == LEFT:
            self.person = (x, y, (h - 1) % 4)
        elif action == RIGHT:
            self.person = (x, y, (h + 1) % 4)
        else:
            self.person = (x + STEPS[h][0], y + STEPS[h][1], h)
        self.person_learns()
        return action

    def person_plans(self):
        grid = self.known if self.person_knows == "seen" else self.grid
        return astar(grid, self.person, self.believed, None, False) or []

    def seen_cells(self):
        """Map cells that the person sees, its own included."""
        x, y, h = self.person
        fx, fy = STEPS[h]
        rx, ry = STEPS[(h + 1) % 4]
        view = self.person_view()
        cells = set()
        for vx in range(self.view_size):
            for vy in range(self.view_size):
                side, ahead = vx - self.view_size // 2, self.view_size - 1 - vy
                if view[vx][vy] != 3:
                    cells.add((x + ahead * fx + side * rx, y + ahead * fy + side * ry))
        return {(cx, cy) for cx, cy in cells if 0 <= cx < len(self.grid) and 0 <= cy < len(self.grid)}

    def person_sees(self, cell):
        return cell in self.seen_cells()

    def person_learns(self):
        """Keep what is seen; give up a plan that leads through a seen wall, and a goal seen to be gone."""
        if self.person_knows == "seen":
            for x, y in self.seen_cells():
                self.known[x][y] = self.grid[x][y]
            x, y, h = self.person
            for action in getattr(self, "plan", None) or []:
                if action == FORWARD:
                    x, y = x + STEPS[h][0], y + STEPS[h][1]
                    if self.known[x][y] == 1:
                        self.plan = []
                        break
                else:
                    h = (h + (-1 if action == LEFT else 1)) % 4
        if self.goal_moves_at and self.believed != self.goal and self.person_sees(self.believed):
            self.believed = self.goal
            self.plan = []
