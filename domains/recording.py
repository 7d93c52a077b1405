"""What a runner writes down of each step, so that a domain can say afterwards what came of every episode.

    recorder = StepRecorder(env)                        # right after env.reset()
    observation, reward, terminated, truncated, infos = env.step(actions)
    recorder.step(actions, reward, infos)               # after every step
    metrics = domain.episode_metrics(recorder.steps(), variant)

Recording keeps references to the arrays that the step made anyway, so it costs next to nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from domains.vocabulary import OUTCOMES

if TYPE_CHECKING:
    from domains.core import BatchedEnvironment


@dataclass(frozen=True)
class RecordedSteps:
    """T steps of B environments, autoreset included; episodes unfinished at the end do not count."""

    action: NDArray[np.int64]
    """[T, B]: what the robots chose."""
    reward: NDArray[np.float64]
    """[T, B]"""
    distance: NDArray[np.int64]
    """[T, B]: the task's own distance after the step."""
    visible: NDArray[np.bool_]
    """[T, B]: whether the robot saw the person after the step."""
    person_action: NDArray[np.int8]
    """[T, B]: 0 left, 1 right, 2 forward, 3 wait."""
    outcome: NDArray[np.int8]
    """[T, B]: index into `OUTCOMES` where an episode ended with the step, else 0."""
    pose_before: NDArray[np.int16]
    """[T, B, 3]: (side, ahead, heading) of the person relative to the robot before the step."""
    pose_after: NDArray[np.int16]
    """[T, B, 3]: the same after the step, before any reset."""
    extra: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Further values [T, B] by name, NaN where there was none: each is averaged over its episode."""


class StepRecorder:
    """Collects the steps of a batched environment."""

    def __init__(self, env: BatchedEnvironment) -> None:
        """Begin with an environment that has just been reset."""
        self._env = env
        self._pose = np.array(env.relative_poses(), np.int16)
        self._rows: list[tuple[NDArray[Any], ...]] = []
        self._extra: list[Mapping[str, NDArray[Any]]] = []

    def step(
        self,
        actions: NDArray[np.integer[Any]],
        rewards: NDArray[np.floating[Any]],
        infos: Mapping[str, Any],
        extra: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        """Note one step of all environments.

        Args:
            actions: what the robots chose [B].
            rewards: what they got [B].
            infos: as returned by the environment's `step`.
            extra: further values [B] of this step, such as those of `Domain.belief_metrics`; NaN for none.
        """
        after = np.asarray(infos["final_relative_pose"])
        self._rows.append(
            (
                np.array(actions, np.int64),
                np.asarray(rewards, np.float64),
                np.asarray(infos["distance"]),
                np.asarray(infos["visible"]),
                np.asarray(infos["person_action"]),
                np.asarray(infos["outcome_code"]),
                self._pose,
                after,
            )
        )
        self._extra.append(extra or {})
        begun = np.asarray(infos["_final_obs"])
        self._pose = np.where(begun[:, None], self._env.relative_poses(), after) if begun.any() else after

    def steps(self) -> RecordedSteps:
        """All steps noted so far."""
        count = self._env.num_envs
        names = dict.fromkeys(name for extra in self._extra for name in extra)
        missing = np.full(count, np.nan)
        extra = {
            name: np.array([values.get(name, missing) for values in self._extra], np.float64).reshape(-1, count)
            for name in names
        }
        if not self._rows:
            whole, poses = np.zeros((0, count), np.int64), np.zeros((0, count, 3), np.int16)
            columns: list[NDArray[Any]] = [*[whole] * 6, poses, poses]
        else:
            columns = [np.stack(column) for column in zip(*self._rows, strict=True)]
        action, reward, distance, visible, person_action, outcome, before, after = columns
        return RecordedSteps(action, reward, distance, visible, person_action, outcome, before, after, extra)


class FinishedEpisodes:
    """Recorded steps by finished episode, ordered by environment and then in time.

    Attributes:
        number: [S], the episode that each step of a finished episode belongs to.
        first: [E], each episode's first step among those.
    """

    def __init__(self, steps: RecordedSteps) -> None:
        """Find the episodes."""
        self.recorded = steps
        ended = (steps.outcome.T != 0).astype(np.int64)
        before = np.cumsum(ended, axis=1) - ended
        kept = before < ended.sum(axis=1, keepdims=True)
        self._at = np.flatnonzero(kept)
        self._environment, self._episode = np.nonzero(kept)[0], before[kept]
        new = (np.diff(self._environment) != 0) | (np.diff(self._episode) != 0)
        self.number = np.cumsum(np.r_[True, new])[: len(self._at)] - 1
        self.first = np.nonzero(np.diff(self.number, prepend=-1))[0]

    def __len__(self) -> int:
        return len(self.first)

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        """The values [T, B, ...] of the finished episodes' steps, [S, ...]."""
        return np.moveaxis(values, 1, 0).reshape(-1, *values.shape[2:])[self._at]

    def total(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """Sums of values [S] by episode [E]."""
        return np.asarray(np.bincount(self.number, np.asarray(values, np.float64), len(self)), np.float64)

    def plain(self) -> dict[str, NDArray[Any]]:
        """Arrays [E]: `environment`, `episode`, `return`, `steps`, and 1 under the name of the outcome, else 0."""
        ends = np.append(self.first[1:], len(self._at)) - 1 if len(self) else self.first
        outcome = self.of(self.recorded.outcome)[ends]
        return {
            "environment": self._environment[self.first],
            "episode": self._episode[self.first],
            "return": self.total(self.of(self.recorded.reward)),
            "steps": np.bincount(self.number, minlength=len(self)),
            **{name: (outcome == code).astype(np.float64) for code, name in enumerate(OUTCOMES[1:], start=1)},
        }

    def extra(self) -> dict[str, NDArray[np.float64]]:
        """Means [E] of the further values over the steps that have one; NaN where none has."""
        means = {}
        for name, values in self.recorded.extra.items():
            some = self.of(values)
            there = ~np.isnan(some)
            known = self.total(there)
            means[name] = np.where(known > 0, self.total(np.where(there, some, 0.0)) / np.maximum(known, 1), np.nan)
        return means
