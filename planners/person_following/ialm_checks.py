"""Whether a loaded IALM is safe to run: kernels do not check what they index.

A run folder may come from a stranger. Every number in it that a kernel uses as an index is checked here once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nesy.errors import UserError
from planners.models.tables import DecisionTable
from planners.person_following.motion import NUM_HEADINGS, NUM_MOTIONS, NUM_MOVES, RelativeMotion

if TYPE_CHECKING:
    from planners.person_following.ialm import IALM

_MOST_CLASSES = 64
_FARTHEST = 1 << 20
_TABLE_TYPES = (("slot", "int32"), ("value", "int32"), ("ordered", "bool"), ("yes", "int32"), ("no", "int32"))


def check(model: IALM, num_variables: int) -> None:
    """Check every array.

    Args:
        model: as read from files.
        num_variables: length of the vector of variables that tables ask about.

    Raises:
        UserError: an array has a wrong type or shape, or points outside another; the message says which.
    """
    for name, table in model.tables.items():
        check_table(name, table, num_variables)
    if model.tables["influence"].moments.shape[1] != NUM_MOVES - 1:
        raise UserError(f"table 'influence' must tell {NUM_MOVES - 1} moves apart")
    _check_motion(model.motion)
    side = 2 * model.motion.window + 1
    n, k = model.num_factors, model.num_values
    check_array("leaf.values", model.leaf_values, "float64", (side, side, NUM_HEADINGS, None))
    check_array("codes", model.known_codes, "uint8", (None, n))
    check_array("initial.poses", model.initial_poses, "int16", (None, 3))
    if (model.known_codes >= k).any():
        raise UserError(f"'codes' holds a value above {k - 1}")
    if not _headings(model.initial_poses[:, 2]):
        raise UserError("'initial.poses' holds a heading that is none")
    for name, counts, length in (
        ("initial.pose_counts", model.initial_pose_counts, len(model.initial_poses)),
        ("initial.waiting", model.initial_waiting, None),
        ("codes.counts", model.person_counts, len(model.known_codes)),
    ):
        if counts.ndim != 1 or counts.dtype.kind not in "iuf" or (length is not None and len(counts) != length):
            raise UserError(f"'{name}' must be one count per entry")
        if not np.isfinite(counts).all() or (counts < 0).any() or not counts.sum() > 0:
            raise UserError(f"'{name}' must hold counts, not all of them zero")
    if not 1 <= model.view_size <= 99:
        raise UserError(f"a view of size {model.view_size} is none")


def check_table(name: str, table: DecisionTable, num_variables: int) -> None:
    """Check that a table asks about variables 0 to `num_variables` - 1, and that every walk through it ends.

    Raises:
        UserError: what is wrong with the table of that name.
    """
    nodes = len(table.slot)
    for part, kind in _TABLE_TYPES:
        check_array(f"{name}.{part}", getattr(table, part), kind, (nodes,))
    check_array(f"{name}.moments", table.moments, "float64", (nodes, None))
    if table.kind not in ("distribution", "mean") or not table.moments.shape[1] <= _MOST_CLASSES:
        raise UserError(f"table '{name}' is neither a distribution nor a mean")
    if table.kind == "mean" and table.moments.shape[1] != 3:
        raise UserError(f"table '{name}' of means needs three moments")
    if table.kind == "distribution" and (table.moments < 0).any():
        raise UserError(f"table '{name}' holds negative counts")
    asking = np.flatnonzero(table.slot >= 0)
    if (table.slot[asking] >= num_variables).any():
        raise UserError(f"table '{name}' asks about a variable that there is not")
    for child in (table.yes[asking], table.no[asking]):
        # children come after their node, so that every walk through the table ends
        if (child <= asking).any() or (child >= nodes).any():
            raise UserError(f"table '{name}' leads to a node that there is not, or back")


def _check_motion(motion: RelativeMotion) -> None:
    shape = (NUM_MOTIONS, NUM_MOVES, NUM_HEADINGS)
    check_array("motion.coefficients", motion.coefficients, "int64", (*shape, 2, 3))
    check_array("motion.next_heading", motion.next_heading, "int64", shape)
    check_array("motion.counts", motion.counts, "int64", (*shape, 2))
    if np.abs(motion.coefficients).max() > _FARTHEST or not _headings(motion.next_heading):
        raise UserError("'motion' leads to places or headings that there are not")
    if not 0 < motion.window <= 500:
        raise UserError(f"a window of {motion.window} is none")


def _headings(values: np.ndarray) -> bool:
    return bool(((values >= 0) & (values < NUM_HEADINGS)).all())


def check_array(name: str, array: np.ndarray, kind: str, shape: tuple[int | None, ...]) -> None:
    """Check type and shape (None: any length above 0) of an array, and that its numbers are finite.

    Raises:
        UserError: what is wrong with the array of that name.
    """
    fits = array.ndim == len(shape) and all(
        found > 0 and wanted in (None, found) for found, wanted in zip(array.shape, shape, strict=True)
    )
    if array.dtype != np.dtype(kind) or not fits:
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise UserError(f"'{name}' must be {kind} [{wanted}], found {array.dtype} {list(array.shape)}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise UserError(f"'{name}' holds numbers that are not finite")
