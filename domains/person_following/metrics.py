"""Metrics of social navigation, by episode, computed from what a batched environment reports of each step.

What each metric means, its unit and its source: docs/metrics.md. `EpisodeMetrics` is fed one batched step at a
time and returns a row for every episode that ended in it; the belief metrics are functions of their own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from domains.core import FORWARD, LEFT, OUTCOMES, RIGHT, STAY

METRICS: dict[str, str] = {
    "return": "sum of rewards",
    "steps": "steps of the episode",
    "success": "1 where robot and person arrive together, the robot seeing the person",
    "agent_at_goal": "1 where the robot entered the goal before the person",
    "lost": "1 where the person was lost",
    "unescorted": "1 where the person stood at its goal alone",
    "timeout": "1 where time ran out",
    "spl": "success weighted by path length: success * shortest / max(shortest, steps)",
    "path_length": "cells that the robot moved",
    "heading_changes": "turns of the robot",
    "time_not_moving": "share of steps in which the robot stayed, or was blocked",
    "robot_collisions": "steps in which the robot went forward against the person",
    "person_collisions": "steps in which the person walked onto the robot's cell",
    "mean_distance": "mean over steps of the number of cells between robot and person (Manhattan)",
    "min_distance": "least of that",
    "intrusion": "share of steps with the person nearer than the personal space",
    "psc": "personal space compliance: share of steps without intrusion",
    "person_delay": "steps in which the person waited",
    "visibility": "share of steps in which the robot saw the person",
    "time_lost": "share of steps in which the robot was beyond the follow distance",
    "recovery_time": "mean length of the spells beyond the follow distance that the robot ended; NaN if none",
}
"""Name and meaning of every column of a row, beside `episode` (counted per environment) and `environment`."""

_OUTCOME_COLUMNS = OUTCOMES[1:]


class EpisodeMetrics:
    """Gathers steps of B environments into one row of metrics per episode.

    Positions are followed relative to the robot, which every `BatchedEnvironment` reports, so that nothing
    of a concrete domain is needed.
    """

    def __init__(self, num_envs: int, follow_distance: int = 3, personal_space: int = 2) -> None:
        """Begin to gather.

        Args:
            num_envs: B.
            follow_distance: the greatest distance at which the robot still follows.
            personal_space: the person is intruded on where it is nearer than this many cells (Manhattan).
        """
        self.follow_distance, self.personal_space = follow_distance, personal_space
        self._sums = {name: np.zeros(num_envs) for name in _SUMMED}
        self._min_distance = np.full(num_envs, np.inf)
        self._spell = np.zeros(num_envs)
        self._episode = np.zeros(num_envs, np.int64)
        self._pose = np.tile(np.array([0, 0, 0]), (num_envs, 1))

    def begin(self, relative_poses: NDArray[np.integer], which: NDArray[np.bool_] | None = None) -> None:
        """Note the relative poses [B, 3] with which episodes begin; before the first step, for all."""
        chosen = np.ones(len(relative_poses), np.bool_) if which is None else which
        self._pose[chosen] = relative_poses[chosen]

    def step(
        self,
        actions: NDArray[np.integer],
        rewards: NDArray[np.floating],
        infos: dict[str, Any],
        relative_poses: NDArray[np.integer],
    ) -> list[dict[str, float]]:
        """Add one step of all environments; rows of the episodes that ended in it.

        Args:
            actions: what the robots chose [B].
            rewards: what they got [B].
            infos: as returned by the environment's `step`.
            relative_poses: of the environment after the step (of the new episode where one began).
        """
        pose = np.asarray(infos["final_relative_pose"], dtype=np.int64)
        person = np.asarray(infos["person_action"])
        turned = (actions == LEFT) | (actions == RIGHT)
        moved = _robot_moved(self._pose, pose, actions, person)
        gap = np.abs(pose[:, :2]).sum(axis=1)
        far = np.asarray(infos["distance"]) > self.follow_distance
        blocked_by_person = (actions == FORWARD) & ~moved & (self._pose[:, 0] == 0) & (self._pose[:, 1] == 1)
        sums = self._sums
        sums["return"] += rewards
        sums["steps"] += 1
        sums["path_length"] += moved
        sums["heading_changes"] += turned
        sums["time_not_moving"] += ~moved & ~turned
        sums["robot_collisions"] += blocked_by_person
        sums["person_collisions"] += (gap == 0) & (person == FORWARD)
        sums["mean_distance"] += gap
        sums["intrusion"] += gap < self.personal_space
        sums["person_delay"] += np.asarray(infos["person_waited"])
        sums["person_steps"] += (person != STAY) & (person >= 0)
        sums["visibility"] += np.asarray(infos["visible"])
        sums["time_lost"] += far
        back = ~far & (self._spell > 0)
        sums["recoveries"] += back
        sums["recovery_time"] += np.where(back, self._spell, 0)
        self._spell = np.where(far, self._spell + 1, 0)
        self._min_distance = np.minimum(self._min_distance, gap)
        ended = np.asarray(infos["_final_obs"])
        rows = [self._row(int(b), str(infos["outcome"][b])) for b in np.nonzero(ended)[0]]
        self._pose = pose
        if ended.any():
            for values in sums.values():
                values[ended] = 0
            self._min_distance[ended] = np.inf
            self._spell[ended] = 0
            self._episode[ended] += 1
            self.begin(relative_poses, ended)
        return rows

    def _row(self, b: int, outcome: str) -> dict[str, float]:
        sums = {name: float(values[b]) for name, values in self._sums.items()}
        steps = sums["steps"]
        row: dict[str, float] = {"environment": b, "episode": int(self._episode[b])}
        row["return"], row["steps"] = sums["return"], steps
        for name in _OUTCOME_COLUMNS:
            row[name] = float(outcome == name)
        # Nobody can arrive together before the person has made its moves: those are the shortest time there is.
        shortest = max(sums["person_steps"], 1.0)
        row["spl"] = row["success"] * shortest / max(shortest, steps)
        for name in ("path_length", "heading_changes", "robot_collisions", "person_collisions", "person_delay"):
            row[name] = sums[name]
        for name in ("time_not_moving", "mean_distance", "intrusion", "visibility", "time_lost"):
            row[name] = sums[name] / steps
        row["min_distance"] = float(self._min_distance[b])
        row["psc"] = 1.0 - row["intrusion"]
        recoveries = sums["recoveries"]
        row["recovery_time"] = sums["recovery_time"] / recoveries if recoveries else float("nan")
        return {name: row[name] for name in ("environment", "episode", *METRICS)}


_SUMMED = (
    "return",
    "steps",
    "path_length",
    "heading_changes",
    "time_not_moving",
    "robot_collisions",
    "person_collisions",
    "mean_distance",
    "intrusion",
    "person_delay",
    "person_steps",
    "visibility",
    "time_lost",
    "recoveries",
    "recovery_time",
)


def _robot_moved(
    before: NDArray[np.int64], after: NDArray[np.int64], actions: NDArray[np.integer], person: NDArray[np.integer]
) -> NDArray[np.bool_]:
    """Whether each robot changed its cell: the person's own step, taken out, leaves the robot's."""
    went = actions == FORWARD
    # In the robot's frame heading 3 looks ahead, 0 to the right, 1 back and 2 to the left.
    heading = before[:, 2]
    ahead_by_person = np.where(person == FORWARD, (heading == 3).astype(int) - (heading == 1), 0)
    side_by_person = np.where(person == FORWARD, (heading == 0).astype(int) - (heading == 2), 0)
    alone_ahead = before[:, 1] + ahead_by_person
    alone_side = before[:, 0] + side_by_person
    return np.asarray(went & (alone_side == after[:, 0]) & (alone_ahead - 1 == after[:, 1]))


def belief_metrics(
    beliefs: NDArray[np.floating],
    true_codes: NDArray[np.integer],
    decoded_views: NDArray[np.uint8] | None = None,
    true_views: NDArray[np.uint8] | None = None,
) -> dict[str, NDArray[np.float64]]:
    """How well beliefs about the person's view match the truth, one value per belief.

    Args:
        beliefs: [B, N, K], rows sum to 1.
        true_codes: [B, N], code of the person's true view.
        decoded_views: [B, v, v], the views that the beliefs' most likely codes decode to.
        true_views: [B, v, v], the person's true views.

    Returns:
        `kl`: KL of the true code (a one-hot belief) to the belief, summed over factors, in nats;
        `factor_accuracy`: share of factors whose most likely value is true; `exact_view` (with views):
        1 where every cell agrees.
    """
    picked = np.take_along_axis(beliefs, true_codes[..., None].astype(np.int64), axis=-1)[..., 0]
    result = {
        "kl": -np.log(np.maximum(picked, 1e-12)).sum(axis=-1),
        "factor_accuracy": (beliefs.argmax(axis=-1) == true_codes).mean(axis=-1),
    }
    if decoded_views is not None and true_views is not None:
        result["exact_view"] = (decoded_views == true_views).all(axis=(1, 2)).astype(np.float64)
    return result


__all__ = ["METRICS", "EpisodeMetrics", "belief_metrics"]
