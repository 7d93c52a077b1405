"""Drawing the next code from a 2DBN in constant time per factor: Walker's alias method over packed tables.

Every row of a table becomes K cells; 32 random bits r choose cell floor(r K / 2^32), and the fraction of r K / 2^32
whether the cell's own value is drawn or the other one that it holds. Other value and threshold lie in one uint32 (the
lowest bits are the value), so a draw costs one look-up and half a random number, and tables of 8 x 8 x 8 rows stay in
the second-level cache. What a draw of one factor needs to know lies side by side. Exact up to 2^-(32 - w) / K per
cell, w the bits of a value: 2^-32 for K = 8. Source: Walker 1977; Vose 1991; Lemire 2019 (the integer product).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nesy.compiled import njit
from nesy.dbn.inference.kernels import Packed
from planners.search.random_bits import random_bits

_HALF, _LOW = np.uint64(32), np.uint64(0xFFFFFFFF)
_FACTOR, _FIRST, _PARENTS = np.uint64(0), np.uint64(1), 2  # columns of a plan's row


class CodeSampler(NamedTuple):
    """A 2DBN for drawing; unsigned throughout, as compiled code asks of signed indices whether they are negative.

    Attributes:
        cell: uint32 [rows * K], threshold and other value.
        plan: uint64 [A, N, 2 + 2P], in the order in which factors are drawn: factor, first cell of its table, then
            every parent with what its value is multiplied by; a parent p >= N is factor p - N of the next slice;
            padded with parent 0 and factor 0.
        num_values: uint64 [1], K.
        other: uint64 [1], the bits of a cell that hold the other value.
    """

    cell: np.ndarray
    plan: np.ndarray
    num_values: np.ndarray
    other: np.ndarray


def sampler(dbn: Packed) -> CodeSampler:
    """The tables of `dbn` in alias form."""
    num_values = dbn.probabilities.shape[1]
    width = max((num_values - 1).bit_length(), 1)
    num_actions, num_factors, most = dbn.parents.shape
    plan = np.zeros((num_actions, num_factors, _PARENTS + 2 * most), np.uint64)
    plan[:, :, _FACTOR] = dbn.order
    plan[:, :, _FIRST] = dbn.offsets[:, dbn.order] * num_values
    plan[:, :, _PARENTS::2] = np.maximum(dbn.parents, 0)[:, dbn.order]
    plan[:, :, _PARENTS + 1 :: 2] = np.where(dbn.parents >= 0, dbn.strides, 0)[:, dbn.order] * num_values
    return CodeSampler(
        packed_cells(alias_cells(dbn.probabilities), width).reshape(-1),
        plan,
        np.array([num_values], np.uint64),
        np.array([(1 << width) - 1], np.uint64),
    )


def packed_cells(cells: np.ndarray, width: int) -> np.ndarray:
    """Cells float64 (other value + threshold) as uint32: the threshold above, the other value in `width` bits."""
    other = np.floor(cells)
    threshold = np.rint((cells - other) * (1 << (32 - width))).astype(np.uint64)
    threshold = np.minimum(threshold, (1 << (32 - width)) - 1)
    return ((threshold << np.uint64(width)) | other.astype(np.uint64)).astype(np.uint32)


def alias_cells(probabilities: np.ndarray) -> np.ndarray:
    """Alias form of distributions float64 [rows, K]: float64 [rows, K], other value + threshold."""
    num_rows, num_values = probabilities.shape
    left = probabilities / probabilities.sum(axis=1, keepdims=True) * num_values
    cells = np.tile(np.arange(num_values, dtype=np.float64), (num_rows, 1))  # other = itself: always drawn
    done = np.zeros((num_rows, num_values), np.bool_)
    rows = np.arange(num_rows)
    for _ in range(num_values - 1):
        # The smallest unfinished cell is filled up from the largest one.
        small = np.where(done, np.inf, left).argmin(axis=1)
        large = np.where(done, -np.inf, left).argmax(axis=1)
        own = left[rows, small]
        partly = (own < 1.0 - 1e-15) & (small != large)
        cells[rows[partly], small[partly]] = large[partly] + own[partly]
        left[rows[partly], large[partly]] -= 1.0 - own[partly]
        done[rows, small] = True
    return cells


@njit(cache=True)
def next_code(
    codes: CodeSampler, source: np.ndarray, start: int, action: int, target: np.ndarray, at: int, rng: np.ndarray
) -> None:
    """Draw target[at : at + N], given source[start : start + N] and the action."""
    num_values, bits_of_other, plan = codes.num_values[0], codes.other[0], codes.plan
    num_factors, columns = np.uint64(plan.shape[1]), plan.shape[2]
    a, first_now, first_next = np.uint64(action), np.uint64(start), np.uint64(at)
    number = np.uint64(0)
    for i in range(plan.shape[1]):
        position = np.uint64(i)
        row = plan[a, position, _FIRST]
        for j in range(_PARENTS, columns, 2):
            p = plan[a, position, np.uint64(j)]
            value = source[first_now + p] if p < num_factors else target[first_next + p - num_factors]
            row += plan[a, position, np.uint64(j + 1)] * np.uint64(value)
        number = random_bits(rng) if i & 1 == 0 else number << _HALF  # two draws from one number
        scaled = (number >> _HALF) * num_values
        own = scaled >> _HALF
        cell = np.uint64(codes.cell[row + own])
        other = cell & bits_of_other
        target[first_next + plan[a, position, _FACTOR]] = own if (scaled & _LOW) < cell - other else other
