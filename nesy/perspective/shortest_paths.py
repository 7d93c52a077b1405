"""Imagined walks over views, for many views and targets at once: the ways, and what the own view tells along them.

All shortest ways from one pose form a tree, so walks from one belief share their beginnings: every pose of the tree
is reached once, by one step from its parent. A pose is numbered `(vx * v + vy) * 4 + heading`, which is the
configuration of an agent there less 1. Trees are gone through level by level, all views together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from domains.core import EMPTY, LEFT, RIGHT, UNSEEN, WALL
from nesy.compiled import njit

UP = 3
"""The viewer's own heading in view coordinates."""


class Trees(NamedTuple):
    """Shortest ways from the viewer's pose over views; arrays [R, P] over views and poses.

    Attributes:
        parent: int64, the pose before; -1 where there is no way.
        action: int64, the last action of the way.
        depth: int64, the number of actions; -1 where there is no way.
    """

    parent: np.ndarray
    action: np.ndarray
    depth: np.ndarray

    def way(self, row: int, pose: int) -> tuple[list[int], list[int]]:
        """The poses and the actions of the way to a pose that can be reached; the first pose is the viewer's."""
        poses, actions = [pose], []
        for _ in range(int(self.depth[row, pose])):
            actions.append(int(self.action[row, poses[-1]]))
            poses.append(int(self.parent[row, poses[-1]]))
        return poses[::-1], actions[::-1]


@njit(cache=True)
def _grow(view: np.ndarray, parent: np.ndarray, action_to: np.ndarray, depth: np.ndarray, queue: np.ndarray) -> None:
    """Fill one row of `Trees` for a view uint8 [v, v]."""
    width = view.shape[0]
    start = ((width // 2) * width + width - 1) * 4 + UP
    parent[start] = start
    depth[start] = 0
    queue[0] = start
    head, tail = 0, 1
    while head < tail:
        pose = queue[head]
        head += 1
        h = pose % 4
        y = pose // 4 % width
        x = pose // 4 // width
        for action in range(3):
            nx, ny, nh = x, y, h
            if action == LEFT:
                nh = (h + 3) % 4
            elif action == RIGHT:
                nh = (h + 1) % 4
            else:
                nx = x + (1 if h == 0 else -1 if h == 2 else 0)
                ny = y + (1 if h == 1 else -1 if h == 3 else 0)
                if nx < 0 or nx >= width or ny < 0 or ny >= width:
                    continue
                if view[nx, ny] == WALL or view[nx, ny] == UNSEEN:
                    continue
            then = (nx * width + ny) * 4 + nh
            if parent[then] < 0:
                parent[then] = pose
                action_to[then] = action
                depth[then] = depth[pose] + 1
                queue[tail] = then
                tail += 1


@njit(cache=True)
def _grow_all(views: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    poses = views.shape[1] * views.shape[2] * 4
    parent = np.full((len(views), poses), -1, dtype=np.int64)
    action = np.zeros((len(views), poses), dtype=np.int64)
    depth = np.full((len(views), poses), -1, dtype=np.int64)
    queue = np.empty(poses, dtype=np.int64)
    for row in range(len(views)):
        _grow(views[row], parent[row], action[row], depth[row], queue)
    return parent, action, depth


def plan(views: np.ndarray) -> Trees:
    """Shortest ways over views uint8 [R, v, v]; walls and unseen cells block.

    Uniform-cost search over (x, y, heading); actions are tried in the order left, right, forward.
    """
    return Trees(*_grow_all(np.ascontiguousarray(views)))


@njit(cache=True)
def recall(view: np.ndarray, pose: int, seen: np.ndarray) -> None:
    """What an own view tells of the view from another pose in it.

    Args:
        view: uint8 [v, v], the own view.
        pose: where to look from.
        seen: uint8 [v * v], gets the kind of every cell of the view there, UNSEEN where the own view does not reach.
            The viewer's cell shows as empty wherever it stands.
    """
    width = view.shape[0]
    heading = pose % 4
    y = pose // 4 % width
    x = pose // 4 // width
    fx = 1 if heading == 0 else -1 if heading == 2 else 0
    fy = 1 if heading == 1 else -1 if heading == 3 else 0
    for vx in range(width):
        for vy in range(width):
            side, ahead = vx - width // 2, width - 1 - vy
            cx = x + ahead * fx - side * fy
            cy = y + ahead * fy + side * fx
            inside = 0 <= cx < width and 0 <= cy < width
            seen[vx * width + vy] = view[cx, cy] if inside else UNSEEN
    seen[(width // 2) * width + width - 1] = EMPTY


@njit(cache=True)
def _recall_all(views: np.ndarray, poses: np.ndarray) -> np.ndarray:
    seen = np.empty((len(views), views.shape[1] * views.shape[2]), dtype=np.uint8)
    for row in range(len(views)):
        recall(views[row], poses[row], seen[row])
    return seen


def recalled(views: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """What own views [B, v, v] tell of the views from poses [B] in them: uint8 [B, v, v], UNSEEN where nothing."""
    return _recall_all(np.ascontiguousarray(views), poses).reshape(views.shape)


class Levels(NamedTuple):
    """The poses on the ways to some targets, sorted by depth; arrays [n] over these nodes.

    Attributes:
        row: int64, which tree.
        pose: int64.
        before: int64, the node before; itself at depth 0.
        ends: int64 [deepest + 2]; the nodes of depth d are `ends[d]:ends[d + 1]`.
        targets: int64 [Q], the node of each target.
    """

    row: np.ndarray
    pose: np.ndarray
    before: np.ndarray
    ends: np.ndarray
    targets: np.ndarray


def levels(trees: Trees, rows: np.ndarray, poses: np.ndarray) -> Levels:
    """The nodes on the ways to poses [Q] in trees [Q], all of which can be reached."""
    needed = np.zeros(trees.parent.shape, dtype=bool)
    _mark(trees.parent, rows, poses, needed)
    row, pose = np.nonzero(needed)
    order = np.argsort(trees.depth[row, pose], kind="stable")
    row, pose = row[order], pose[order]
    depth = trees.depth[row, pose]
    number = np.zeros(needed.shape, dtype=np.int64)
    number[row, pose] = np.arange(len(row))
    ends = np.searchsorted(depth, np.arange(int(depth.max(initial=0)) + 2))
    return Levels(row, pose, number[row, trees.parent[row, pose]], ends, number[rows, poses])


@njit(cache=True)
def _mark(parent: np.ndarray, rows: np.ndarray, poses: np.ndarray, needed: np.ndarray) -> None:
    for target in range(len(rows)):
        row, pose = rows[target], poses[target]
        while not needed[row, pose]:
            needed[row, pose] = True
            pose = parent[row, pose]


def poses_along(poses: list[int], view_size: int) -> tuple[tuple[int, int, int], ...]:
    """(vx, vy, heading) in view coordinates of numbered poses."""
    return tuple((pose // 4 // view_size, pose // 4 % view_size, pose % 4) for pose in poses)
