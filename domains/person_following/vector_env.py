"""The task as a Gymnasium vector environment over the compiled rules."""

from __future__ import annotations

from collections.abc import Sequence
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
    Results,
    X,
    Y,
)
from domains.person_following.variants import Parameters, parameters_of

_OUTCOME_NAMES = np.array(OUTCOMES)


def _checked_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Gymnasium's mode of a name such as `NextStep`."""
    for known in AutoresetMode:
        if mode in (known, known.value, known.name):
            return known
    names = ", ".join(known.value for known in AutoresetMode)
    raise DomainError(f"autoreset_mode must be one of {names}, got {mode!r}")


class PersonFollowingVectorEnv(VectorEnv):
    """B environments stepped by one compiled call; see `domains.core.BatchedEnvironment`.

    Environment i of a batch reset with seed s plays what a single environment reset with seed s + i plays.

    `autoreset_mode`, as Gymnasium has it: `SameStep`, what our own runners and `BatchedEnvironment` take; `NextStep`,
    where the step after an ended episode begins the next one, is paid nothing and its action is not looked at;
    `Disabled`, where the caller resets what has ended (`options={"reset_mask": ...}`). Gymnasium's wrappers for
    observations of batches take the latter two. `infos` have `final_...` in `SameStep` alone: otherwise what is
    returned is final.
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
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        **parameters: Any,
    ) -> None:
        """Make a batch; see `domains.core.Domain.make` for `maps` and `cycle`, `Parameters` for the rest."""
        self.autoreset_mode = _checked_mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
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
        self._ended = np.zeros(self.num_envs, np.bool_)

    @property
    def geometry(self) -> ViewGeometry:
        """Coordinates of the views."""
        return self.batch.geometry

    @property
    def parameters(self) -> Parameters:
        """The rules that hold here."""
        return self.batch.parameters

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Begin new episodes.

        Args:
            seed: of environment 0, which is s, of environment i then s + i; or one for each, None leaving that
                environment's generator as it is.
            options: as for the single environment, for all alike; `reset_mask` bool [B] says where to begin (default:
                everywhere). Elsewhere nothing changes, and seeds have no effect.

        Raises:
            DomainError: wrong seeds or options; everything is then as it was.
        """
        given = dict(options or {})
        chosen = self._checked_mask(given.pop("reset_mask", None))
        begin = self.batch.checked_options(given, chosen)
        seeds = self._checked_seeds(seed)
        if not self.batch.seeded:
            first = self.pending_seed
            if first is None:
                first = int(np.random.SeedSequence().generate_state(1)[0])
            self.batch.seed([first + i for i in range(self.num_envs)])
        elif self.pending_seed is not None and seed is None:
            seeds = self._checked_seeds(self.pending_seed)
        self.pending_seed = None
        super().reset(seed=seeds[0])
        self.batch.seed([one if begins else None for one, begins in zip(seeds, chosen.tolist(), strict=True)])
        self.batch.detach()
        begin()
        self._begun, self._ended = True, self._ended & ~chosen
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
        same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            self.batch.step_or_begin(checked, self._ended)
        elif self._ended.any():
            ended = np.flatnonzero(self._ended).tolist()
            raise gymnasium.error.ResetNeeded(f"environments {ended} have ended: reset them with options['reset_mask']")
        else:
            self.batch.step(checked, same_step)
        last = self.batch.last
        self._ended = np.zeros(self.num_envs, np.bool_) if same_step else last.terminated | last.truncated
        infos = {
            "outcome": _OUTCOME_NAMES[last.outcome],
            "outcome_code": last.outcome,
            "distance": last.distance,
            "visible": last.visible,
            "person_action": last.person_action,
            "person_waited": last.person_action == 3,
        }
        if same_step:
            infos |= self._final_infos(last)
        observation: dict[str, NDArray[Any]] = {"view": last.robot_view, "configuration": last.configuration}
        return observation, last.reward, last.terminated, last.truncated, infos

    @staticmethod
    def _final_infos(last: Results) -> dict[str, Any]:
        """What held after the step and before any reset."""
        return {
            "final_obs": {"view": last.final_view, "configuration": last.final_configuration},
            "_final_obs": last.terminated | last.truncated,
            "final_person_view": last.final_person_view,
            "final_relative_pose": last.final_pose,
            "final_counters": last.final_counters,
        }

    def _checked_seeds(self, seed: Any) -> list[int | None]:
        """One seed for each environment, None where there is none."""
        if seed is None:
            return [None] * self.num_envs
        alone = isinstance(seed, int | np.integer)
        seeds = [seed] if alone else list(seed) if np.iterable(seed) and not isinstance(seed, str) else [seed]
        for one in seeds:
            if one is not None and (isinstance(one, bool) or not isinstance(one, int | np.integer) or one < 0):
                raise DomainError(f"a seed must be a whole number of at least 0 (in a list also None), got {one!r}")
        if alone:
            return [int(seed) + i for i in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise DomainError(f"{self.num_envs} seeds are needed, got {len(seeds)}")
        return [None if one is None else int(one) for one in seeds]

    def _checked_mask(self, mask: Any) -> NDArray[np.bool_]:
        """Where episodes are to begin, bool [B]."""
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        where = np.asarray(mask)
        if where.dtype != np.bool_ or where.shape != (self.num_envs,) or not where.any():
            raise DomainError(
                f"option 'reset_mask' must be bool ({self.num_envs},) with at least one True, got {mask!r}"
            )
        if not self._begun and not where.all():
            raise DomainError("option 'reset_mask': the first reset is of all environments")
        return where

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
