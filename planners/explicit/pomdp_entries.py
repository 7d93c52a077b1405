"""Tables that a `.pomdp` file fills entry by entry: `*` stands for all, later entries replace earlier ones.

    cell     (a, s, s') of T, (a, s, s', o) of R
    entry    fixes some coordinates of a cell and holds for all values of the others
    layer    all entries that fix the same coordinates, sorted; of two for the same cells the later one stays
    value    of a cell: that of the latest entry in any layer, 0 without one

Only cells that count are looked up (possible steps, possible observations), and only in as many coordinates as the
entries fix. So the work grows with the file and with the transitions that are not zero, never with S * S * O.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse

from nesy.errors import UserError

_AT_ONCE = 1 << 20  # cells that are looked up at once
_MOST_TRANSITIONS = 200_000_000  # that are not zero, over all actions
_ROUNDING = 1e-3  # how far a row may be from summing to 1


class Layer(NamedTuple):
    """Entries that fix the same coordinates.

    Attributes:
        fixed: which coordinates, one flag each.
        keys: int64 [N], ascending: the cells, in row-major order; coordinates that are not fixed count as 0.
        values: float64 [N].
        times: int64 [N]; the place of the entry in the file.
    """

    fixed: tuple[bool, ...]
    keys: np.ndarray
    values: np.ndarray
    times: np.ndarray


class Entries:
    """The entries of one table.

    Args:
        shape: size of each coordinate; the first is the action.
    """

    def __init__(self, shape: Sequence[int]) -> None:
        self.strides = [int(np.prod(shape[i + 1 :], dtype=np.int64)) for i in range(len(shape))]
        self._logs: dict[tuple[bool, ...], tuple[array[int], array[float], array[int]]] = {}
        self._sorted: list[Layer] | None = None
        self._count = 0

    def put(self, where: Sequence[int | None], value: float) -> None:
        """One value for all cells that agree in the coordinates given; None stands for `*`."""
        keys, values, times = self._log(tuple([i is not None for i in where]))
        keys.append(sum([i * n for i, n in zip(where, self.strides, strict=True) if i is not None]))
        values.append(value)
        times.append(self._count)
        self._count += 1

    def put_block(self, where: Sequence[int | None], cells: Sequence[np.ndarray], values: np.ndarray) -> None:
        """All values of the last coordinates, for the first ones given.

        Args:
            where: the first coordinates; None stands for `*`.
            cells: the last ones, int64 [N] each; the block is 0 elsewhere.
            values: float64 [N].
        """
        self.put((*where, *[None] * len(cells)), 0.0)
        log = self._log((*(i is not None for i in where), *[True] * len(cells)))
        base = sum(i * n for i, n in zip(where, self.strides, strict=False) if i is not None)
        keys = np.full(len(values), base, np.int64)
        for cell, stride in zip(cells, self.strides[len(where) :], strict=True):
            keys += cell.astype(np.int64) * stride
        log[0].frombytes(keys.tobytes())
        log[1].frombytes(values.astype(np.float64).tobytes())
        log[2].frombytes(np.full(len(values), self._count, np.int64).tobytes())
        self._count += 1

    def of(self, action: int) -> list[Layer]:
        """The layers of one action; their keys leave the action out."""
        found = []
        for layer in self._layers():
            begin, end = 0, len(layer.keys)
            if layer.fixed[0]:
                begin, end = np.searchsorted(layer.keys, (action * self.strides[0], (action + 1) * self.strides[0]))
            if begin < end:
                offset = action * self.strides[0] if layer.fixed[0] else 0
                part = slice(int(begin), int(end))
                found.append(Layer(layer.fixed[1:], layer.keys[part] - offset, layer.values[part], layer.times[part]))
        return found

    def names(self, action: int) -> bool:
        """Whether an entry names the action itself and not `*`."""
        bounds = (action * self.strides[0], (action + 1) * self.strides[0])
        ranges = (np.searchsorted(layer.keys, bounds) for layer in self._layers() if layer.fixed[0])
        return any(begin < end for begin, end in ranges)

    def latest(self, layers: Sequence[Layer], cells: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Values and times (-1: never set) of some cells of an action; coordinates as int64 [N] each."""
        values, times = np.zeros(len(cells[0])), np.full(len(cells[0]), -1, np.int64)
        for layer in layers:
            at, found = _look_up(layer.keys, self._keys(layer, cells))
            later = found & (layer.times[at] > times)
            values = np.where(later, layer.values[at], values)
            times = np.where(later, layer.times[at], times)
        return values, times

    def meets(self, layers: Sequence[Layer], cells: Sequence[np.ndarray]) -> np.ndarray:
        """Cells that agree with an entry in all coordinates but the last: bool [N]."""
        out = np.zeros(len(cells[0]), np.bool_)
        for layer in layers:
            keys = layer.keys // self.strides[-2] * self.strides[-2]
            out |= _look_up(keys, self._keys(layer._replace(fixed=(*layer.fixed[:-1], False)), cells))[1]
        return out

    def _keys(self, layer: Layer, cells: Sequence[np.ndarray]) -> np.ndarray:
        keys = np.zeros(len(cells[0]), np.int64)
        for cell, stride, fixed in zip(cells, self.strides[1:], layer.fixed, strict=True):
            if fixed:
                keys += cell * stride
        return keys

    def _log(self, fixed: tuple[bool, ...]) -> tuple[array[int], array[float], array[int]]:
        self._sorted = None
        if fixed not in self._logs:
            self._logs[fixed] = array("q"), array("d"), array("q")
        return self._logs[fixed]

    def _layers(self) -> list[Layer]:
        if self._sorted is None:
            self._sorted = []
            for fixed, (keys, values, times) in self._logs.items():
                order = np.argsort(np.frombuffer(keys, np.int64), kind="stable")
                ordered = np.frombuffer(keys, np.int64)[order]
                last = order[np.append(ordered[1:] != ordered[:-1], True)] if len(order) else order
                arrays = [np.frombuffer(log, kind)[last] for log, kind in ((keys, "i8"), (values, "f8"), (times, "i8"))]
                self._sorted.append(Layer(fixed, *arrays))
        return self._sorted


