"""Metrics of social navigation, one value per episode, from the steps that a runner recorded.

What each metric means, its unit and its source: docs/metrics.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from domains.core import FORWARD, LEFT, RIGHT, STAY
from domains.recording import FinishedEpisodes, RecordedSteps

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
"""Name and meaning of every metric of an episode."""

BELIEF_METRICS: dict[str, str] = {
    "kl": "KL of the true code of the person's view to the belief held, summed over factors, in nats",
    "factor_accuracy": "share of factors whose most likely value is true",
    "exact_view": "1 where the most likely code decodes to the person's view in every cell",
}
"""Name and meaning of every metric of a belief about the person's view."""

PERSONAL_SPACE = 2
"""The person is intruded on where it is nearer than this many cells (Manhattan)."""


def episode_metrics(
    steps: RecordedSteps, follow_distance: int = 3, robot_rest: int = 0, personal_space: int = PERSONAL_SPACE
) -> dict[str, NDArray[Any]]:
    """Every metric of every finished episode.

    Args:
        steps: T steps of B environments.
        follow_distance: the greatest distance at which the robot still follows.
        robot_rest: the robot was held at steps t that are a multiple of this; 0 for never.
        personal_space: see `PERSONAL_SPACE`.

    Returns:
        Arrays [E], one entry per finished episode, ordered by environment and then in time: `environment`,
        `episode` (0 for the first of its environment), every name of `METRICS` and every name of `steps.extra`
        (means over the steps that have a value; NaN where none has).
    """
    episodes = FinishedEpisodes(steps)
    of, total = episodes.of, episodes.total
    number, first, count = episodes.number, episodes.first, len(episodes)
    length = np.bincount(number, minlength=count)
    time = np.arange(len(number)) - first[number] + 1
    person = of(steps.person_action)
    before, after = of(steps.pose_before).astype(np.int64), of(steps.pose_after).astype(np.int64)
    held = (time % robot_rest == 0) if robot_rest else np.zeros(len(number), np.bool_)
    action = np.where(held, STAY, of(steps.action))
    moved = _robot_moved(before, after, action, person)
    turned = (action == LEFT) | (action == RIGHT)
    gap = np.abs(after[:, :2]).sum(axis=1)
    far = of(steps.distance) > follow_distance
    # Nobody can arrive together before the person has made its moves: those are the shortest time there is.
    shortest = np.maximum(total((person != STAY) & (person >= 0)), 1.0)
    columns = episodes.plain()
    columns["spl"] = columns["success"] * shortest / np.maximum(shortest, length)
    columns["path_length"] = total(moved)
    columns["heading_changes"] = total(turned)
    columns["time_not_moving"] = total(~moved & ~turned) / length
    columns["robot_collisions"] = total((action == FORWARD) & ~moved & (before[:, 0] == 0) & (before[:, 1] == 1))
    columns["person_collisions"] = total((gap == 0) & (person == FORWARD))
    columns["mean_distance"] = total(gap) / length
    columns["min_distance"] = np.minimum.reduceat(gap, first).astype(np.float64) if count else np.zeros(0)
    columns["intrusion"] = total(gap < personal_space) / length
    columns["psc"] = 1.0 - columns["intrusion"]
    columns["person_delay"] = total(person == STAY)
    columns["visibility"] = total(of(steps.visible)) / length
    columns["time_lost"] = total(far) / length
    columns["recovery_time"] = _recovery_time(far, number, first, count)
    return {name: columns[name] for name in ("environment", "episode", *METRICS)} | episodes.extra()


def _recovery_time(
    far: NDArray[np.bool_], number: NDArray[np.int64], first: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    """Mean length [E] of the spells of `far` [S] that end within their episode; NaN where there is none."""
    opens = far.copy()
    opens[1:] &= ~far[:-1] | (number[1:] != number[:-1])
    back = ~far
    back[1:] &= far[:-1] & (number[1:] == number[:-1])
    back[first] = False
    spell = np.cumsum(opens)
    lengths = np.bincount(spell[far], minlength=int(spell[-1]) + 1 if len(spell) else 1)
    spells = np.bincount(number[back], minlength=count)
    steps = np.bincount(number[back], lengths[spell[back]], count)
    return np.where(spells > 0, steps / np.maximum(spells, 1), np.nan)


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
        Arrays [B] named as in `BELIEF_METRICS`; `exact_view` only where both views are given.
    """
    picked = np.take_along_axis(beliefs, true_codes[..., None].astype(np.int64), axis=-1)[..., 0]
    result = {
        "kl": -np.log(np.maximum(picked, 1e-12)).sum(axis=-1),
        "factor_accuracy": (beliefs.argmax(axis=-1) == true_codes).mean(axis=-1),
    }
    if decoded_views is not None and true_views is not None:
        result["exact_view"] = (decoded_views == true_views).all(axis=(1, 2)).astype(np.float64)
    return result


__all__ = ["BELIEF_METRICS", "METRICS", "PERSONAL_SPACE", "belief_metrics", "episode_metrics"]
