"""Arrays from outside: wrong ones are refused before compiled loops read beyond their tables."""

from __future__ import annotations

import numpy as np

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
