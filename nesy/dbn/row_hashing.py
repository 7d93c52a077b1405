"""Distinct rows in one compiled pass over the data."""

from __future__ import annotations

import numpy as np

from nesy.compiled import njit


@njit(cache=True)
def number_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number the distinct rows in the order in which they are first met.

    Args:
        rows: uint8 [n, M], contiguous.

    Returns:
        `first` int64 [D]: where each distinct row is met first, `index` int64 [n]: which one every row is,
        `counts` int64 [D].
    """
    n, width = rows.shape
    capacity = 1 << 12
    slots = np.full(capacity, -1, dtype=np.int64)
    first, counts = np.empty(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    hashes = np.empty(n, dtype=np.uint64)
    index = np.empty(n, dtype=np.int64)
    found = 0
    for r in range(n):
        key = np.uint64(14695981039346656037)
        for c in range(width):
            key = (key ^ np.uint64(rows[r, c])) * np.uint64(1099511628211)
        key ^= key >> np.uint64(29)
        place = np.int64(key & np.uint64(capacity - 1))
        while True:
            known = slots[place]
            if known < 0:
                break
            if hashes[known] == key:
                other, same = first[known], True
                for c in range(width):
                    if rows[r, c] != rows[other, c]:
                        same = False
                        break
                if same:
                    break
            place = (place + 1) & (capacity - 1)
        if known < 0:
            known = found
            slots[place], first[known], hashes[known] = known, r, key
            found += 1
            if 2 * found > capacity:
                capacity *= 4
                slots = np.full(capacity, -1, dtype=np.int64)
                for number in range(found):
                    place = np.int64(hashes[number] & np.uint64(capacity - 1))
                    while slots[place] >= 0:
                        place = (place + 1) & (capacity - 1)
                    slots[place] = number
        index[r] = known
        counts[known] += 1
    return first[:found].copy(), index, counts[:found].copy()
