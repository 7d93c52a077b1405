"""Arrays from outside: wrong ones are refused before compiled loops read beyond their tables."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nesy.errors import UserError


def whole_numbers(values: np.ndarray, what: str, shape: tuple[int | None, ...], below: int) -> np.ndarray:
    """An array of whole numbers in 0..below - 1.

    Args:
        values: the array.
        what: its plural name in messages.
        shape: wanted; None where any length will do.
        below: one more than the greatest value.

    Raises:
        UserError: another shape, kind or range.
    """
    array = np.asarray(values)
    _check_shape(array, what, shape)
    if array.size and (array.dtype.kind not in "iu" or array.min() < 0 or array.max() >= below):
        raise UserError(f"{what} are whole numbers in 0..{below - 1}")
    return array


def integers(
    values: ArrayLike, what: str, shape: tuple[int | None, ...], below: int | None = None
) -> NDArray[np.integer[Any]]:
    """Whole numbers >= 0 in any form that holds them exactly: integers, truth values, floats, lists, data frames.

    Args:
        values: the numbers.
        what: its plural name in messages.
        shape: wanted; None where any length will do.
        below: one more than the greatest value allowed; None for no limit.

    Returns:
        The array itself where it holds integers, else int64.

    Raises:
        UserError: another shape, kind or range; the message says which value.
    """
    wanted = f"{what} are whole numbers " + (">= 0" if below is None else f"in 0..{below - 1}")
    try:
        array = np.asarray(values)
        if array.dtype.kind == "O":
            array = array.astype(np.float64)
    except (ValueError, TypeError):
        raise UserError(f"{wanted}; found values that are no numbers or rows of different lengths") from None
    _check_shape(array, what, shape)
    if array.dtype.kind not in "iub":
        if array.size and array.dtype.kind != "f":
            raise UserError(f"{wanted}, found {array.dtype.name} values such as {array.reshape(-1)[0]!r}")
        odd = array != np.rint(array)  # NaN is unlike itself
        if odd.any() or (abs(array) >= 2**53).any():
            worst = array[odd][0] if odd.any() else array[abs(array) >= 2**53][0]
            raise UserError(f"{wanted}, found {worst:g}")
    if array.dtype.kind not in "iu":
        array = array.astype(np.int64)
    if array.size and (array.min() < 0 or array.max() > (np.iinfo(np.int64).max if below is None else below - 1)):
        raise UserError(f"{wanted}, found {array.min() if array.min() < 0 else array.max()}")
    return array


def distributions(values: np.ndarray, what: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """An array of numbers >= 0 that sum to 1 along the last axis (to 1e-3: beliefs may be float32).

    Args:
        values: the array.
        what: its plural name in messages.
        shape: wanted; None where any length will do.

    Raises:
        UserError: another shape, or no distributions.
    """
    array = np.asarray(values)
    _check_shape(array, what, shape)
    if array.size and not (array.min() >= 0 and np.abs(array.sum(-1) - 1).max() <= 1e-3):
        raise UserError(f"{what} are numbers >= 0 that sum to 1 along the last axis")
    return array


def _check_shape(array: np.ndarray, what: str, shape: tuple[int | None, ...]) -> None:
    fits = array.ndim == len(shape) and all(n is None or n == m for n, m in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise UserError(f"{what} have the shape [{wanted}], found {list(array.shape)}")
