"""B environments over the compiled rules: what the single and the batched Gymnasium class share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from domains.core import EMPTY, GOAL, DomainError, ViewGeometry
from domains.person_following.simulation import episodes, people
from domains.person_following.simulation import rules as kernel
from domains.person_following.simulation.random_numbers import seeded_stream
from domains.person_following.simulation.starts import CORNER, TRIED, Starts
from domains.person_following.simulation.store import shared_store
from domains.person_following.simulation.world import (
    BELIEVED_X,
    BELIEVED_Y,
    EPISODE,
    GOAL_X,
    GOAL_Y,
    HEADING,
    LAST_ACTION,
    LOST,
    TIME,
    WAITING,
    Results,
    X,
    Y,
    allocate_results,
    allocate_world,
)
from domains.person_following.variants import CYCLED, DRAWN, GENERATED, Parameters

TASKS = ("crossing", "following")
EXPERTS = ("goal", "follower")
NUM_ACTIONS = 4
_NO_GAPS = np.empty(0, np.int64)


class Batch:
    """B environments over the compiled rules, without the manners of Gymnasium.

    Both environment classes hold one of these; they add spaces, seeding and the shape of what is returned.
    """

    def __init__(
        self,
        task: str,
        num_envs: int,
        parameters: Parameters,
        maps: NDArray[np.uint8] | None = None,
        cycle: bool = False,
    ) -> None:
        """Allocate B environments.

        Raises:
            DomainError: an unknown task, or maps that cannot be played.
        """
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise DomainError(f"num_envs must be a positive whole number, got {num_envs!r}")
        self.task, self.parameters = task, parameters
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
        self.starts = Starts(self.parameters, lambda parameters: Batch("following", TRIED, parameters))
        self._own = np.full(self.num_envs, -1, np.int64)
        self._corner = np.full((self.num_envs, 2), CORNER, np.int64)
        self.seeded = False
        # What only some rules ask for lies in kernels of its own.
        following = task == "following"
        self._several_goals = following and parameters.num_goals > 1
        self._sees_only = following and parameters.person_knows == "seen"
        self._goal_moves = following and parameters.goal_moves_at > 0
        self._others = following and parameters.num_persons > 1

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
        goals, most = np.count_nonzero(cells == GOAL), self.parameters.num_goals
        if not 1 <= goals <= most:
            wanted = "exactly one goal (2)" if most == 1 else f"1 to {most} goals (2)"
            raise DomainError(f"grid must have {wanted}, got {goals}")
        following = self.task == "following" and self.parameters.person_start == "corner"
        for name, x, y, needed in (("robot", 1, 1, True), ("person", 2, 2, following)):
            if not needed:
                continue
            if cells[x, y] == GOAL or (cells[x, y] == 1 and name == "robot"):
                raise DomainError(f"grid cell ({x}, {y}), where the {name} starts, must be empty")
            if not _reaches_goal(cells, x, y):
                raise DomainError(f"the goal cannot be reached from ({x}, {y}), where the {name} starts")
        return cells

    def seed(self, seeds: Sequence[int | None]) -> None:
        """Make environment i what a new one with `seeds[i]` is: a seed fixes all that follows.

        So the waiting counter, which otherwise lives on from episode to episode, starts at 0 too. None leaves an
        environment as it is.
        """
        for i, seed in enumerate(seeds):
            if seed is not None:
                self.world.stream[i] = seeded_stream(seed)
                self.world.robot[i, EPISODE] = 0
                self.world.person[i, WAITING] = 0
        self.seeded = True

    def checked_options(
        self, options: dict[str, Any] | None, chosen: NDArray[np.bool_] | None = None
    ) -> Callable[[], None]:
        """What begins new episodes, on a given grid and with a given waiting counter if so wished.

        Args:
            options: `grid` and `waiting`; None for neither.
            chosen: [B], where; None for everywhere.

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
        where = np.ones(self.num_envs, np.bool_) if chosen is None else chosen
        return lambda: self._begin(where, grid, None if waiting is None else int(waiting))

    def _begin(self, chosen: NDArray[np.bool_], grid: NDArray[np.uint8] | None, waiting: int | None) -> None:
        if grid is not None:
            self.world.grid[chosen] = grid
        else:
            episodes.choose_batch(self.rules, self.world, self.maps, chosen)
        self.last.distance[chosen] = 0
        self._begin_where(chosen, self.last.distance)
        if waiting is not None:
            self.world.person[chosen, WAITING] = waiting

    def _begin_where(self, chosen: NDArray[np.bool_], gaps: NDArray[np.int64] = _NO_GAPS) -> None:
        """Begin episodes on the maps that lie in the grids; `gaps` [B], if given, gets the distances."""
        starts = self._corner
        if self.parameters.person_start != "corner" and self.task == "following":
            starts = self._corner.copy()
            starts[chosen] = self.starts.of(self.world.grid[chosen])
        self._begin_at(starts, self._own, chosen, gaps)

    def _begin_at(
        self,
        starts: NDArray[np.int64],
        own: NDArray[np.int64],
        chosen: NDArray[np.bool_],
        gaps: NDArray[np.int64] = _NO_GAPS,
    ) -> None:
        rules, world = self.rules, self.world
        if self._several_goals:
            episodes.place_goals(rules, world, self.store, chosen, starts)
        episodes.begin_batch(rules, world, self.store, chosen, starts, own, self.last, gaps)
        if self._others:
            people.place_others(world, chosen)
        if self._sees_only:
            people.begin_to_think(rules, world, self.store, chosen)

    def detach(self) -> None:
        """Give `last` arrays of its own, so that what comes next does not change those that callers hold."""
        self.last = Results._make(array.copy() for array in self.last)

    def step(self, actions: NDArray[np.int64], autoreset: bool, reuse: bool = False) -> None:
        """Take a step everywhere; the results lie in `last`, whose arrays are new unless they may be reused."""
        if not reuse:
            self.last = allocate_results(self.num_envs, self.parameters.view_size)
        last = self.last
        if self._goal_moves:
            people.move_goals(self.rules, self.world)
        ended = kernel.step_batch(self.rules, self.world, self.store, actions, last)
        if ended and self.parameters.lost_ends == "terminated":
            alone = (last.outcome == kernel.LOST_PERSON) | (last.outcome == kernel.UNESCORTED)
            last.terminated[:] |= alone
            last.truncated[:] &= ~alone
        if self._sees_only or self._goal_moves:
            people.think_batch(self.rules, self.world, self.store)
        if self._others:
            people.move_others(self.world, self.store)
        if autoreset and ended:
            last.robot_view[:] = last.final_view
            last.configuration[:] = last.final_configuration
            episodes.choose_batch(self.rules, self.world, self.maps, last.ended)
            self._begin_where(last.ended)
        else:
            self.last = last._replace(robot_view=last.final_view, configuration=last.final_configuration)

    def step_or_begin(self, actions: NDArray[np.int64], begins: NDArray[np.bool_]) -> None:
        """Begin an episode where `begins` [B], take a step elsewhere; the results lie in `last`.

        Where an episode begins, nothing is paid and nothing ends.
        """
        rows = np.flatnonzero(begins)
        before = [array[rows] for array in self.world if len(array) == self.num_envs]
        self.step(actions, False)
        if not len(rows):
            return
        for array, kept in zip((a for a in self.world if len(a) == self.num_envs), before, strict=True):
            array[rows] = kept  # as if the step had not been taken there, random numbers included
        last = self.last
        last.reward[rows], last.outcome[rows] = 0, 0
        for flags in (last.terminated, last.truncated, last.ended):
            flags[rows] = False
        self._begin(begins, None, None)
        last.visible[rows] = last.configuration[rows] > 0
        last.person_action[rows] = self.world.person[rows, LAST_ACTION]

    def begin_worlds(self, grids: NDArray[np.uint8], own: NDArray[np.int64]) -> None:
        """Begin environment i on the raw map `grids[i]`, the candidate `own[i]` being the person's goal."""
        self.world.grid[:] = grids
        self._own = own.astype(np.int64)
        self._begin_where(np.ones(self.num_envs, np.bool_))

    def follower_succeeds(self, grid: NDArray[np.uint8], starts: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether a greedy follower succeeds [B] on one map, the person at each of some starts [B, 2]."""
        self.world.grid[:] = grid
        everywhere = np.ones(self.num_envs, np.bool_)
        self.world.stream[:] = seeded_stream(0)
        own = np.zeros(self.num_envs, np.int64)
        self._begin_at(starts, own, everywhere)
        won, running = np.zeros(self.num_envs, np.bool_), everywhere.copy()
        for _ in range(self.parameters.max_steps):
            self.step(self.expert("follower"), False)
            won |= running & (self.last.outcome == kernel.SUCCESS)
            running &= ~self.last.ended
            if not running.any():
                break
        return won

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
        state: dict[str, Any] = {
            "grid": self.world.grid[index].copy(),
            "agent": (int(robot[X]), int(robot[Y]), int(robot[HEADING])),
            "person": (int(person[X]), int(person[Y]), int(person[HEADING])),
            "goal": (int(person[GOAL_X]), int(person[GOAL_Y])),
            "waiting": int(person[WAITING]),
            "lost": int(robot[LOST]),
            "t": int(robot[TIME]),
        }
        if self.task == "following":
            # The person takes the place of whatever is on its cell.
            state["grid"][state["person"][:2]] = EMPTY
        if self.parameters.num_goals > 1:
            goals = self.world.goals[index, : self.parameters.num_goals].tolist()
            state["goals"] = [(x, y) for x, y in goals]
            state["believed_goal"] = (int(person[BELIEVED_X]), int(person[BELIEVED_Y]))
        if self.parameters.person_knows == "seen" and self.task == "following":
            state["known"] = self.world.known[index].copy()
        if self.parameters.num_persons > 1:
            state["others"] = [(int(x), int(y), int(h)) for x, y, h in self.world.others[index, :, :3]]
        return state


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


def checked_task(task: str) -> str:
    """The task, if there is one of that name.

    Raises:
        DomainError: there is none.
    """
    if task not in TASKS:
        raise DomainError(f"unknown task '{task}': known are {', '.join(TASKS)}")
    return task


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
