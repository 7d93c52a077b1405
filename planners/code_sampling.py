"""Drawing the next code from a 2DBN in constant time per factor: Walker's alias method over packed tables.

Every row of a table becomes K cells; a number u in [0, K) chooses cell floor(u), and its fraction whether the cell's
own value is drawn or the other one it holds. Cell and threshold lie in one float64 (other value + threshold), so a
draw costs one look-up. Exact up to 2^-45 per cell. Source: Walker 1977; Vose 1991.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nesy.compiled import njit
from nesy.dbn.kernels import Packed
from planners.random_bits import uniform


class CodeSampler(NamedTuple):
    """A 2DBN for drawing.

    Attributes:
        cell: float64 [rows, K], other value + threshold.
        offsets: int64 [A, N], first row of each table.
        parents, strides: int64 [A, N, P] as in `nesy.dbn.kernels.Packed`; padded with parent 0 and stride 0.
        order: int64 [N], the order in which factors are drawn.
    """

    cell: np.ndarray
    offsets: np.ndarray
    parents: np.ndarray
    strides: np.ndarray
    order: np.ndarray


def sampler(dbn: Packed) -> CodeSampler:
    """The tables of `dbn` in alias form."""
    return CodeSampler(
        alias_cells(dbn.probabilities),
        dbn.offsets,
        np.maximum(dbn.parents, 0),
        np.where(dbn.parents >= 0, dbn.strides, 0),
        dbn.order,
    )


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
    num_factors, num_values = codes.order.shape[0], codes.cell.shape[1]
    for position in range(num_factors):
        i = codes.order[position]
        row = codes.offsets[action, i]
        for j in range(codes.parents.shape[2]):
            p = codes.parents[action, i, j]
            value = source[start + p] if p < num_factors else target[at + p - num_factors]
            row += codes.strides[action, i, j] * value
        number = uniform(rng) * num_values
        own = int(number)
        cell = codes.cell[row, own]
        other = int(cell)
        target[at + i] = own if number - own < cell - other else other
