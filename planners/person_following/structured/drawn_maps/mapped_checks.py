"""Whether a loaded model over maps is safe to run: kernels do not check what they index."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from domains.core import UNSEEN
from nesy.errors import UserError
from planners.person_following.ialm_checks import check_array, check_table
from planners.person_following.motion import NUM_HEADINGS, NUM_MOTIONS, NUM_MOVES

if TYPE_CHECKING:
    from planners.person_following.structured.drawn_maps.mapped_model import MappedModel

_LARGEST, _WIDEST, _MOST_LOST, _FARTHEST = 99, 15, 16, 1000


def check_mapped(model: MappedModel, variables: dict[str, int]) -> None:
    """Check every array.

    Args:
        model: as read from files.
        variables: how many variables each table may ask about, by its name; that of `shown` are the cells of a view.

    Raises:
        UserError: an array has a wrong type or shape, or points outside another; the message says which.
    """
    width = model.view_size
    if not 1 <= width <= _WIDEST or width % 2 == 0 or len(model.shown) != width**2:
        raise UserError(f"a view of size {width} is none, or not known cell by cell")
    for name, table in model.tables().items():
        check_table(name, table, variables.get(name, width**2))
        if table.kind != ("mean" if name in ("reward", "later") else "distribution"):
            raise UserError(f"table '{name}' is of the wrong kind")
        classes = table.moments.shape[1]
        wanted = {"person": NUM_MOVES, "informed": NUM_MOVES, "moved": 2}.get(
            name, 2 if name.startswith("shown") else classes
        )
        if classes != wanted:
            raise UserError(f"table '{name}' must tell {wanted} classes apart")
    if model.next_lost.moments.shape[1] > _MOST_LOST:
        raise UserError("table 'next_lost' counts too far")
    _check_chart(model)
    check_array("starts", model.starts, "int64", (None, 2))
    poses = model.chart.size**2 * NUM_HEADINGS
    where, often = model.starts.T
    if not ((where >= 0) & (where < poses)).all() or (often < 0).any() or not often.sum() > 0:
        raise UserError("'starts' holds poses that there are not, or no counts")


def _check_chart(model: MappedModel) -> None:
    chart = model.chart
    size = chart.usual.shape[0] if chart.usual.ndim == 2 else 0
    for name, kind, shape in (
        ("origin", "int64", (2,)),
        ("ahead", "int64", (NUM_HEADINGS, 2)),
        ("side", "int64", (NUM_HEADINGS, 2)),
        ("displacement", "int64", (NUM_MOTIONS, 3)),
        ("usual", "uint8", (size, size)),
    ):
        check_array(f"chart.{name}", getattr(chart, name), kind, shape)
    if size > _LARGEST or (chart.usual >= UNSEEN).any():
        raise UserError("'chart.usual' holds kinds of cells that there are not, or too many cells")
    for name, array, farthest in (
        ("origin", chart.origin, _FARTHEST),
        ("ahead", chart.ahead, 1),
        ("side", chart.side, 1),
        ("displacement", chart.displacement, NUM_HEADINGS - 1),
    ):
        if (np.abs(array) > farthest).any():
            raise UserError(f"'chart.{name}' leads too far")
