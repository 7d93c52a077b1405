"""Whether a loaded model of minds is safe to run: kernels do not check what they index."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nesy.errors import UserError
from planners.person_following.ialm_checks import check_array, check_table
from planners.person_following.motion import NUM_HEADINGS, NUM_MOTIONS, NUM_MOVES
from planners.person_following.structured.known_maps.intentions import WAYS

if TYPE_CHECKING:
    from planners.person_following.structured.known_maps.minds import MindModel
    from planners.person_following.structured.known_maps.scenes import Scenes

_MOST_GOALS, _MOST_LOST, _MOST_STEPS, _FARTHEST = 8, 64, 1000, 60
_WIDEST = 99
PERIOD = 60
"""After so many steps the clock of the model of minds looks the same."""


def check_minds(model: MindModel, variables: dict[str, int]) -> None:
    """Check every array.

    Args:
        model: as read from files.
        variables: how many variables each table may ask about.

    Raises:
        UserError: an array has a wrong type or shape, or points outside another; the message says which.
    """
    _check_scenes(model.scenes)
    known = model.intentions
    scenes, stations = model.scenes.cell.shape
    goals = model.scenes.goals.shape[1]
    for name, table in (
        ("ways", known.ways),
        ("moved", model.moved),
        ("next_lost", model.next_lost),
        ("outcome", model.outcome),
        ("reward", model.reward),
    ):
        check_table(name, table, variables.get(name, len(WAYS.names)))
        if table.kind != ("mean" if name == "reward" else "distribution"):
            raise UserError(f"table '{name}' is of the wrong kind")
    for name, table, classes in (("ways", known.ways, NUM_MOVES), ("moved", model.moved, 2)):
        if table.moments.shape[1] != classes:
            raise UserError(f"table '{name}' must tell {classes} classes apart")
    if model.next_lost.moments.shape[1] > _MOST_LOST:
        raise UserError("table 'next_lost' counts too far")
    check_array("counts", known.counts, "float64", (scenes, goals, stations, NUM_MOVES))
    check_array("prior", known.prior, "float64", (scenes, goals))
    check_array("vanish", known.vanish, "float64", (None, 2, 2))
    check_array("starts", known.starts, "int64", (None, 3))
    for name, array in (("counts", known.counts), ("prior", known.prior), ("vanish", known.vanish)):
        if (array < 0).any():
            raise UserError(f"'{name}' holds negative counts")
    at, where, often = known.starts.T
    if not (_within(at, 0, scenes) and _within(where, 0, stations) and (often >= 0).all() and often.sum() > 0):
        raise UserError("'starts' holds scenes or stations that there are not")
    if (model.scenes.cell[at, where] < 0).any():
        raise UserError("'starts' holds stations that there are not")
    if not 0.0 <= model.code_noise < 1.0 or not PERIOD <= model.horizon <= _MOST_STEPS:
        raise UserError(f"code_noise {model.code_noise} or horizon {model.horizon} is none")


def _check_scenes(scenes: Scenes) -> None:
    count, stations = scenes.cell.shape if scenes.cell.ndim == 2 else (0, 0)
    cells = scenes.place.shape[1] if scenes.place.ndim == 3 else 0
    size = scenes.kinds.shape[-1]
    width = scenes.view.shape[-1]
    for name, kind, shape in (
        ("keys", "int64", (count,)),
        ("kinds", "uint8", (count, size, size)),
        ("ahead", "int64", (NUM_HEADINGS, 2)),
        ("side", "int64", (NUM_HEADINGS, 2)),
        ("place", "int16", (count, cells, 2)),
        ("pose", "int16", (count, stations, 3)),
        ("cell", "int16", (count, stations)),
        ("follows", "int16", (count, stations, NUM_MOTIONS)),
        ("view", "uint8", (count, stations, width, width)),
        ("number", "int16", (count, size, size, NUM_HEADINGS)),
        ("walk", "uint8", (count, stations, cells)),
        ("sees", "bool", (count, stations, cells)),
        ("goals", "int16", (count, None)),
        ("counts", "int64", (count,)),
    ):
        check_array(f"scenes.{name}", getattr(scenes, name), kind, shape)
    there = scenes.cell >= 0
    if scenes.goals.shape[1] > _MOST_GOALS or width > _WIDEST or width % 2 == 0:
        raise UserError("scenes of this kind are not known here")
    if (np.diff(there.astype(np.int8), axis=1) > 0).any() or not there[:, 0].all():
        raise UserError("'scenes.cell' has gaps")
    for name, array, low, high in (
        ("cell", scenes.cell, -1, cells),
        ("follows", scenes.follows, 0, stations),
        ("number", scenes.number, -1, stations),
        ("goals", scenes.goals, -1, cells),
        ("view", scenes.view, 0, 4),
        ("kinds", scenes.kinds, 0, 4),
    ):
        if not _within(array, low, high):
            raise UserError(f"'scenes.{name}' points to what there is not")
    if not _within(scenes.pose[there][:, 2], 0, NUM_HEADINGS) or not _within(
        scenes.pose[there][:, :2], -_FARTHEST, _FARTHEST
    ):
        raise UserError("'scenes.pose' holds poses that there are not")
    if not (
        _within(scenes.place, -_FARTHEST, _FARTHEST) and _within(scenes.ahead, -1, 2) and _within(scenes.side, -1, 2)
    ):
        raise UserError("'scenes.place' lies too far")
    scene, station = np.nonzero(there)
    if (scenes.cell[scene[:, None], scenes.follows[scene, station]] < 0).any():
        raise UserError("'scenes.follows' leads to stations that there are not")
    # what is seen lies in the view
    scene, station, cell = np.nonzero(scenes.sees & there[:, :, None])
    vx, vy = scenes.place_in_view(scene, station, cell, width)
    if not (_within(vx, 0, width) and _within(vy, 0, width)):
        raise UserError("'scenes.sees' holds cells that are out of view")


def _within(values: np.ndarray, low: int, high: int) -> bool:
    return bool(((values >= low) & (values < high)).all())
