"""Where the person starts, for the rules under which that depends on the map."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from domains.core import EMPTY
from domains.person_following.variants import Parameters

CORNER = (2, 2)
TRIED = 8
"""Starts that are tried out side by side."""
_ROBOT = (1, 1)


def candidates(grid: NDArray[np.uint8]) -> list[tuple[int, int]]:
    """Free cells that the robot can reach, nearest to (2, 2) first; its own cell is none of them."""
    reachable = {_ROBOT}
    frontier = [_ROBOT]
    while frontier:
        x, y = frontier.pop()
        for cell in ((x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)):
            if cell not in reachable and grid[cell] != 1:
                reachable.add(cell)
                frontier.append(cell)
    cells = [cell for cell in reachable if cell != _ROBOT and grid[cell] == EMPTY]
    return sorted(cells, key=lambda cell: (abs(cell[0] - CORNER[0]) + abs(cell[1] - CORNER[1]), *cell))


class Trial(Protocol):
    """Plays the task from given starts: a batch of `TRIED` episodes."""

    def follower_succeeds(self, grid: NDArray[np.uint8], starts: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether a greedy follower succeeds [B] on one map, the person at each of some starts [B, 2]."""
        ...


class Starts:
    """The person's start by map, found once per map and parameters."""

    def __init__(self, parameters: Parameters, trial: Callable[[Parameters], Trial]) -> None:
        """Find starts under these parameters; `trial` makes the batch that tries them out."""
        self.parameters = parameters
        self._known: dict[bytes, tuple[int, int]] = {}
        self._make_trial = trial
        self._trial: Trial | None = None

    def sharing(self, parameters: Parameters) -> Starts:
        """Starts as they are under other parameters."""
        return Starts(parameters, self._make_trial)

    def of(self, grids: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Starts [B, 2] on maps [B, size, size]."""
        if self.parameters.person_start == "corner":
            return np.full((len(grids), 2), CORNER)
        keys = [grid.tobytes() for grid in grids]
        new = {key: grid for key, grid in zip(keys, grids, strict=True) if key not in self._known}
        for key, grid in new.items():
            cells = candidates(grid)
            self._known[key] = cells[0] if self.parameters.person_start == "near" else self._first_won(grid, cells)
        return np.array([self._known[key] for key in keys], np.int64).reshape(-1, 2)

    def _first_won(self, grid: NDArray[np.uint8], cells: list[tuple[int, int]]) -> tuple[int, int]:
        """The first cell from which a greedy follower succeeds; the first of all where there is none."""
        if self._trial is None:
            self._trial = self._make_trial(self.parameters)
        for first in range(0, len(cells), TRIED):
            some = cells[first : first + TRIED]
            won = self._trial.follower_succeeds(grid, np.array(some + [some[-1]] * (TRIED - len(some)), np.int64))
            for cell, good in zip(some, won, strict=False):
                if good:
                    return cell
        return cells[0]
