"""The map that a robot draws while it walks, and what it says of ways and views.

    frame   poses relative to where the robot's episode began, as in planners.person_following.structured.frames
    map     kinds of cells; UNSEEN where no view has shown them yet
    filled  the map, with what experience has usually met at a place where the map knows nothing
    pose    one integer: (x * F + y) * 4 + heading, counted from the corner of the map

Whoever looks hides its own cell, and may hide a goal that it stands on: a goal once seen stays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from domains.core import EMPTY, FORWARD, GOAL, UNSEEN, WALL
from nesy.compiled import njit
from planners.person_following.motion import NUM_HEADINGS, NUM_MOTIONS
from planners.person_following.structured.frames import AHEAD, FAR, Frame


class Chart(NamedTuple):
    """Where maps lie, and how poses add up in them.

    Attributes:
        origin: int64 [2], frame coordinates of the corner of maps.
        ahead, side: int64 [4, 2], as in `Frame`.
        displacement: int64 [motions, 3], as in `Frame`.
        usual: uint8 [F, F], what experience has usually met at each place.
    """

    origin: np.ndarray
    ahead: np.ndarray
    side: np.ndarray
    displacement: np.ndarray
    usual: np.ndarray

    @property
    def size(self) -> int:
        """F."""
        return int(self.usual.shape[0])

    def blank(self) -> np.ndarray:
        """A map of which nothing is known: uint8 [F, F]."""
        return np.full(self.usual.shape, UNSEEN, np.uint8)

    def number(self, poses: np.ndarray) -> np.ndarray:
        """Numbers int64 [n] of frame poses [n, 3]; -1 outside the map."""
        at = np.asarray(poses, np.int64)[..., :2] - self.origin
        inside = ((at >= 0) & (at < self.size)).all(-1)
        found = (at[..., 0] * self.size + at[..., 1]) * NUM_HEADINGS + np.asarray(poses)[..., 2]
        return np.where(inside, found, -1)

    def pose(self, number: int) -> np.ndarray:
        """The frame pose int64 [3] of a number."""
        cell, heading = divmod(int(number), NUM_HEADINGS)
        return np.array([cell // self.size + self.origin[0], cell % self.size + self.origin[1], heading])

    def relative(self, robot: int, other: int) -> np.ndarray:
        """(side, ahead, heading) int64 [3] of one pose as seen from another, both as numbers."""
        here, there = self.pose(robot), self.pose(other)
        offset = there[:2] - here[:2]
        turned = (there[2] - here[2] + AHEAD) % NUM_HEADINGS
        return np.array([offset @ self.side[here[2]], offset @ self.ahead[here[2]], turned])

    def filled(self, kinds: np.ndarray) -> np.ndarray:
        """The map with what is usual where nothing is known: uint8 [F, F]."""
        return np.where(kinds == UNSEEN, self.usual, kinds)


def chart_of(frame: Frame, poses: np.ndarray) -> Chart:
    """A chart with room for frame poses [n, 3] and a border around them; nothing is usual in it yet."""
    low, high = poses[:, :2].min(0) - 1, poses[:, :2].max(0) + 1
    size = int((high - low).max()) + 1
    return Chart(low, frame.ahead, frame.side, frame.displacement, np.full((size, size), UNSEEN, np.uint8))


@njit(cache=True)
def note(chart: Chart, kinds: np.ndarray, view: np.ndarray, pose: np.ndarray) -> None:
    """Draw what a view [V, V] from a frame pose [3] shows into a map [F, F]."""
    width, size, h = view.shape[0], kinds.shape[0], pose[2]
    for vx in range(width):
        for vy in range(width):
            kind = view[vx, vy]
            s, f = vx - width // 2, width - 1 - vy
            x = pose[0] + chart.side[h, 0] * s + chart.ahead[h, 0] * f - chart.origin[0]
            y = pose[1] + chart.side[h, 1] * s + chart.ahead[h, 1] * f - chart.origin[1]
            if kind == UNSEEN or x < 0 or y < 0 or x >= size or y >= size:
                continue
            if (kind == EMPTY and kinds[x, y] == GOAL) or (s == 0 and f == 0 and kinds[x, y] != UNSEEN):
                continue
            kinds[x, y] = kind


@njit(cache=True)
def patch(
    chart: Chart, kinds: np.ndarray, number: int, reach: int, back: int, front: int, outside: int, out: np.ndarray
) -> None:
    """What lies around a pose, as whoever stands there has it: cells row by row from `back` behind to `front` ahead."""
    size, h = kinds.shape[0], number % NUM_HEADINGS
    x0, y0 = number // NUM_HEADINGS // size, number // NUM_HEADINGS % size
    i = 0
    for f in range(-back, front + 1):
        for s in range(-reach, reach + 1):
            x = x0 + chart.side[h, 0] * s + chart.ahead[h, 0] * f
            y = y0 + chart.side[h, 1] * s + chart.ahead[h, 1] * f
            out[i] = outside
            if x >= 0 and y >= 0 and x < size and y < size:
                out[i] = kinds[x, y]
            i += 1


@njit(cache=True)
def ways_on(chart: Chart, filled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where motions lead on a map, int32 [poses, motions], and from where they come (-1: from nowhere)."""
    size = filled.shape[0]
    count = size * size * NUM_HEADINGS
    follows = np.zeros((count, NUM_MOTIONS), np.int32)
    comes = np.full((count, NUM_MOTIONS), -1, np.int32)
    for q in range(count):
        x0, y0, h = q // NUM_HEADINGS // size, q // NUM_HEADINGS % size, q % NUM_HEADINGS
        for m in range(NUM_MOTIONS):
            s, f = chart.displacement[m, 0], chart.displacement[m, 1]
            x = x0 + chart.side[h, 0] * s + chart.ahead[h, 0] * f
            y = y0 + chart.side[h, 1] * s + chart.ahead[h, 1] * f
            then = q
            inside = x >= 0 and y >= 0 and x < size and y < size
            if inside and filled[x0, y0] != WALL and filled[x, y] != WALL:
                then = (x * size + y) * NUM_HEADINGS + (h + chart.displacement[m, 2] - AHEAD) % NUM_HEADINGS
            follows[q, m] = then
            if then != q:
                comes[then, m] = q
    return follows, comes


@njit(cache=True)
def walks_to(comes: np.ndarray, target: int, longest: int, out: np.ndarray, queue: np.ndarray) -> None:
    """The least number of actions from every pose to `target`, its heading included: uint8 [poses], FAR if longer."""
    for q in range(out.shape[0]):
        out[q] = FAR
    out[target] = 0
    queue[0] = target
    head, tail = 0, 1
    while head < tail:
        q = queue[head]
        head += 1
        if out[q] >= longest:
            break
        for m in range(FORWARD + 1):
            source = comes[q, m]
            if source >= 0 and out[source] == FAR:
                out[source] = out[q] + 1
                queue[tail] = source
                tail += 1
