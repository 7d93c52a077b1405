"""The 2DBN as flat arrays for compiled kernels, and the kernels that draw from it.

The planners' inner loops take `Packed` apart into its arrays (numba compiles them as plain arguments).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nesy.compiled import njit
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.rows import code_type
from nesy.errors import UserError


class Packed(NamedTuple):
    """Flat arrays of a 2DBN; a named tuple, so numba takes it as an argument."""

    cumulative: np.ndarray
    """float64 [rows, K]: running sums of the table rows; the last entry is exactly 1."""
    probabilities: np.ndarray
    """float64 [rows, K]."""
    offsets: np.ndarray
    """int64 [A, N]: first row of each table."""
    num_parents: np.ndarray
    """int64 [A, N]."""
    parents: np.ndarray
    """int64 [A, N, P]: parents; p < N is factor p of slice t, p >= N factor p - N of slice t+1; -1 pads."""
    strides: np.ndarray
    """int64 [A, N, P]: what a parent's value is multiplied with to give the row; 0 pads."""
    order: np.ndarray
    """int64 [N]: the order in which the factors of slice t+1 are decided."""


def packed(dbn: TwoSliceDBN) -> Packed:
    """Flatten `dbn`."""
    num_actions, num_factors = dbn.num_actions, dbn.num_factors
    most = max(1, max(len(dbn.parents(a, i)) for a in range(num_actions) for i in range(num_factors)))
    num_parents = np.zeros((num_actions, num_factors), dtype=np.int64)
    parents = np.full((num_actions, num_factors, most), -1, dtype=np.int64)
    strides = np.zeros((num_actions, num_factors, most), dtype=np.int64)
    for a in range(num_actions):
        for i in range(num_factors):
            ps = dbn.parents(a, i)
            num_parents[a, i] = len(ps)
            for position, (where, parent) in enumerate(ps):
                parents[a, i, position] = where * num_factors + parent
                strides[a, i, position] = dbn.num_values ** (len(ps) - 1 - position)
    cumulative = np.cumsum(dbn.probabilities, axis=1)
    cumulative /= cumulative[:, -1:]
    return Packed(
        cumulative=cumulative,
        probabilities=np.array(dbn.probabilities),
        offsets=np.array(dbn.offsets),
        num_parents=num_parents,
        parents=parents,
        strides=strides,
        order=np.array(dbn.order, dtype=np.int64),
    )


@njit(cache=True)
def sample_into(
    cumulative: np.ndarray,
    offsets: np.ndarray,
    num_parents: np.ndarray,
    parents: np.ndarray,
    strides: np.ndarray,
    order: np.ndarray,
    code: np.ndarray,
    action: int,
    uniforms: np.ndarray,
    out: np.ndarray,
) -> None:
    """Draw one next code from one code; `uniforms` [N] in [0, 1), `out` [N] is written."""
    num_factors = order.shape[0]
    num_values = cumulative.shape[1]
    for position in range(num_factors):
        i = order[position]
        row = offsets[action, i]
        for j in range(num_parents[action, i]):
            p = parents[action, i, j]
            value = code[p] if p < num_factors else out[p - num_factors]
            row += strides[action, i, j] * value
        draw = uniforms[i]
        k = 0
        while k < num_values - 1 and draw >= cumulative[row, k]:
            k += 1
        out[i] = k


@njit(cache=True)
def _sample_codes(
    cumulative: np.ndarray,
    offsets: np.ndarray,
    num_parents: np.ndarray,
    parents: np.ndarray,
    strides: np.ndarray,
    order: np.ndarray,
    codes: np.ndarray,
    actions: np.ndarray,
    uniforms: np.ndarray,
) -> np.ndarray:
    result = np.empty(codes.shape, dtype=codes.dtype)
    for b in range(codes.shape[0]):
        sample_into(
            cumulative,
            offsets,
            num_parents,
            parents,
            strides,
            order,
            codes[b],
            actions[b],
            uniforms[b],
            result[b],
        )
    return result


def sample_codes(tables: Packed, codes: np.ndarray, actions: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
    """Draw a next code for every code.

    Args:
        tables: the packed model.
        codes: integers [B, N], as `TwoSliceDBN.code_type`.
        actions: integers [B].
        uniforms: float64 [B, N] in [0, 1).

    Returns:
        [B, N] of that type: the same as `TwoSliceDBN.sample` on the same uniform numbers.
    """
    if codes.shape != uniforms.shape or codes.shape[:1] != actions.shape:
        raise UserError(
            f"codes {list(codes.shape)}, actions {list(actions.shape)} and uniforms {list(uniforms.shape)} do not fit"
        )
    return _sample_codes(
        tables.cumulative,
        tables.offsets,
        tables.num_parents,
        tables.parents,
        tables.strides,
        tables.order,
        np.ascontiguousarray(codes, dtype=code_type(tables.cumulative.shape[1])),
        np.ascontiguousarray(actions, dtype=np.int64),
        np.ascontiguousarray(uniforms, dtype=np.float64),
    )
