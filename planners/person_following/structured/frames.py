"""How poses add up, learned from how the person's relative pose changes; and dead reckoning with it.

frame   (X, Y, H): pose relative to where the robot's episode began; (0, 0, 3) is that beginning
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from domains.core import FORWARD, LEFT, RIGHT, STAY
from nesy.errors import UserError
from planners.person_following.motion import NUM_HEADINGS, NUM_MOTIONS, NUM_MOVES

if TYPE_CHECKING:
    from nesy.log.experience import Experience

FAR = 255
"""Length of a walk that does not exist, or is longer than was asked for."""
AHEAD = 3
"""The heading of whoever looks as the robot does."""


@dataclass(frozen=True)
class Frame:
    """How poses add up, as the learned motions say.

    Attributes:
        ahead: int64 [4, 2], the step forward under each heading.
        side: int64 [4, 2], the step to the right under each heading.
        displacement: int64 [motions, 3], where a robot at (0, 0, 3) is after each motion.
    """

    ahead: np.ndarray
    side: np.ndarray
    displacement: np.ndarray

    def compose(self, poses: np.ndarray, relative: np.ndarray) -> np.ndarray:
        """Poses int64 [..., 3] of what is at `relative` [..., 3] as seen from `poses` [..., 3]."""
        heading = poses[..., 2]
        place = poses[..., :2] + self.side[heading] * relative[..., :1] + self.ahead[heading] * relative[..., 1:2]
        turned = (heading + relative[..., 2] - AHEAD) % NUM_HEADINGS
        return np.concatenate([place, turned[..., None]], axis=-1)


def learn_frame(experience: Experience) -> tuple[Frame, np.ndarray]:
    """Read the frame off how the person's relative pose changes.

    A robot that stays sees the person's own step; whatever action changes no more than that did not move the robot.
    A person that turns where it stands shows the robot's motion.

    Args:
        experience: person-following transitions.

    Returns:
        The frame, and bool [n]: whether the action moved the robot (true for every `stay`).

    Raises:
        UserError: some step was never seen.
    """
    before, after = experience.relative_pose.astype(np.int64), experience.next_relative_pose.astype(np.int64)
    action, move = experience.action.astype(np.int64), experience.person_action.astype(np.int64)
    change = after - before
    turned = change[:, 2] % NUM_HEADINGS
    still = action == STAY
    turns = np.array([_usual(turned[still & (move == u)], 0) for u in range(NUM_MOVES)])
    ahead = np.array(
        [
            [_usual(change[still & (move == FORWARD) & (before[:, 2] == h), axis]) for axis in range(2)]
            for h in range(NUM_HEADINGS)
        ]
    )
    own = np.where((move == FORWARD)[:, None], ahead[before[:, 2]], 0)
    moved = still | (change[:, :2] != own).any(1) | (turned != turns[move])
    effective = np.where(moved, action, STAY)
    displacement = np.zeros((NUM_MOTIONS, 3), np.int64)
    displacement[STAY, 2] = AHEAD
    for m in (LEFT, RIGHT, FORWARD):
        rows = (effective == m) & (move != FORWARD)
        places = np.concatenate([before[rows, :2], np.ones((rows.sum(), 1), np.int64)], axis=1)
        if not rows.any() or np.linalg.matrix_rank(places) < 3:
            raise UserError("the experience shows too few steps of robot and person; collect more episodes")
        a = np.rint(np.linalg.lstsq(places, after[rows, :2], rcond=None)[0].T)
        displacement[m, :2] = np.rint(-np.linalg.solve(a[:, :2], a[:, 2]))
        displacement[m, 2] = (AHEAD - _usual((turned - turns[move])[rows] % NUM_HEADINGS)) % NUM_HEADINGS
    right = (np.arange(NUM_HEADINGS) + turns[RIGHT]) % NUM_HEADINGS
    return Frame(ahead, ahead[right], displacement), moved


def _usual(values: np.ndarray, otherwise: int | None = None) -> int:
    """The most frequent of some whole numbers.

    Raises:
        UserError: there are none, and nothing is given to take otherwise.
    """
    if len(values) == 0:
        if otherwise is not None:
            return otherwise
        raise UserError("the experience shows too few steps of the person; collect more episodes")
    found, counts = np.unique(values, return_counts=True)
    return int(found[counts.argmax()])


def reckon(frame: Frame, experience: Experience, moved: np.ndarray) -> np.ndarray:
    """The robot's poses before every step, in the frame of its episode: int64 [n, 3].

    Args:
        frame: how poses add up.
        experience: whole episodes, step after step.
        moved: bool [n], whether the action moved the robot.
    """
    effective = np.where(moved, experience.action.astype(np.int64), STAY)
    poses = np.zeros((len(effective), 3), np.int64)
    poses[:, 2] = AHEAD
    t = experience.t - experience.t.min(initial=0)
    for step in range(1, int(t.max(initial=0)) + 1):
        rows = np.flatnonzero(t == step)
        poses[rows] = frame.compose(poses[rows - 1], frame.displacement[effective[rows - 1]])
    return poses
