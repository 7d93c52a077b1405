"""How the relative pose of the person changes when robot and person move: learned, exactly, from experience.

For every effective robot motion m, person's action u and relative heading h, the next pose is an affine map of
(side, ahead) with integer coefficients; it is fitted by least squares, rounded, and checked on every example.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from domains.core import FORWARD, STAY

if TYPE_CHECKING:
    from nesy.log.experience import Experience

NUM_MOTIONS, NUM_MOVES, NUM_HEADINGS = 4, 4, 4
WAIT = 3
"""The person's action when it does not move; its others are left, right, forward."""


@dataclass(frozen=True)
class RelativeMotion:
    """The learned maps.

    Attributes:
        coefficients: int64 [motions, moves, headings, 2, 3]: next (side, ahead) = A (side, ahead, 1).
        next_heading: int64 [motions, moves, headings].
        counts: int64 [motions, moves, headings, 2]: examples, and how many the map reproduces.
        window: poses are clipped to -window..window in side and ahead.
    """

    coefficients: np.ndarray
    next_heading: np.ndarray
    counts: np.ndarray
    window: int

    @property
    def exact(self) -> float:
        """Share of the examples that the maps reproduce."""
        return float(self.counts[..., 1].sum() / max(self.counts[..., 0].sum(), 1))

    def apply(self, poses: np.ndarray, motions: np.ndarray, moves: np.ndarray) -> np.ndarray:
        """Next poses int64 [n, 3] of poses [n, 3] under effective motions [n] and person's moves [n]."""
        poses = np.asarray(poses, np.int64)
        maps = self.coefficients[motions, moves, poses[:, 2]]
        homogeneous = np.concatenate([poses[:, :2], np.ones((len(poses), 1), np.int64)], axis=1)
        where = np.einsum("nij,nj->ni", maps, homogeneous).clip(-self.window, self.window)
        return np.concatenate([where, self.next_heading[motions, moves, poses[:, 2]][:, None]], axis=1)

    def shifted(self, poses: np.ndarray) -> np.ndarray:
        """Poses [n, 3] with side and ahead clipped and counted from 0, as the tables want them."""
        poses = np.asarray(poses, np.int64)
        where = poses[:, :2].clip(-self.window, self.window) + self.window
        return np.concatenate([where, poses[:, 2:]], axis=1)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays to be stored."""
        return {"coefficients": self.coefficients, "next_heading": self.next_heading, "counts": self.counts}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Any], window: int) -> RelativeMotion:
        """The inverse of `arrays`."""
        return cls(arrays["coefficients"], arrays["next_heading"], arrays["counts"], window)


def learn_motion(experience: Experience) -> tuple[RelativeMotion, np.ndarray]:
    """Learn the maps, and find out which actions moved the robot.

    An action that changes the pose just as `stay` would have done did not move the robot.

    Args:
        experience: person-following transitions.

    Returns:
        The maps, and bool [n]: whether the robot moved (true for every `stay`).
    """
    before = experience.relative_pose.astype(np.int64)
    after = experience.next_relative_pose.astype(np.int64)
    action = experience.action.astype(np.int64)
    move = experience.person_action.astype(np.int64)
    window = int(max(np.abs(before[:, :2]).max(), np.abs(after[:, :2]).max()))
    shape = (NUM_MOTIONS, NUM_MOVES, NUM_HEADINGS)
    motion = RelativeMotion(
        np.zeros((*shape, 2, 3), np.int64), np.zeros(shape, np.int64), np.zeros((*shape, 2), np.int64), window
    )
    moved = np.ones(len(action), np.bool_)
    _fit(motion, STAY, before, after, move, action == STAY)
    acted = action != STAY
    moved[acted] = (motion.apply(before[acted], np.full(acted.sum(), STAY), move[acted]) != after[acted]).any(1)
    for m in (0, 1, FORWARD):
        _fit(motion, m, before, after, move, (action == m) & moved)
    _compose(motion)
    return motion, moved


def _fit(
    motion: RelativeMotion, m: int, before: np.ndarray, after: np.ndarray, move: np.ndarray, rows: np.ndarray
) -> None:
    for u in range(NUM_MOVES):
        for h in range(NUM_HEADINGS):
            chosen = rows & (move == u) & (before[:, 2] == h)
            homogeneous = np.concatenate([before[chosen, :2], np.ones((chosen.sum(), 1), np.int64)], axis=1)
            if np.linalg.matrix_rank(homogeneous) < 3:
                continue  # too few different examples; `_compose` fills it in
            solution, *_ = np.linalg.lstsq(homogeneous, after[chosen, :2], rcond=None)
            motion.coefficients[m, u, h] = np.rint(solution.T)
            motion.next_heading[m, u, h] = np.bincount(after[chosen, 2], minlength=NUM_HEADINGS).argmax()
            predicted = homogeneous @ motion.coefficients[m, u, h].T
            right = (predicted == after[chosen, :2]).all(1) & (after[chosen, 2] == motion.next_heading[m, u, h])
            motion.counts[m, u, h] = chosen.sum(), right.sum()


def _compose(motion: RelativeMotion) -> None:
    """Where there were too few examples for a map: first the robot alone moves, then the person alone does."""
    for m, u, h in np.argwhere(motion.counts[..., 0] == 0):
        middle = int(motion.next_heading[m, WAIT, h])
        parts_known = motion.counts[m, WAIT, h, 0] > 0 and motion.counts[STAY, u, middle, 0] > 0
        if m == STAY or u == WAIT or not parts_known:
            motion.coefficients[m, u, h] = np.eye(2, 3, dtype=np.int64)
            motion.next_heading[m, u, h] = h
            continue
        robot, person = motion.coefficients[m, WAIT, h], motion.coefficients[STAY, u, middle]
        offset = person[:, :2] @ robot[:, 2] + person[:, 2]
        motion.coefficients[m, u, h] = np.concatenate([person[:, :2] @ robot[:, :2], offset[:, None]], axis=1)
        motion.next_heading[m, u, h] = motion.next_heading[STAY, u, middle]
