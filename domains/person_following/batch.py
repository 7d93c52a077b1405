"""B environments over the compiled rules: what the single and the batched Gymnasium class share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from domains.core import GOAL, DomainError, ViewGeometry
from domains.person_following import rules as kernel
from domains.person_following.random_numbers import seeded_stream
from domains.person_following.store import shared_store
from domains.person_following.variants import CYCLED, DRAWN, GENERATED, Parameters, parameters_of
from domains.person_following.world import (
    EPISODE,
    HEADING,
    LOST,
    TIME,
    WAITING,
    X,
    Y,
    allocate_results,
    allocate_world,
)

TASKS = ("crossing", "following")
EXPERTS = ("goal", "follower")
NUM_ACTIONS = 4


class Batch:
    """B environments over the compiled rules, without the manners of Gymnasium.

    Both environment classes hold one of these; they add spaces, seeding and the shape of what is returned.
    """

    def __init__(
        self,
        task: str,
        num_envs: int,
        variant: str,
        maps: NDArray[np.uint8] | None,
        cycle: bool,
        changes: dict[str, Any],
    ) -> None:
        """Allocate B environments.

        Raises:
            DomainError: an unknown task, variant or parameter, or maps that cannot be played.
        """
        if task not in TASKS:
            raise DomainError(f"unknown task '{task}': known are {', '.join(TASKS)}")
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise DomainError(f"num_envs must be a positive whole number, got {num_envs!r}")
        self.task, self.variant = task, variant
        self.parameters: Parameters = parameters_of(variant, task, **changes)
        self.geometry = ViewGeometry(self.parameters.view_size)
        self.num_envs = int(num_envs)
        size = self.parameters.size
        source = GENERATED
        self.maps = np.zeros((0, size, size), np.uint8)
        if maps is not None:
            self.maps = np.ascontiguousarray(np.stack([self.checked_grid(grid) for grid in np.asarray(maps)]))
            source = CYCLED if cycle else DRAWN
        self.rules = self.parameters.rules(following=task == "following", map_source=source)
        self.store = shared_store(size, self.parameters.heading_rule)
        self.world = allocate_world(self.num_envs, self.parameters)
        self.last = allocate_results(self.num_envs, self.parameters.view_size)
        self.seeded = False

    def checked_grid(self, grid: Any) -> NDArray[np.uint8]:
        """A map given by the caller, as the kernel wants it.

        Raises:
            DomainError: a wrong shape, kind or border, not exactly one goal, or a goal out of reach.
        """
        size = self.parameters.size
        cells = np.asarray(grid)
        if cells.shape != (size, size):
            raise DomainError(f"grid must have shape ({size}, {size}), got {cells.shape}")
        if cells.dtype.kind not in "iu" or ((cells < 0) | (cells > GOAL)).any():
            raise DomainError("grid must hold whole numbers: 0 empty, 1 wall, 2 goal")
        cells = cells.astype(np.uint8)
        border = np.concatenate([cells[0], cells[-1], cells[:, 0], cells[:, -1]])
        if (border != 1).any():
            raise DomainError("grid must have walls (1) all around its border")
        if np.count_nonzero(cells == GOAL) != 1:
            raise DomainError(f"grid must have exactly one goal (2), got {np.count_nonzero(cells == GOAL)}")
        following = self.task == "following"
        for name, x, y, needed in (("robot", 1, 1, True), ("person", 2, 2, following)):
            if not needed:
                continue
            if cells[x, y] == GOAL or (cells[x, y] == 1 and name == "robot"):
                raise DomainError(f"grid cell ({x}, {y}), where the {name} starts, must be empty")
            if not _reaches_goal(cells, x, y):
                raise DomainError(f"the goal cannot be reached from ({x}, {y}), where the {name} starts")
        return cells

    def seed(self, seeds: list[int]) -> None:
        """Make environment i what a new one with `seeds[i]` is: a seed fixes all that follows.

        So the waiting counter, which otherwise lives on from episode to episode, starts at 0 too.
        """
        for i, seed in enumerate(seeds):
            self.world.stream[i] = seeded_stream(seed)
        self.world.robot[:, EPISODE] = 0
        self.world.person[:, WAITING] = 0
        self.seeded = True

    def checked_options(self, options: dict[str, Any] | None) -> Callable[[], None]:
        """What begins new episodes everywhere, on a given grid and with a given waiting counter if so wished.

        Raises:
            DomainError: an unknown option or a bad value; nothing has changed then.
        """
        given = dict(options or {})
        unknown = sorted(set(given) - {"grid", "waiting"})
        if unknown:
            raise DomainError(f"unknown reset option '{unknown[0]}': known are grid, waiting")
        grid = self.checked_grid(given["grid"]) if given.get("grid") is not None else None
        waiting = given.get("waiting")
        if waiting is not None and (
            isinstance(waiting, bool) or not isinstance(waiting, int | np.integer) or not 0 <= waiting <= 2
        ):
            raise DomainError(f"option 'waiting' must be 0, 1 or 2, got {waiting!r}")
        return lambda: self._begin(grid, None if waiting is None else int(waiting))

    def _begin(self, grid: NDArray[np.uint8] | None, waiting: int | None) -> None:
        if grid is not None:
            self.world.grid[:] = grid
        everywhere = np.ones(self.num_envs, np.bool_)
        kernel.begin_batch(self.rules, self.world, self.store, self.maps, everywhere, grid is not None, self.last)
        if self.task == "following":
            kernel.measure_batch(self.world, self.store, self.last.distance)
        else:
            self.last.distance[:] = 0
        if waiting is not None:
            self.world.person[:, WAITING] = waiting

    def step(self, actions: NDArray[np.int64], autoreset: bool) -> None:
        """Take a step everywhere; the results lie in `last`, which is new every time."""
        self.last = allocate_results(self.num_envs, self.parameters.view_size)
        last = self.last
        ended = kernel.step_batch(self.rules, self.world, self.store, actions, last)
        if autoreset and ended:
            last.robot_view[:] = last.final_view
            last.configuration[:] = last.final_configuration
            kernel.begin_batch(self.rules, self.world, self.store, self.maps, last.ended, False, last)
        else:
            self.last = last._replace(robot_view=last.final_view, configuration=last.final_configuration)

    def describe(self) -> tuple[NDArray[np.uint8], NDArray[np.int16], NDArray[np.int16]]:
        """Person views, relative poses and counters of the present states; crossing has no person."""
        width = self.parameters.view_size
        if self.task == "crossing":
            return (
                np.full((self.num_envs, width, width), 3, np.uint8),
                np.zeros((self.num_envs, 3), np.int16),
                np.zeros((self.num_envs, 2), np.int16),
            )
        views = np.empty((self.num_envs, width, width), np.uint8)
        poses = np.empty((self.num_envs, 3), np.int16)
        counters = np.empty((self.num_envs, 2), np.int16)
        kernel.describe_batch(self.rules, self.world, views, poses, counters)
        return views, poses, counters

    def expert(self, kind: str) -> NDArray[np.int64]:
        """First actions of A* paths on the full map.

        Raises:
            DomainError: an unknown kind, or a follower where there is nobody to follow.
        """
        if kind not in EXPERTS:
            raise DomainError(f"unknown expert '{kind}': known are {', '.join(EXPERTS)}")
        if kind == "follower" and self.task == "crossing":
            raise DomainError("the crossing task has no person to follow: use the expert 'goal'")
        actions = np.empty(self.num_envs, np.int64)
        kernel.expert_batch(self.world, self.store, kind == "follower", actions)
        return actions

    def state(self, index: int) -> dict[str, Any]:
        """The full state of one environment, as plain numbers and a copy of the grid."""
        robot, person = self.world.robot[index], self.world.person[index]
        goal_x, goal_y = np.argwhere(self.world.grid[index] == GOAL)[0]
        return {
            "grid": self.world.grid[index].copy(),
            "agent": (int(robot[X]), int(robot[Y]), int(robot[HEADING])),
            "person": (int(person[X]), int(person[Y]), int(person[HEADING])),
            "goal": (int(goal_x), int(goal_y)),
            "waiting": int(person[WAITING]),
            "lost": int(robot[LOST]),
            "t": int(robot[TIME]),
        }


def _reaches_goal(grid: NDArray[np.uint8], x: int, y: int) -> bool:
    """Whether a path of free cells leads from (x, y) to the goal."""
    seen = {(x, y)}
    frontier = [(x, y)]
    while frontier:
        cx, cy = frontier.pop()
        if grid[cx, cy] == GOAL:
            return True
        for nx, ny in ((cx + 1, cy), (cx - 1, cy), (cx, cy + 1), (cx, cy - 1)):
            if (nx, ny) not in seen and grid[nx, ny] != 1:
                seen.add((nx, ny))
                frontier.append((nx, ny))
    return False


def observation_space(geometry: ViewGeometry) -> spaces.Dict:
    """The space of one environment's observations."""
    width = geometry.view_size
    return spaces.Dict(
        {
            "view": spaces.Box(0, 3, (width, width), np.uint8),
            "configuration": spaces.Discrete(geometry.num_configurations),
        }
    )


def checked_actions(actions: Any, num_envs: int) -> NDArray[np.int64]:
    """Actions as the kernel wants them.

    Raises:
        DomainError: a wrong shape or type, or an action outside 0..3.
    """
    array = np.asarray(actions)
    if array.dtype.kind not in "iu":
        raise DomainError(f"actions must be whole numbers, got dtype {array.dtype}")
    if array.shape != (num_envs,):
        raise DomainError(f"actions must have shape ({num_envs},), got {array.shape}")
    if ((array < 0) | (array >= NUM_ACTIONS)).any():
        wrong = array[(array < 0) | (array >= NUM_ACTIONS)][0]
        raise DomainError(f"actions must be in 0..{NUM_ACTIONS - 1}, got {wrong}")
    return np.ascontiguousarray(array, dtype=np.int64)
