"""The task as a Gymnasium vector environment over the compiled rules."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from domains.core import OUTCOMES, DomainError, ViewGeometry
from domains.person_following.simulation.batch import (
    NUM_ACTIONS,
    Batch,
    checked_actions,
    checked_task,
    observation_space,
)
from domains.person_following.simulation.world import (
    BELIEVED_X,
    BELIEVED_Y,
    GOAL_X,
    GOAL_Y,
    HEADING,
    LAST_ACTION,
    LOST,
    TIME,
    WAITING,
    X,
    Y,
)
from domains.person_following.variants import Parameters, parameters_of

_OUTCOME_NAMES = np.array(OUTCOMES)


class PersonFollowingVectorEnv(VectorEnv):
    """B environments stepped by one compiled call; see `domains.core.BatchedEnvironment`.

    Environment i of a batch reset with seed s plays what a single environment reset with seed s + i plays.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "following",
        variant: str = "paper",
        maps: NDArray[np.uint8] | None = None,
        cycle: bool = False,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        """Make a batch; see `domains.core.Domain.make` for `maps` and `cycle`, `Parameters` for the rest."""
        if render_mode is not None:
            raise DomainError("a batched environment is not rendered: use gymnasium.make for one that is")
        self.batch = Batch(task, num_envs, parameters_of(variant, checked_task(task), **parameters), maps, cycle)
        self.num_envs = self.batch.num_envs
        self.single_observation_space = observation_space(self.batch.geometry)
        self.single_action_space = spaces.Discrete(NUM_ACTIONS)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.pending_seed: int | None = None
        self._begun = False

    @property
    def geometry(self) -> ViewGeometry:
        """Coordinates of the views."""
        return self.batch.geometry

    @property
    def parameters(self) -> Parameters:
        """The rules that hold here."""
        return self.batch.parameters

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Begin new episodes everywhere; `options` as for the single environment, for all alike."""
        begin = self.batch.checked_options(options)
        if seed is None:
            seed, self.pending_seed = self.pending_seed, None
        if seed is None and not self.batch.seeded:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        if seed is not None:
            seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
            if len(seeds) != self.num_envs:
                raise DomainError(f"{self.num_envs} seeds are needed, got {len(seeds)}")
            super().reset(seed=int(seeds[0]))
            self.batch.seed([int(one) for one in seeds])
        begin()
        self._begun = True
        last = self.batch.last
        observation: dict[str, NDArray[Any]] = {
            "view": last.robot_view.copy(),
            "configuration": last.configuration.copy(),
        }
        return observation, {"distance": last.distance.copy(), "visible": last.configuration > 0}

    def step(
        self, actions: Any
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Take one action per environment; where an episode ends, the next begins in the same step."""
        if not self._begun:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        checked = checked_actions(actions, self.num_envs)
        self.batch.step(checked, True)
        last = self.batch.last
        infos = {
            "outcome": _OUTCOME_NAMES[last.outcome],
            "outcome_code": last.outcome,
            "distance": last.distance,
            "visible": last.visible,
            "person_action": last.person_action,
            "person_waited": last.person_action == 3,
            "final_obs": {"view": last.final_view, "configuration": last.final_configuration},
            "_final_obs": last.terminated | last.truncated,
            "final_person_view": last.final_person_view,
            "final_relative_pose": last.final_pose,
            "final_counters": last.final_counters,
        }
        observation: dict[str, NDArray[Any]] = {"view": last.robot_view, "configuration": last.configuration}
        return observation, last.reward, last.terminated, last.truncated, infos

    def person_views(self) -> NDArray[np.uint8]:
        """`[B, v, v]`: the person's true views, neither agent shown; UNSEEN throughout in crossing."""
        return self.batch.describe()[0]

    def relative_poses(self) -> NDArray[np.int16]:
        """`[B, 3]` (side, ahead, heading): the person's true poses relative to the robots."""
        return self.batch.describe()[1]

    def person_actions(self) -> NDArray[np.int8]:
        """`[B]`: what each person did in the last step (3: waited); -1 after a reset."""
        return self.batch.world.person[:, LAST_ACTION].astype(np.int8)

    def person_minds(self) -> NDArray[np.int16]:
        """`[B, 2, 2]`: (side, ahead) from the robot of where the person believes its goal to be, and where it is."""
        person, robot = self.batch.world.person, self.batch.world.robot
        places = person[:, [[BELIEVED_X, BELIEVED_Y], [GOAL_X, GOAL_Y]]] - robot[:, None, [X, Y]]
        ahead = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[robot[:, HEADING]][:, None]
        side = np.stack([-ahead[..., 1], ahead[..., 0]], axis=-1)
        return np.stack([(places * side).sum(-1), (places * ahead).sum(-1)], axis=-1).astype(np.int16)

    def counters(self) -> NDArray[np.int16]:
        """`[B, 2]`: waiting and lost counters."""
        person, robot = self.batch.world.person, self.batch.world.robot
        return np.stack([person[:, WAITING], robot[:, LOST]], axis=1).astype(np.int16)

    def expert_actions(self, kind: str) -> NDArray[np.int64]:
        """`[B]`: first actions of the A* paths on the full map: `goal` or `follower`."""
        return self.batch.expert(kind)

    def map_ids(self) -> NDArray[np.int64]:
        """`[B]`: stable hashes of the maps as generated, the person's start cell freed."""
        return self.batch.world.map_id.copy()

    def states(self) -> list[dict[str, Any]]:
        """The full state of every environment, as `PersonFollowingEnv.state` returns it."""
        return [self.batch.state(index) for index in range(self.num_envs)]

    def times(self) -> NDArray[np.int64]:
        """`[B]`: steps taken in the present episodes."""
        return self.batch.world.robot[:, TIME].astype(np.int64)
