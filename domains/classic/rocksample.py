"""RockSample(n, k) (Smith and Simmons 2004): a rover on an n x n grid, k rocks of unknown worth.

S   rover's cell x which rocks are good, and a terminal state `st`
A   amn, ame, ams, amw (moves), ac0 ... ac(k-1) (check a rock), as (sample)
O   ogood, obad; a check of a rock d cells away is right with probability (1 + 2^(-d / d0)) / 2, others say ogood
R   +10 for leaving by the east edge, which ends it; +10 for sampling a good rock (which turns bad), -10 for a bad
    one; -100 and the end for leaving the grid elsewhere and for sampling where no rock is. Discount 0.95.

Names, their order and every number are those of the files that the literature solves (the generators
`gen_RockSample_n_k` of ZMDP, T. Smith). They differ in more than their maps: the sensor's half distance d0 is ln 2
(efficiency e^-d) in (4, 4), 4 in (5, 5) and 20 in (7, 8). One d0 for all, as later reimplementations have it, gives
other values: with d0 = 20 the optimum of (4, 4) is 19.0 instead of 18.0, that of (5, 5) is above 20.3.

Published values of the optimum, or the best known lower bound: (4, 4) 18.036, (5, 5) 19.237, (7, 8) 21.47
(Smith and Simmons 2005; Kurniawati, Hsu, Lee 2008; Ross, Pineau, Paquet, Chaib-draa 2008).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from domains.core import DomainError

LAYOUTS: dict[tuple[int, int], tuple[tuple[int, int], ...]] = {
    (4, 4): ((3, 1), (2, 1), (1, 3), (1, 0)),
    (5, 5): ((2, 4), (0, 4), (3, 3), (2, 2), (4, 1)),
    (7, 8): ((2, 0), (0, 1), (3, 1), (6, 3), (2, 4), (3, 4), (5, 5), (1, 6)),
}
"""Rocks (x, y), y counted from the south edge, of the instances that the literature uses."""
STARTS = {(4, 4): (0, 2), (5, 5): (0, 2), (7, 8): (0, 3)}
HALF_DISTANCES = {(4, 4): float(np.log(2)), (5, 5): 4.0, (7, 8): 20.0}
"""Distance at which the sensor's efficiency is one half."""
_MOVES = ((0, 1), (1, 0), (0, -1), (-1, 0))  # north, east, south, west
_OUT = -100.0


def rocksample(
    size: int = 4,
    num_rocks: int = 4,
    rocks: tuple[tuple[int, int], ...] | None = None,
    start: tuple[int, int] | None = None,
    half_distance: float | None = None,
    discount: float = 0.95,
) -> dict[str, Any]:
    """The arrays of RockSample(size, num_rocks).

    Args:
        size: side of the grid.
        num_rocks: number of rocks.
        rocks: their cells; those of the literature by default.
        start: the rover's cell; that of the literature by default.
        half_distance: d0 of the sensor; that of the literature by default (20 where it knows none).
        discount: per step.

    Raises:
        DomainError: an instance without known layout, and none given.
    """
    rocks = LAYOUTS.get((size, num_rocks)) if rocks is None else rocks
    if rocks is None or len(rocks) != num_rocks:
        known = ", ".join(f"({n}, {k})" for n, k in LAYOUTS)
        raise DomainError(f"RockSample({size}, {num_rocks}): give {num_rocks} rocks; layouts are known for {known}")
    start = STARTS.get((size, num_rocks), (0, size // 2)) if start is None else start
    half_distance = HALF_DISTANCES.get((size, num_rocks), 20.0) if half_distance is None else half_distance
    worths = 1 << num_rocks
    num_states = size * size * worths + 1
    end = num_states - 1
    cells = np.arange(size * size)
    x, y = np.repeat(cells // size, worths), np.repeat(cells % size, worths)
    worth = np.tile(np.arange(worths), size * size)
    here = np.arange(end)

    def matrix(after: np.ndarray) -> sparse.csr_array:
        columns = np.append(after, end)
        return sparse.csr_array((np.ones(num_states), (np.arange(num_states), columns)), (num_states, num_states))

    transition, rewards = [], []
    for dx, dy in _MOVES:
        nx, ny = x + dx, y + dy
        out = (nx < 0) | (nx >= size) | (ny < 0) | (ny >= size)
        after = (nx.clip(0, size - 1) * size + ny.clip(0, size - 1)) * worths + worth
        transition.append(matrix(np.where(out, end, after)))
        rewards.append(np.append(np.where(nx >= size, 10.0, np.where(out, _OUT, 0.0)), 0.0))
    observation = np.zeros((5 + num_rocks, num_states, 2))
    observation[..., 0] = 1.0
    after, gain = np.full(end, end), np.full(end, _OUT)
    for i, (rx, ry) in enumerate(rocks):
        bit = 1 << (num_rocks - 1 - i)
        at, good = (x == rx) & (y == ry), (worth & bit) != 0
        gain[at] = np.where(good, 10.0, -10.0)[at]
        after[at] = (here - bit * good)[at]
        transition.append(matrix(here))
        rewards.append(np.zeros(num_states))
        right = (1 + 2.0 ** (-np.hypot(x - rx, y - ry) / half_distance)) / 2
        observation[4 + i, :-1, 0] = np.where(good, right, 1 - right)
        observation[4 + i, :-1, 1] = np.where(good, 1 - right, right)
    transition.append(matrix(after))
    rewards.append(np.append(gain, 0.0))
    belief = np.zeros(num_states)
    first = (start[0] * size + start[1]) * worths
    belief[first : first + worths] = 1.0 / worths
    terminal = np.zeros(num_states, np.bool_)
    terminal[end] = True
    names = [f"s{a}{b}{c:0{num_rocks}b}" for a, b, c in zip(x, y, worth, strict=True)]
    return {
        "states": (*names, "st"),
        "actions": ("amn", "ame", "ams", "amw", *(f"ac{i}" for i in range(num_rocks)), "as"),
        "observations": ("ogood", "obad"),
        "transition": transition,
        "observation": observation,
        "reward": np.stack(rewards),
        "discount": discount,
        "start": belief,
        "terminal": terminal,
    }
