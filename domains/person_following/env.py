"""The task as a single Gymnasium environment, over the same compiled rules as the batched one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from domains.core import OUTCOMES, DomainError, ViewGeometry
from domains.person_following.simulation.batch import (
    NUM_ACTIONS,
    Batch,
    checked_actions,
    checked_task,
    observation_space,
)
from domains.person_following.simulation.random_numbers import stream_of, write_back
from domains.person_following.variants import parameters_of

if TYPE_CHECKING:
    from domains.person_following.render import Window


class PersonFollowingEnv(gymnasium.Env):
    """One environment of the person-following or the crossing task.

    Observation: `view` uint8 [v, v] of cell kinds indexed [vx, vy], the person removed, and `configuration`,
    0 where the person is unseen. Actions: left, right, forward, stay.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 6}  # noqa: RUF012

    def __init__(
        self,
        task: str = "following",
        variant: str = "paper",
        render_mode: str | None = None,
        maps: NDArray[np.uint8] | None = None,
        cycle: bool = False,
        **parameters: Any,
    ) -> None:
        """Make an environment of a variant, with single parameters changed by keyword."""
        self.batch = Batch(task, 1, parameters_of(variant, checked_task(task), **parameters), maps, cycle)
        self.observation_space = observation_space(self.batch.geometry)
        self.action_space = spaces.Discrete(NUM_ACTIONS)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise DomainError(f"unknown render_mode '{render_mode}': known are rgb_array, human")
        self.render_mode = render_mode
        self._window: Window | None = None
        self._actions = np.zeros(1, np.int64)

    @property
    def geometry(self) -> ViewGeometry:
        """Coordinates of the view."""
        return self.batch.geometry

    @property
    def np_random(self) -> np.random.Generator:
        """The environment's generator, at the place that the compiled rules have reached in its stream."""
        if not self.batch.seeded:
            self.np_random = np.random.default_rng()
        if self._np_random is None:
            self._np_random = np.random.default_rng(0)
        write_back(self.batch.world.stream[0], self._np_random)
        return self._np_random

    @np_random.setter
    def np_random(self, value: np.random.Generator) -> None:
        self._np_random = value
        self.batch.world.stream[0] = stream_of(value)
        self.batch.seeded = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: makes the environment as good as new, with this seed; None goes on with the present generator.
            options: `grid` [size, size] (0 empty, 1 wall, 2 goal) to start on, `waiting` (0..2) to start with.

        Raises:
            DomainError: a grid that cannot be played, or an unknown option; the state is then as it was.
        """
        batch = self.batch
        begin = batch.checked_options(options)
        super().reset(seed=seed)
        if seed is not None:
            batch.seed([seed])
        elif not batch.seeded:
            self.np_random = np.random.default_rng()
        begin()
        last = batch.last
        observation = {"view": last.robot_view[0].copy(), "configuration": last.configuration[0]}
        if self.render_mode == "human":
            self.render()
        return observation, {"distance": int(last.distance[0]), "visible": bool(last.configuration[0] > 0)}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Take one action.

        Raises:
            DomainError: not a whole number in 0..3; the state is then as it was.
        """
        if type(action) is int and 0 <= action < NUM_ACTIONS:
            self._actions[0] = action
        else:
            self._actions[:] = checked_actions(np.asarray(action).reshape(-1), 1)
        self.batch.step(self._actions, False, reuse=True)
        last = self.batch.last
        info: dict[str, Any] = {
            "distance": int(last.distance[0]),
            "visible": bool(last.visible[0]),
            "person_action": int(last.person_action[0]),
            "person_waited": bool(last.person_action[0] == 3),
        }
        terminated, truncated = bool(last.terminated[0]), bool(last.truncated[0])
        if terminated or truncated:
            info["outcome"] = OUTCOMES[last.outcome[0]]
        observation = {"view": last.robot_view[0].copy(), "configuration": last.configuration[0]}
        if self.render_mode == "human":
            self.render()
        return observation, float(last.reward[0]), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """A picture uint8 [height, width, 3] in mode `rgb_array`; in mode `human` it is shown in a window."""
        if self.render_mode is None:
            return None
        from domains.person_following.render import Window, render_state

        following = self.batch.task == "following"
        picture = render_state(self.state(), self.batch.last.robot_view[0], person=following)
        if self.render_mode == "rgb_array":
            return picture
        if self._window is None:
            self._window = Window(self.metadata["render_fps"], f"nesy: {self.batch.task}")
        self._window.show(picture)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def state(self) -> dict[str, Any]:
        """The full state: grid, agent, person, goal, waiting, lost, t; plain numbers and a copy of the grid."""
        return self.batch.state(0)

    def expert_action(self, kind: str) -> int:
        """First action of the A* path on the full map, to the `goal` or, as a `follower`, to the person."""
        return int(self.batch.expert(kind)[0])
