"""Observable predicates of a view: a declared vocabulary, computed for many views at once.

Names are ASP constants. View coordinates (vx, vy): the viewer at (v // 2, v - 1), looking towards vy = 0.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from domains.core import CELL_KINDS, EMPTY, GOAL, UNSEEN, WALL, DomainError, ViewGeometry


class ViewPredicates:
    """The vocabulary of person following, for one view geometry.

    `wall_ahead` and its like are about the cell next to the viewer; unseen cells count neither as wall nor as
    free, so that with occlusion a predicate holds only where the view shows that it holds.
    """

    def __init__(self, geometry: ViewGeometry) -> None:
        """List the predicates of views of this geometry."""
        self.geometry = geometry
        width = geometry.view_size
        half = width // 2
        meanings: dict[str, str] = {}
        for kind in CELL_KINDS:
            for vx in range(width):
                for vy in range(width):
                    meanings[f"cell_{kind}_{vx}_{vy}"] = f"the cell at view coordinates ({vx}, {vy}) is {kind}"
        sides = {"ahead": "in front", "left": "to the left", "right": "to the right"}
        for side, words in sides.items():
            meanings[f"wall_{side}"] = f"the neighbouring cell {words} is a wall"
        for side, words in sides.items():
            meanings[f"free_{side}"] = f"the neighbouring cell {words} can be entered (empty or goal)"
        for steps in range(1, width):
            meanings[f"free_steps_{steps}"] = f"at least {steps} cells straight ahead can be entered one by one"
        meanings["goal_visible"] = "a goal is in the view"
        meanings["goal_ahead"] = "the cell in front is a goal"
        meanings["goal_in_line"] = "a goal is straight ahead, nothing but free cells before it"
        for side in ("left", "right"):
            meanings[f"goal_to_{side}"] = f"a goal is visible on the {side} half of the view"
        meanings["opening_visible"] = "a free cell with walls on two opposite sides is in the view"
        meanings["opening_ahead"] = "the cell in front is free, and the cells left and right of it are walls"
        meanings["at_opening"] = "the viewer stands between two walls, to its left and to its right"
        for vx in range(width):
            for vy in range(width):
                meanings[f"opening_{vx}_{vy}"] = (
                    f"the cell at ({vx}, {vy}) is free with walls on two opposite sides, all seen"
                )
        meanings["corridor"] = "walls to the left and to the right, the cell in front is free"
        meanings["corner"] = "a wall in front and a wall to exactly one side"
        meanings["dead_end"] = "walls in front, to the left and to the right"
        meanings["open_space"] = "no neighbouring cell in front, to the left or to the right is a wall"
        meanings["all_seen"] = "no cell of the view is unseen"
        meanings["unseen_cells"] = "some cell of the view is unseen"
        self._meanings = meanings
        self._half = half

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the P predicates, in the order of `evaluate`'s columns."""
        return tuple(self._meanings)

    @property
    def meanings(self) -> Mapping[str, str]:
        """One line per name."""
        return dict(self._meanings)

    def evaluate(self, views: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Truth `[n, P]` of every predicate on views `[n, v, v]`.

        Raises:
            DomainError: views of another shape or with unknown cell kinds.
        """
        views = np.asarray(views)
        width, half = self.geometry.view_size, self._half
        if views.ndim != 3 or views.shape[1:] != (width, width):
            raise DomainError(f"views must have shape (n, {width}, {width}), got {views.shape}")
        if (views >= len(CELL_KINDS)).any():
            raise DomainError(f"cell kinds must be in 0..{len(CELL_KINDS) - 1}, got {views.max()}")
        wall = views == WALL
        free = (views == EMPTY) | (views == GOAL)
        goal = views == GOAL
        truth: dict[str, NDArray[np.bool_]] = {}
        for kind, name in enumerate(CELL_KINDS):
            for vx in range(width):
                for vy in range(width):
                    truth[f"cell_{name}_{vx}_{vy}"] = views[:, vx, vy] == kind
        near = {"ahead": (half, width - 2), "left": (half - 1, width - 1), "right": (half + 1, width - 1)}
        for side, (vx, vy) in near.items():
            truth[f"wall_{side}"] = wall[:, vx, vy]
            truth[f"free_{side}"] = free[:, vx, vy]
        straight = np.ones(len(views), np.bool_)
        in_line = np.zeros(len(views), np.bool_)
        for steps in range(1, width):
            in_line |= straight & goal[:, half, width - 1 - steps]
            straight = straight & free[:, half, width - 1 - steps]
            truth[f"free_steps_{steps}"] = straight
        truth["goal_visible"] = goal.any(axis=(1, 2))
        truth["goal_ahead"] = goal[:, half, width - 2]
        truth["goal_in_line"] = in_line
        truth["goal_to_left"] = goal[:, :half].any(axis=(1, 2))
        truth["goal_to_right"] = goal[:, half + 1 :].any(axis=(1, 2))
        across = np.zeros_like(wall)
        across[:, 1:-1, :] = wall[:, :-2, :] & wall[:, 2:, :]
        along = np.zeros_like(wall)
        along[:, :, 1:-1] = wall[:, :, :-2] & wall[:, :, 2:]
        opening = free & (across | along)
        truth["opening_visible"] = opening.any(axis=(1, 2))
        truth["opening_ahead"] = free[:, half, width - 2] & across[:, half, width - 2]
        truth["at_opening"] = truth["wall_left"] & truth["wall_right"]
        for vx in range(width):
            for vy in range(width):
                truth[f"opening_{vx}_{vy}"] = opening[:, vx, vy]
        ahead, left, right = truth["wall_ahead"], truth["wall_left"], truth["wall_right"]
        truth["corridor"] = left & right & truth["free_ahead"]
        truth["corner"] = ahead & (left ^ right)
        truth["dead_end"] = ahead & left & right
        truth["open_space"] = truth["free_ahead"] & truth["free_left"] & truth["free_right"]
        unseen = (views == UNSEEN).any(axis=(1, 2))
        truth["all_seen"] = ~unseen
        truth["unseen_cells"] = unseen
        return np.stack([truth[name] for name in self._meanings], axis=1)