def transition_matrices(
    entries: Entries, actions: Sequence[str], states: Sequence[str], name: str
) -> list[sparse.csr_array]:
    """T of every action; rows that rounding keeps from summing to 1 are scaled.

    Raises:
        UserError: a row sums to something else or holds a negative number, or they are too many.
    """
    matrices: list[sparse.csr_array] = []
    common, total = None, 0
    for a, action in enumerate(actions):
        named = entries.names(a)
        if named or common is None:
            matrix = _transitions(entries, a, len(states), name)
            sums = np.asarray(matrix.sum(axis=1)).reshape(-1)
            lows = matrix.min(axis=1).toarray().reshape(-1) if matrix.nnz else sums
            for s in np.flatnonzero((np.abs(sums - 1) > _ROUNDING) | (lows < 0))[:1]:
                wrong = "hold a negative number" if lows[s] < 0 else f"sum to {sums[s]:.6g}, not 1"
                raise UserError(f"{name}: transitions of action '{action}' in state '{states[s]}' {wrong}")
            matrix.data /= np.repeat(sums, np.diff(matrix.indptr))
            total += matrix.nnz
            _check_number(total, name)
        else:
            matrix = common
        matrices.append(matrix)
        common = common if named else matrix
    return matrices


def _transitions(entries: Entries, action: int, count: int, name: str) -> sparse.csr_array:
    """The cells of one action that are not zero."""
    layers, every = entries.of(action), np.arange(count)
    rows, columns = [layer for layer in layers if not layer.fixed[1]], [layer for layer in layers if layer.fixed[1]]
    # What a row has where nothing names the next state, and since when; entries for all rows before that are gone.
    ground, since = entries.latest(rows, (every, every))
    set_alone = [layer.keys[layer.values != 0] for layer in columns if layer.fixed[0]]
    set_in_all = [
        layer.keys[(layer.values != 0) & (layer.times > since.min())] for layer in columns if not layer.fixed[0]
    ]
    none = np.zeros(0, np.int64)
    single, column = (_distinct(np.concatenate([none, *keys])) for keys in (set_alone, set_in_all))
    begins = np.searchsorted(single, np.arange(count + 1) * count)
    sizes = np.where(ground != 0, count, np.diff(begins) + len(column))
    _check_number(int(sizes.sum()), name)
    found: list[tuple[np.ndarray, ...]] = []
    for part in _parts(sizes):
        here = every[part]
        full = here[ground[here] != 0]
        rest = here[ground[here] == 0]
        keys = np.concatenate([single[begins[here[0]] : begins[here[-1] + 1]], _cross(rest, column, count)])
        keys = _distinct(keys[ground[keys // count] == 0])
        keys = np.concatenate([keys, _cross(full, every, count)])
        cells = (keys // count, keys % count)
        values, _ = entries.latest(layers, cells)
        found.append((values[values != 0], *(c[values != 0] for c in cells)))
    values, rows_of, columns_of = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    matrix = sparse.csr_array((values, (rows_of, columns_of)), (count, count))
    matrix.sort_indices()
    return matrix


def _check_number(transitions: int, name: str) -> None:
    if transitions > _MOST_TRANSITIONS:
        raise UserError(f"{name}: more than {_MOST_TRANSITIONS:,} transitions that are not zero are too many")


def expected_reward(entries: Entries, transition: Sequence[sparse.csr_array], observation: np.ndarray) -> np.ndarray:
    """R[a, s] = sum_s' T[a][s, s'] sum_o Z[a, s', o] R(a, s, s', o): float64 [A, S].

    Rewards that do not look at the state left are summed up once per state reached; states that have entries of
    their own are gone through step by step, and only where an entry of theirs looks at what follows.
    """
    num_actions, num_states, _ = observation.shape
    out, every = np.zeros((num_actions, num_states)), np.arange(num_states)
    for a in range(num_actions):
        layers, seen = entries.of(a), sparse.csr_array(observation[a])
        alike = [layer for layer in layers if not layer.fixed[0]]
        if any(_looks_ahead(layer) for layer in alike):
            out[a] = transition[a] @ _on_arrival(entries, alike, every, every, seen)
            detailed = _states_named(layers, entries.strides[1])
        else:
            plain = [layer for layer in layers if not _looks_ahead(layer)]
            out[a] = entries.latest(plain, (every, every, every))[0]
            detailed = _states_named([layer for layer in layers if _looks_ahead(layer)], entries.strides[1])
        steps = transition[a][detailed] if len(detailed) else transition[a][:0]
        for part in _parts(np.diff(steps.indptr)):
            rows = steps[part].tocoo()
            left = detailed[part][rows.row]
            value = _on_arrival(entries, layers, left, rows.col.astype(np.int64), seen)
            out[a, detailed[part]] = np.bincount(rows.row, rows.data * value, rows.shape[0])
    return out


def _on_arrival(
    entries: Entries, layers: Sequence[Layer], left: np.ndarray, reached: np.ndarray, seen: sparse.csr_array
) -> np.ndarray:
    """Expected reward of steps over what is observed at their end: float64 [N]."""
    out, times = entries.latest([layer for layer in layers if not layer.fixed[2]], (left, reached, reached))
    watching = [layer for layer in layers if layer.fixed[2]]
    steps = np.flatnonzero(entries.meets(watching, (left, reached, reached)))
    counts = np.diff(seen.indptr)[reached[steps]]
    for part in _parts(counts):
        some, count = steps[part], counts[part]
        step = np.repeat(some, count)
        at = np.arange(count.sum()) + np.repeat(seen.indptr[reached[some]] - np.cumsum(count) + count, count)
        value, time = entries.latest(watching, (left[step], reached[step], seen.indices[at].astype(np.int64)))
        value = np.where(time > times[step], value, out[step])
        out[some] = np.bincount(np.repeat(np.arange(len(some)), count), seen.data[at] * value, len(some))
    return out


def _looks_ahead(layer: Layer) -> bool:
    return layer.fixed[1] or layer.fixed[2]


def _states_named(layers: Sequence[Layer], stride: int) -> np.ndarray:
    named = [layer.keys // stride for layer in layers if layer.fixed[0]]
    return _distinct(np.concatenate(named)) if named else np.zeros(0, np.int64)


def _look_up(keys: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of the wanted keys among ascending ones, and whether they are there."""
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return at, keys[at] == wanted


def _distinct(keys: np.ndarray) -> np.ndarray:
    """Ascending keys, each once; by sorting, as they are mostly in order (`np.unique` hashes, ten times as slow)."""
    ordered = np.sort(keys, kind="stable")
    return ordered[np.append(True, ordered[1:] != ordered[:-1])[: len(ordered)]]


def _cross(rows: np.ndarray, columns: np.ndarray, count: int) -> np.ndarray:
    keys: np.ndarray = (rows[:, None] * count + columns[None, :]).reshape(-1)
    return keys


def _parts(sizes: np.ndarray) -> Iterator[slice]:
    """Slices of things of these sizes, each of about `_AT_ONCE` at most (or of one thing)."""
    ends, begin = np.cumsum(sizes), 0
    while begin < len(sizes):
        done = ends[begin - 1] if begin else 0
        end = max(int(np.searchsorted(ends, done + _AT_ONCE, side="right")), begin + 1)
        yield slice(begin, end)
        begin = end
