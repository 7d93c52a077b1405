"""Imagined walks over a view: the local search for a way, and what the own view tells along it."""

from __future__ import annotations

import numpy as np

from domains.core import EMPTY, UNSEEN, WALL
from nesy.compiled import njit

LEFT, RIGHT, FORWARD = 0, 1, 2
UP = 3
"""The viewer's own heading in view coordinates."""
_DX, _DY = (1, 0, -1, 0), (0, 1, 0, -1)


@njit(cache=True)
def plan_path(view: np.ndarray, vx: int, vy: int, heading: int, path: np.ndarray) -> int:
    """A shortest way from the viewer's pose to a pose in its view; walls and unseen cells block.

    Uniform-cost search over (x, y, heading), actions tried in the order left, right, forward.

    Args:
        view: uint8 [v, v], indexed [vx, vy].
        vx: column of the pose.
        vy: row of the pose.
        heading: of the pose; the viewer's own is 3.
        path: int64 [at least 4 * v * v], gets the actions.

    Returns:
        The number of actions, or -1 if the pose cannot be reached.
    """
    width = view.shape[0]
    total = width * width * 4
    parent = np.full(total, -1, dtype=np.int64)
    action_to = np.zeros(total, dtype=np.int64)
    queue = np.zeros(total, dtype=np.int64)
    start = ((width // 2) * width + width - 1) * 4 + 3
    goal = (vx * width + vy) * 4 + heading
    parent[start] = start
    queue[0] = start
    head, tail = 0, 1
    while head < tail and parent[goal] < 0:
        pose = queue[head]
        head += 1
        h = pose % 4
        y = pose // 4 % width
        x = pose // 4 // width
        for action in range(3):
            nx, ny, nh = x, y, h
            if action == 0:
                nh = (h + 3) % 4
            elif action == 1:
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
                queue[tail] = then
                tail += 1
    if parent[goal] < 0:
        return -1
    length = 0
    pose = goal
    while pose != start:
        path[length] = action_to[pose]
        length += 1
        pose = parent[pose]
    for i in range(length // 2):
        path[i], path[length - 1 - i] = path[length - 1 - i], path[i]
    return length


@njit(cache=True)
def _remember(view: np.ndarray, path: np.ndarray, length: int, memory: np.ndarray) -> None:
    """What the own view tells of the views along a walk.

    Args:
        view: uint8 [v, v], the own view.
        path: the walk's actions.
        length: how many of them count.
        memory: uint8 [at least length, v, v], gets the kind of every cell seen after each step; UNSEEN where the
            own view does not reach. The viewer's own cell shows as empty wherever it stands.
    """
    width = view.shape[0]
    x, y, heading = width // 2, width - 1, 3
    for step in range(length):
        if path[step] == 0:
            heading = (heading + 3) % 4
        elif path[step] == 1:
            heading = (heading + 1) % 4
        fx = 1 if heading == 0 else -1 if heading == 2 else 0
        fy = 1 if heading == 1 else -1 if heading == 3 else 0
        if path[step] == 2:
            x += fx
            y += fy
        for vx in range(width):
            for vy in range(width):
                side, ahead = vx - width // 2, width - 1 - vy
                cx = x + ahead * fx - side * fy
                cy = y + ahead * fy + side * fx
                inside = 0 <= cx < width and 0 <= cy < width
                memory[step, vx, vy] = view[cx, cy] if inside else UNSEEN
        memory[step, width // 2, width - 1] = EMPTY


@njit(cache=True)
def plan_all(views: np.ndarray, vx: np.ndarray, vy: np.ndarray, heading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Plan for many views uint8 [B, v, v] and poses [B]: paths int64 [B, 4 * v * v], lengths int64 [B] (-1: none)."""
    paths = np.zeros((len(views), 4 * views.shape[1] * views.shape[2]), dtype=np.int64)
    lengths = np.zeros(len(views), dtype=np.int64)
    for i in range(len(views)):
        lengths[i] = plan_path(views[i], vx[i], vy[i], heading[i], paths[i])
    return paths, lengths


@njit(cache=True)
def remember_all(views: np.ndarray, paths: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """The cells that own views [B, v, v] tell of along walks: uint8 [B, longest, v, v], UNSEEN where they do not."""
    longest = max(1, lengths.max())
    memory = np.full((len(views), longest, views.shape[1], views.shape[2]), UNSEEN, dtype=np.uint8)
    for i in range(len(views)):
        _remember(views[i], paths[i], lengths[i], memory[i])
    return memory


def poses_along(actions: tuple[int, ...], width: int) -> tuple[tuple[int, int, int], ...]:
    """(vx, vy, heading) in view coordinates before the first action of a walk and after each."""
    x, y, heading = width // 2, width - 1, UP
    poses = [(x, y, heading)]
    for action in actions:
        if action == FORWARD:
            x, y = x + _DX[heading], y + _DY[heading]
        else:
            heading = (heading + (3 if action == LEFT else 1)) % 4
        poses.append((x, y, heading))
    return tuple(poses)
