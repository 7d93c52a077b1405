"""A toy world for the tests: 3 x 3 views, a codec that reads cells off, a network that is a table."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from nesy.dbn.codebook import Codebook, value_meanings
from nesy.dbn.learning.extraction import extract
from nesy.dbn.learning.transitions import Transitions
from nesy.dbn.model import TwoSliceDBN


class Predicates:
    """Three predicates of a view [3, 3]; the viewer stands at (1, 2) and looks to y = 0."""

    names = ("wall_ahead", "goal_visible", "all_free")
    meanings: ClassVar[dict[str, str]] = {
        "wall_ahead": "the cell in front is a wall",
        "goal_visible": "some cell is the goal",
        "all_free": "",
    }

    def evaluate(self, views: np.ndarray) -> np.ndarray:
        flat = views.reshape(len(views), -1)
        return np.column_stack([views[:, 1, 1] == 1, (flat == 2).any(axis=1), (flat == 0).all(axis=1)])


def all_views() -> np.ndarray:
    """Eight views: wall in front or not, wall on the left or not, goal far ahead or not."""
    views = np.zeros((8, 3, 3), dtype=np.uint8)
    for number in range(8):
        views[number, 1, 1] = number & 1
        views[number, 0, 2] = (number >> 1) & 1
        views[number, 1, 0] = 2 * (number >> 2)
    return views


def encode_views(views: np.ndarray) -> np.ndarray:
    """Codes of 3 factors with 3 values: front, left, goal; the value 2 is never used."""
    return np.column_stack([views[:, 1, 1], views[:, 0, 2], views[:, 1, 0] // 2]).astype(np.uint8)


class Network:
    """Action 0 swaps front and left; action 1 clears the front where it is free, else nothing changes."""

    def structure(self) -> TwoSliceDBN:
        return TwoSliceDBN.from_tables(
            [[self.conditional(action, factor) for factor in range(3)] for action in range(2)],
            [[[1], [0], [2]], [[0], [1, 0], [2]]],
            [[[], [], []], [[], [], [0]]],
        )

    def conditional(self, action: int, factor: int) -> np.ndarray:
        eye = np.eye(3)
        if action == 0:
            return eye
        if factor == 0:
            return eye
        if factor == 1:
            # free in front: the left side opens up
            return np.array([eye[0] if front == 0 else eye[left] for left in range(3) for front in range(3)])
        return np.array([eye[goal] for goal in range(3) for _ in range(3)])


def experience() -> Transitions:
    """Every view, every action, the network's own successor."""
    views = np.repeat(all_views(), 2, axis=0)
    actions = np.tile([0, 1], 8)
    later = views.copy()
    for row, action in enumerate(actions):
        if action == 0:
            later[row, 1, 1], later[row, 0, 2] = views[row, 0, 2], views[row, 1, 1]
        elif views[row, 1, 1] == 0:
            later[row, 0, 2] = 0
    return Transitions(views, actions, later, encode_views)


def toy() -> tuple[TwoSliceDBN, Codebook]:
    """The model and the codebook of the toy world."""
    transitions = experience()
    codebook = Codebook.build(transitions.views, transitions.view_codes, transitions.view_counts, Predicates())
    dbn = extract(
        Network(),
        transitions.codes,
        transitions.actions,
        transitions.next_codes,
        action_names=("swap", "go"),
        factor_names=("front", "side", "goal"),
        initial_codes=transitions.codes,
        meanings=value_meanings(codebook, 3),
    )
    return dbn, codebook
