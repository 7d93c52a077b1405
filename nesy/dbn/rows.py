"""Distinct rows of arrays, found by hashing: many times faster than np.unique(axis=0)."""

from __future__ import annotations

import numpy as np


def unique_rows(table: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct rows in lexicographic order.

    Args:
        table: uint8 [n, M].

    Returns:
        `first` int64 [D]: an index of each distinct row, `index` int64 [n]: which distinct row each row is,
        `counts` int64 [D].
    """
    table = np.asarray(table, dtype=np.uint8)
    n, width = table.shape
    if width == 0:
        return np.zeros(min(n, 1), np.int64), np.zeros(n, np.int64), np.full(min(n, 1), n)
    padded = np.zeros((n, -(-width // 8) * 8), dtype=np.uint8)
    padded[:, :width] = table
    # eight columns are one big-endian number, so numbers sort as the rows do
    words = padded.view(">u8").astype(np.uint64)
    if words.shape[1] == 1:
        _, first, index, counts = np.unique(words[:, 0], return_index=True, return_inverse=True, return_counts=True)
        return first, index.reshape(-1), counts
    odd = np.random.default_rng(0).integers(1 << 62, size=words.shape[1], dtype=np.uint64) * np.uint64(2)
    mixed = ((words ^ (words >> np.uint64(31))) * (odd + np.uint64(1))).sum(axis=1, dtype=np.uint64)
    _, first, index, counts = np.unique(mixed, return_index=True, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    if not np.array_equal(words[first[index]], words):  # two rows with one hash
        _, first, index, counts = np.unique(padded, axis=0, return_index=True, return_inverse=True, return_counts=True)
        return first, index.reshape(-1), counts
    order = np.lexsort(words[first].T[::-1])
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return first[order], rank[index], counts[order]


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
