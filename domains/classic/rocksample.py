"""RockSample(n, k) (Smith and Simmons 2004): a rover on an n x n grid, k rocks of unknown worth.

S   rover's cell x which rocks are good, and a terminal state
A   north, south, east, west, sample, check-1 ... check-k
O   none, good, bad; a check is right with probability (1 + 2^(-d / 20)) / 2, d the distance to the rock
R   +10 for leaving by the east edge, +10 for sampling a good rock (which turns bad), -10 for a bad one or none
Leaving the grid elsewhere is impossible: the rover stays. Discount 0.95.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

LAYOUTS: dict[tuple[int, int], tuple[tuple[int, int], ...]] = {
    (4, 4): ((3, 1), (2, 1), (1, 3), (1, 0)),
    (5, 5): ((2, 4), (0, 4), (3, 3), (2, 2), (4, 1)),
    (7, 8): ((2, 0), (0, 1), (3, 1), (6, 3), (2, 4), (3, 4), (5, 5), (1, 6)),
}
"""Rocks (x, y), y counted from the south edge, of the instances that the literature uses."""
STARTS = {(4, 4): (0, 2), (5, 5): (0, 2), (7, 8): (0, 3)}
HALF_EFFICIENCY = 20.0
_MOVES = ((0, 1), (0, -1), (1, 0), (-1, 0))


def rocksample(
    size: int = 4,
    num_rocks: int = 4,
    rocks: tuple[tuple[int, int], ...] | None = None,
    start: tuple[int, int] | None = None,
    discount: float = 0.95,
) -> dict[str, Any]:
    """The arrays of RockSample(size, num_rocks).

    Args:
        size: side of the grid.
        num_rocks: number of rocks.
        rocks: their cells; those of the literature by default.
        start: the rover's cell; that of the literature by default.
        discount: per step.

    Raises:
        ValueError: an instance without known layout, and none given.
    """
    rocks = LAYOUTS.get((size, num_rocks)) if rocks is None else rocks
    if rocks is None or len(rocks) != num_rocks:
        known = ", ".join(f"({n}, {k})" for n, k in LAYOUTS)
        raise ValueError(f"RockSample({size}, {num_rocks}): give {num_rocks} rocks; layouts are known for {known}")
    start = STARTS.get((size, num_rocks), (0, size // 2)) if start is None else start
    worths = 1 << num_rocks
    num_states = size * size * worths + 1
    end = num_states - 1
    cells = np.arange(size * size)
    x, y = np.repeat(cells // size, worths), np.repeat(cells % size, worths)
    worth = np.tile(np.arange(worths), size * size)
    here = np.arange(num_states - 1)

    def matrix(after: np.ndarray) -> sparse.csr_array:
        columns = np.append(after, end)
        return sparse.csr_array((np.ones(num_states), (np.arange(num_states), columns)), (num_states, num_states))

    transition, rewards = [], []
    for dx, dy in _MOVES:
        nx, ny = x + dx, np.clip(y + dy, 0, size - 1)
        leaves = nx >= size
        nx = np.clip(nx, 0, size - 1)
        transition.append(matrix(np.where(leaves, end, (nx * size + ny) * worths + worth)))
        rewards.append(np.append(np.where(leaves, 10.0, 0.0), 0.0))
    after, gain = here.copy(), np.full(num_states - 1, -10.0)
    for i, (rx, ry) in enumerate(rocks):
        at, good = (x == rx) & (y == ry), (worth >> i) & 1 == 1
        gain[at & good] = 10.0
        after[at & good] = here[at & good] - (1 << i)
    transition.append(matrix(after))
    rewards.append(np.append(gain, 0.0))
    observation = np.zeros((5 + num_rocks, num_states, 3))
    observation[:5, :, 0] = 1.0
    for i, (rx, ry) in enumerate(rocks):
        transition.append(matrix(here))
        rewards.append(np.zeros(num_states))
        right = (1 + 2.0 ** (-np.hypot(x - rx, y - ry) / HALF_EFFICIENCY)) / 2
        good = (worth >> i) & 1 == 1
        observation[5 + i, :-1, 1] = np.where(good, right, 1 - right)
        observation[5 + i, :-1, 2] = np.where(good, 1 - right, right)
        observation[5 + i, end, 0] = 1.0
    belief = np.zeros(num_states)
    first = (start[0] * size + start[1]) * worths
    belief[first : first + worths] = 1.0 / worths
    terminal = np.zeros(num_states, np.bool_)
    terminal[end] = True
    return {
        "states": tuple(f"x{a}y{b}w{c}" for a, b, c in zip(x, y, worth, strict=True)) + ("end",),
        "actions": ("north", "south", "east", "west", "sample", *(f"check-{i + 1}" for i in range(num_rocks))),
        "observations": ("none", "good", "bad"),
        "transition": transition,
        "observation": observation,
        "reward": np.stack(rewards),
        "discount": discount,
        "start": belief,
        "terminal": terminal,
    }
