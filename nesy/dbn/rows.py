"""Distinct rows of arrays, packed into numbers and hashed: many times faster than np.unique(axis=0)."""

from __future__ import annotations

import numpy as np

from nesy.checked_arrays import integers

_FEW = 5_000
"""Fewer rows than this are sorted as they are."""
_BLOCK = 1 << 15


def code_type(num_values: int) -> np.dtype:
    """The narrowest type that holds every value of a factor: uint8 up to K = 256."""
    return np.min_scalar_type(max(0, num_values - 1))


def unique_rows(table: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct rows in lexicographic order.

    Args:
        table: whole numbers >= 0 [n, M].

    Returns:
        `first` int64 [D]: an index of each distinct row, `index` int64 [n]: which distinct row each row is,
        `counts` int64 [D].

    Raises:
        UserError: other numbers.
    """
    table = np.asarray(table)
    if table.dtype != np.uint8:
        table = integers(table, "rows", (None, None)).astype(np.int64, copy=False)
    n, width = table.shape
    if width == 0:
        return np.zeros(min(n, 1), np.int64), np.zeros(n, np.int64), np.full(min(n, 1), n)
    bits = max(1, int(table.max(initial=0)).bit_length())
    if n < _FEW or bits * width > 63:
        return _sorted(table)
    keys = np.zeros(n, dtype=np.int64)
    for start in range(0, n, _BLOCK):  # blocks that stay in the cache
        block, rows = keys[start : start + _BLOCK], table[start : start + _BLOCK]
        for column in range(width):
            block <<= bits
            block |= rows[:, column]
    return _counted(keys)


def distinct_values(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct numbers [D], ascending, and which one each of n is, int64 [n].

    Hashed, not sorted, since millions of numbers hold few distinct ones.
    """
    import pyarrow as pa

    coded = pa.array(values).dictionary_encode()
    distinct = coded.dictionary.to_numpy()
    order = np.argsort(distinct)
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return distinct[order], rank[coded.indices.to_numpy()]


def _counted(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `unique_rows`, of numbers."""
    distinct, index = distinct_values(keys)
    first = np.empty(len(distinct), dtype=np.int64)
    first[index[::-1]] = np.arange(len(index) - 1, -1, -1)
    return first, index, np.bincount(index, minlength=len(distinct))


def _sorted(table: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if table.max(initial=0) > 255:
        # bytes of big-endian numbers sort as the numbers do
        kind = np.min_scalar_type(int(table.max())).newbyteorder(">")
        table = np.ascontiguousarray(table, dtype=kind).view(np.uint8).reshape(len(table), -1)
    padded = np.zeros((len(table), -(-table.shape[1] // 8) * 8), dtype=np.uint8)
    padded[:, : table.shape[1]] = table
    # eight columns are one big-endian number, so numbers sort as the rows do
    words = padded.view(">u8").astype(np.uint64)
    order = np.lexsort(words.T[::-1])
    new = np.ones(len(table), dtype=bool)
    new[1:] = (words[order[1:]] != words[order[:-1]]).any(axis=1)
    index = np.empty(len(table), dtype=np.int64)
    index[order] = np.cumsum(new) - 1
    return order[new], index, np.bincount(index)


def distinct_rows(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct rows of a table, and which one every row is: most rows of a large table are never met.

    Args:
        table: float64 [R, K].

    Returns:
        float64 [U, K] and uint32 [R].
    """
    bits = np.ascontiguousarray(table).view(np.uint64)
    odd = np.random.default_rng(0).integers(1 << 62, size=bits.shape[1], dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    mixed = bits ^ (bits >> np.uint64(29))
    _, first, index = np.unique((mixed * odd).sum(axis=1, dtype=np.uint64), return_index=True, return_inverse=True)
    index = index.reshape(-1).astype(np.uint32)
    if not np.array_equal(bits[first][index], bits):  # two rows with one hash
        distinct, exact = np.unique(bits, axis=0, return_inverse=True)
        return distinct.view(np.float64), exact.reshape(-1).astype(np.uint32)
    return table[first], index


def expanded_rows(distinct: np.ndarray, index: np.ndarray) -> np.ndarray:
    """What `distinct_rows` took apart; ValueError if the parts are of a wrong type."""
    if distinct.ndim != 2 or distinct.dtype != np.float64 or index.ndim != 1 or index.dtype != np.uint32:
        raise ValueError("the rows are not float64 [U, K] with an index uint32 [R]")
    return distinct[index]


def scattered_counts(rows: np.ndarray, counts: np.ndarray, number: int) -> np.ndarray:
    """Counts int64 [number] of which only some are given; ValueError if the parts are of a wrong type."""
    if rows.dtype != np.int64 or counts.dtype != np.int64 or rows.shape != counts.shape or (rows < 0).any():
        raise ValueError("the counts are not int64 numbers for rows")
    result = np.zeros(number, dtype=np.int64)
    result[rows] = counts
    return result
