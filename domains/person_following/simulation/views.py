"""What a pose sees: the egocentric view, its visibility rule, and relative poses."""

from __future__ import annotations

from domains.core import EMPTY, UNSEEN, WALL
from domains.person_following.simulation.compiled import inner
from domains.person_following.simulation.paths import step_x, step_y


@inner
def look(grids, b, x, y, heading, see_through_walls, views, i):  # type: ignore[no-untyped-def]
    """Fill `views[i]` (uint8 [v, v]) with the cell kinds that a pose sees in `grids[b]`; agents are not shown.

    Outside the map counts as wall; the viewer's own cell shows as empty. Without looking through walls,
    Minigrid's `Grid.process_vis` decides, and cells not visible are UNSEEN.
    """
    size = grids.shape[1]
    width = views.shape[1]
    half = width // 2
    fx, fy = step_x(heading), step_y(heading)
    for vx in range(width):
        side = vx - half
        # The right-hand side of heading (fx, fy) is (-fy, fx), as y points down.
        column_x = x - side * fy
        column_y = y + side * fx
        for vy in range(width):
            ahead = width - 1 - vy
            cx = column_x + ahead * fx
            cy = column_y + ahead * fy
            if 0 <= cx < size and 0 <= cy < size:
                views[i, vx, vy] = grids[b, cx, cy]
            else:
                views[i, vx, vy] = WALL
    if not see_through_walls:
        _hide(views[i])
    views[i, half, width - 1] = EMPTY


@inner
def _hide(view):  # type: ignore[no-untyped-def]
    """Mark cells of a full view as UNSEEN by Minigrid's rule: light spreads row by row, away from the viewer.

    A cell's lit bit is kept as bit 2 of the view while the light spreads.
    """
    width = view.shape[0]
    view[width // 2, width - 1] |= 4
    for vy in range(width - 1, -1, -1):
        for vx in range(width - 1):
            if view[vx, vy] & 4 and view[vx, vy] & 3 != WALL:
                view[vx + 1, vy] |= 4
                if vy > 0:
                    view[vx + 1, vy - 1] |= 4
                    view[vx, vy - 1] |= 4
        for vx in range(width - 1, 0, -1):
            if view[vx, vy] & 4 and view[vx, vy] & 3 != WALL:
                view[vx - 1, vy] |= 4
                if vy > 0:
                    view[vx - 1, vy - 1] |= 4
                    view[vx, vy - 1] |= 4
    for vx in range(width):
        for vy in range(width):
            if view[vx, vy] & 4:
                view[vx, vy] &= 3
            else:
                view[vx, vy] = UNSEEN


@inner
def relative(x, y, heading, other_x, other_y, other_heading):  # type: ignore[no-untyped-def]
    """(side, ahead, heading) of another pose: side to the right, heading 3 where both look the same way."""
    fx, fy = step_x(heading), step_y(heading)
    dx, dy = other_x - x, other_y - y
    return -dx * fy + dy * fx, dx * fx + dy * fy, (other_heading - heading - 1) & 3


@inner
def configuration_of(views, i, side, ahead, heading, see_through_walls):  # type: ignore[no-untyped-def]
    """Configuration, in `views[i]`, of an agent at a relative pose: 0 where out of view, hidden or on top."""
    width = views.shape[1]
    half = width // 2
    if ahead < 0 or ahead >= width or side < -half or side > half or (side == 0 and ahead == 0):
        return 0
    vx, vy = half + side, width - 1 - ahead
    if not see_through_walls and views[i, vx, vy] == UNSEEN:
        return 0
    return 1 + (vx * width + vy) * 4 + heading


@inner
def remove_person(views, i, configuration):  # type: ignore[no-untyped-def]
    """Show the cell of a person seen in `views[i]` as empty: it hides the goal that it stands on."""
    if configuration > 0:
        width = views.shape[1]
        place = (configuration - 1) >> 2
        views[i, place // width, place % width] = EMPTY
