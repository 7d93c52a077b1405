"""Pictures of the task in Minigrid's look: the map, the robot in red, the person in blue, the robot's view lit."""

from __future__ import annotations

from typing import Any

import numpy as np
from minigrid.core.constants import COLORS, TILE_PIXELS
from minigrid.core.grid import Grid
from minigrid.core.world_object import Goal, Wall
from minigrid.utils.rendering import fill_coords, point_in_triangle, rotate_fn
from numpy.typing import NDArray

from domains.core import GOAL, UNSEEN, WALL

_STEPS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
_OTHERS_COLOR = "grey"


def render_state(
    state: dict[str, Any], view: NDArray[np.uint8], *, person: bool = True, tile_size: int = TILE_PIXELS
) -> NDArray[np.uint8]:
    """A picture uint8 [height, width, 3] of a full state.

    Args:
        state: as returned by `PersonFollowingEnv.state()`.
        view: the robot's view [v, v]; its seen cells are highlighted.
        person: whether there is a person to draw.
        tile_size: pixels per cell.
    """
    cells = state["grid"]
    grid = Grid(*cells.shape)
    for x, y in np.argwhere(cells == WALL):
        grid.set(int(x), int(y), Wall())
    for x, y in np.argwhere(cells == GOAL):
        grid.set(int(x), int(y), Goal())
    x, y, heading = state["agent"]
    picture: NDArray[np.uint8] = grid.render(tile_size, (x, y), heading, _lit(cells.shape, state["agent"], view))
    if person:
        _draw(picture, state["person"], "blue", tile_size)
        for other in state.get("others", []):
            _draw(picture, other, _OTHERS_COLOR, tile_size)
    return picture


def _lit(shape: tuple[int, int], pose: tuple[int, int, int], view: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which cells of the map the view shows."""
    x, y, heading = pose
    forward, right = _STEPS[heading], _STEPS[(heading + 1) % 4]
    width = len(view)
    lit = np.zeros(shape, np.bool_)
    for vx, vy in np.argwhere(view != UNSEEN):
        cx, cy = np.array([x, y]) + (width - 1 - vy) * forward + (vx - width // 2) * right
        if 0 <= cx < shape[0] and 0 <= cy < shape[1]:
            lit[cx, cy] = True
    return lit


def _draw(picture: NDArray[np.uint8], pose: tuple[int, int, int], color: str, tile_size: int) -> None:
    """Draw an agent as a triangle that points where it looks, as Minigrid draws its own."""
    x, y, heading = pose
    triangle = rotate_fn(
        point_in_triangle((0.12, 0.19), (0.87, 0.50), (0.12, 0.81)), cx=0.5, cy=0.5, theta=0.5 * np.pi * heading
    )
    tile = picture[y * tile_size : (y + 1) * tile_size, x * tile_size : (x + 1) * tile_size]
    fill_coords(tile, triangle, COLORS[color])


class Window:
    """A window that shows pictures, at most `fps` of them a second."""

    def __init__(self, fps: int, title: str) -> None:
        """Open no window yet: it opens with the first picture."""
        self._fps, self._title = fps, title
        self._surface: Any = None
        self._clock: Any = None

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture uint8 [height, width, 3]."""
        import pygame

        if self._surface is None:
            pygame.display.init()
            self._surface = pygame.display.set_mode((picture.shape[1], picture.shape[0]))
            pygame.display.set_caption(self._title)
            self._clock = pygame.time.Clock()
        self._surface.blit(pygame.surfarray.make_surface(picture.transpose(1, 0, 2)), (0, 0))
        pygame.event.pump()
        self._clock.tick(self._fps)
        pygame.display.flip()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._surface is not None:
            import pygame

            pygame.display.quit()
            self._surface = None
