"""The finite sets behind a variant: all maps with their probabilities, and all views."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from domains.core import EMPTY, GOAL, WALL, DomainError
from domains.person_following.simulation.compiled import entry
from domains.person_following.simulation.paths import step_x, step_y
from domains.person_following.simulation.views import look
from domains.person_following.variants import Parameters

MAX_MAPS = 200_000


def all_maps(parameters: Parameters) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Every map the generator can draw, sorted, with its exact probability.

    The generator's draws are uniform: a set of rivers, an order of the steps through them, and one opening
    for each; maps reached in several ways add up.

    Raises:
        DomainError: more than MAX_MAPS combinations.
    """
    size, crossings = parameters.size, parameters.num_crossings
    places = range(2, size - 2, 2)
    rivers = [("v", place) for place in places] + [("h", place) for place in places]
    found: dict[bytes, Fraction] = {}
    too_many = DomainError(f"size {size} with {crossings} crossings has more than {MAX_MAPS} maps: too many to list")
    if math.comb(len(rivers), crossings) > MAX_MAPS:
        raise too_many
    subsets = list(itertools.combinations(rivers, crossings))
    combinations = 0
    for subset in subsets:
        vertical = sorted(place for kind, place in subset if kind == "v")
        horizontal = sorted(place for kind, place in subset if kind == "h")
        base = _walls(size, vertical, horizontal)
        limits_x, limits_y = [0, *vertical, size - 1], [0, *horizontal, size - 1]
        steps = len(vertical) + len(horizontal)
        if math.comb(steps, len(vertical)) > MAX_MAPS:
            raise too_many
        orders = [
            tuple(k in places_of_right for k in range(steps))
            for places_of_right in itertools.combinations(range(steps), len(vertical))
        ]
        for order in orders:
            choices = _openings(order, limits_x, limits_y)
            number = math.prod(len(cells) for cells in choices)
            combinations += number
            if combinations > MAX_MAPS:
                raise too_many
            share = Fraction(1, len(subsets) * len(orders) * number)
            for openings in itertools.product(*choices):
                grid = base.copy()
                for x, y in openings:
                    grid[x, y] = EMPTY
                key = grid.tobytes()
                found[key] = found.get(key, Fraction(0)) + share
    keys = sorted(found)
    grids = np.frombuffer(b"".join(keys), np.uint8).reshape(len(keys), size, size).copy()
    return grids, np.array([float(found[key]) for key in keys])


def _walls(size: int, vertical: list[int], horizontal: list[int]) -> NDArray[np.uint8]:
    grid = np.full((size, size), EMPTY, np.uint8)
    grid[[0, -1], :] = WALL
    grid[:, [0, -1]] = WALL
    grid[vertical, :] = WALL
    grid[:, horizontal] = WALL
    grid[size - 2, size - 2] = GOAL
    return grid


def _openings(order: tuple[bool, ...], limits_x: list[int], limits_y: list[int]) -> list[list[tuple[int, int]]]:
    """Cells that each step of a path from room to room may open; True is a step to the right."""
    choices, i, j = [], 0, 0
    for to_the_right in order:
        if to_the_right:
            choices.append([(limits_x[i + 1], y) for y in range(limits_y[j] + 1, limits_y[j + 1])])
            i += 1
        else:
            choices.append([(x, limits_y[j + 1]) for x in range(limits_x[i] + 1, limits_x[i + 1])])
            j += 1
    return choices


def all_views(grids: NDArray[np.uint8], parameters: Parameters, *, following: bool) -> NDArray[np.uint8]:
    """Every distinct view [V, v, v] over maps and poses on free cells, sorted."""
    played = grids.copy()
    if following:
        played[:, 2, 2] = EMPTY
    width = parameters.view_size
    views = np.empty((len(grids) * 4 * parameters.size**2, width, width), np.uint8)
    count = _collect_views(played, parameters.see_through_walls, views)
    return np.unique(views[:count], axis=0)


def all_transitions(
    grids: NDArray[np.uint8], parameters: Parameters, *, following: bool
) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.int64], NDArray[np.uint8]]:
    """Every step from every pose on a free cell of every map, nobody else being in the way.

    Returns:
        map index [T], view [T, v, v], action [T] and next view [T, v, v].
    """
    played = grids.copy()
    if following:
        played[:, 2, 2] = EMPTY
    width = parameters.view_size
    total = int((played != WALL).sum()) * 16
    places, actions = np.empty(total, np.int64), np.empty(total, np.int64)
    views = np.empty((2, total, width, width), np.uint8)
    _collect_transitions(played, parameters.see_through_walls, places, views[0], actions, views[1])
    return places, views[0], actions, views[1]


@entry
def _collect_transitions(grids, see_through_walls, places, before, actions, after):  # type: ignore[no-untyped-def]
    count = 0
    for m in range(grids.shape[0]):
        for x in range(grids.shape[1]):
            for y in range(grids.shape[2]):
                if grids[m, x, y] == WALL:
                    continue
                for heading in range(4):
                    for action in range(4):
                        nx, ny, turned = x, y, heading
                        if action == 0:
                            turned = (heading + 3) % 4
                        elif action == 1:
                            turned = (heading + 1) % 4
                        elif action == 2 and grids[m, x + step_x(heading), y + step_y(heading)] != WALL:
                            nx, ny = x + step_x(heading), y + step_y(heading)
                        places[count], actions[count] = m, action
                        look(grids, m, x, y, heading, see_through_walls, before, count)
                        look(grids, m, nx, ny, turned, see_through_walls, after, count)
                        count += 1


@entry
def _collect_views(grids, see_through_walls, views):  # type: ignore[no-untyped-def]
    count = 0
    for m in range(grids.shape[0]):
        for x in range(grids.shape[1]):
            for y in range(grids.shape[2]):
                if grids[m, x, y] != WALL:
                    for heading in range(4):
                        look(grids, m, x, y, heading, see_through_walls, views, count)
                        count += 1
    return count
