"""What is believed at the ends of imagined walks: beliefs rolled from pose to pose along trees of ways.

Trees are gone through level by level, all beliefs together, so that a pose is reached by one step from its parent
however many walks lead through it.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from domains.core import UNSEEN
from nesy.compiled import njit
from nesy.perspective.shortest_paths import Levels, Trees, recall
from nesy.world_model.codec import code_keys
from nesy.world_model.rolling import THRESHOLD, Rollout
from nesy.world_model.successors import PackedModel, successors

FORGET = 0.01
"""Weight that a code keeps for every cell in which it contradicts what was seen."""


class Believed(NamedTuple):
    """What is believed at nodes: `beliefs` float32 [n, N, K], and the likeliest `codes` uint8 [n, N]."""

    beliefs: np.ndarray
    codes: np.ndarray


class Forecast(Protocol):
    """What a factored roll needs of a world model."""

    def predict(self, beliefs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Next beliefs [B, N, K] after actions [B]."""
        ...


class Meaning(Protocol):
    """What a joint roll needs of a world model."""

    def views(self, codes: np.ndarray) -> np.ndarray:
        """Decoded views uint8 [B, v, v] of codes [B, N]."""
        ...


def roll_factored(model: Forecast, beliefs: np.ndarray, trees: Trees, nodes: Levels) -> Believed:
    """Roll factored beliefs float32 [R, N, K] from node to node, as published."""
    rolled = np.empty((len(nodes.row), *beliefs.shape[1:]), dtype=np.float32)
    rolled[: nodes.ends[1]] = beliefs[nodes.row[: nodes.ends[1]]]
    for depth in range(1, len(nodes.ends) - 1):
        here = slice(nodes.ends[depth], nodes.ends[depth + 1])
        actions = trees.action[nodes.row[here], nodes.pose[here]]
        rolled[here] = model.predict(rolled[nodes.before[here]], actions)
    return Believed(rolled, rolled.argmax(-1).astype(np.uint8))


class JointRoll:
    """Rolls joint distributions over codes through a forward model's tables, reminded of what the own view shows.

    A distribution is a list of codes with their mass, exact up to branches less probable than the threshold. After
    every step a code loses weight for each cell in which the view that it means contradicts the own view.
    Codes met are numbered; successors and views of each are looked up once and kept.
    """

    def __init__(self, packed: PackedModel, model: Meaning, threshold: float = THRESHOLD) -> None:
        self.packed, self.model, self.threshold = packed, model, threshold
        self._rollout = Rollout(packed, threshold)
        # By number: key, factors' values and view of a code; by number and action: where its successors are, -1 for
        # not yet looked up. All but the slots of the numbering are longer than what they hold, so that they seldom
        # have to be copied.
        self._count, self._taken = 0, 0
        self._slots = np.full(1 << 12, -1, dtype=np.int64)
        self._keys = np.zeros(0, dtype=np.int64)
        self._digits = np.zeros((0, packed.num_factors), dtype=np.uint8)
        self._views = np.zeros((0, 0), dtype=np.uint8)
        self._first, self._last = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        self._then, self._chance = np.zeros(0, dtype=np.int64), np.zeros(0)

    def __call__(self, views: np.ndarray, beliefs: np.ndarray, trees: Trees, nodes: Levels) -> Believed:
        """Roll beliefs [R, N, K] over own views uint8 [R, v, v] from node to node."""
        views = np.ascontiguousarray(views)
        num_factors, num_values = self.packed.num_factors, self.packed.num_values
        found = Believed(
            np.zeros((len(nodes.row), num_factors, num_values), dtype=np.float32),
            np.zeros((len(nodes.row), num_factors), dtype=np.uint8),
        )
        roots = nodes.row[: nodes.ends[1]]
        start, key, mass = self._rollout.spread(beliefs[roots].astype(np.float64))
        code, ends = self._numbers(key), np.searchsorted(start, np.arange(len(roots) + 1))
        self._put(found, 0, ends, code, mass)
        found.beliefs[: len(roots)] = beliefs[roots]
        for depth in range(1, len(nodes.ends) - 1):
            first, last = nodes.ends[depth], nodes.ends[depth + 1]
            row, pose = nodes.row[first:last], nodes.pose[first:last]
            before, action = nodes.before[first:last] - nodes.ends[depth - 1], trees.action[row, pose]
            self._expand(before, action, ends, code)
            ends, code, mass = _step(
                views, row, pose, before, action, ends, code, mass, self._first, self._last, self._then,
                self._chance, self._views, self.packed.num_actions, self.threshold, FORGET,
            )  # fmt: skip
            self._put(found, first, ends, code, mass)
        return found

    def _put(self, found: Believed, first: int, ends: np.ndarray, code: np.ndarray, mass: np.ndarray) -> None:
        """Marginals and likeliest codes of distributions, from node `first` on."""
        _summarise(ends, code, mass, self._digits, found.beliefs[first:], found.codes[first:], self._keys)

    def _expand(self, before: np.ndarray, action: np.ndarray, ends: np.ndarray, code: np.ndarray) -> None:
        """Look up the successors of all codes and actions that are about to be taken, and the views of those."""
        size = self.packed.num_actions
        wanted = _unexpanded(before, action, ends, code, self._first, size)
        if not len(wanted):
            return
        cuts, then, chance = successors(self.packed, self._digits[wanted // size], wanted % size, self.threshold)
        number = self._numbers(code_keys(then, self.packed.num_values))
        first, self._taken = self._taken, self._taken + len(number)
        self._first[wanted], self._last[wanted] = cuts[:-1] + first, cuts[1:] + first
        self._then, self._chance = _room(self._then, self._taken), _room(self._chance, self._taken)
        self._then[first : self._taken], self._chance[first : self._taken] = number, chance

    def _numbers(self, keys: np.ndarray) -> np.ndarray:
        """The numbers of code keys; new ones are numbered and decoded."""
        most = self._count + len(keys)
        if 2 * most > len(self._slots):
            self._slots = np.full(1 << (4 * most).bit_length(), -1, dtype=np.int64)
            _number(self._keys[: self._count], self._slots, self._keys, 0)
        self._keys = _room(self._keys, most)
        first = self._count
        numbers, self._count = _number(keys, self._slots, self._keys, first)
        if self._count > first:
            digits = self._rollout.codes(self._keys[first : self._count])
            views = self.model.views(digits).reshape(len(digits), -1)
            self._digits = _room(self._digits, self._count)
            self._views = _room(self._views if first else np.zeros((0, views.shape[1]), np.uint8), self._count)
            self._digits[first : self._count], self._views[first : self._count] = digits, views
            size = self.packed.num_actions
            self._first, self._last = _room(self._first, self._count * size), _room(self._last, self._count * size)
            self._first[first * size : self._count * size] = -1
        return numbers


def _room(array: np.ndarray, count: int) -> np.ndarray:
    """The array with room for `count` rows; what was in it is kept."""
    if count <= len(array):
        return array
    grown = np.zeros((2 * count, *array.shape[1:]), dtype=array.dtype)
    grown[: len(array)] = array
    return grown


@njit(cache=True)
def _number(keys: np.ndarray, slots: np.ndarray, known: np.ndarray, count: int) -> tuple[np.ndarray, int]:
    """Number keys, by a hash table with linear probing.

    Args:
        keys: int64 [n].
        slots: int64, a power of two of them, the numbers by hash; -1 where free. Gets the new ones.
        known: int64, the keys by number, with room for new ones.
        count: how many are known.

    Returns:
        The numbers int64 [n], and how many are known then.
    """
    mask = len(slots) - 1
    numbers = np.empty(len(keys), dtype=np.int64)
    for i in range(len(keys)):
        key = keys[i]
        mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
        slot = np.int64(mixed >> np.uint64(20)) & mask
        while slots[slot] >= 0 and known[slots[slot]] != key:
            slot = (slot + 1) & mask
        if slots[slot] < 0:
            slots[slot] = count
            known[count] = key
            count += 1
        numbers[i] = slots[slot]
    return numbers, count


@njit(cache=True)
def _unexpanded(
    before: np.ndarray, action: np.ndarray, ends: np.ndarray, code: np.ndarray, first: np.ndarray, num_actions: int
) -> np.ndarray:
    """Numbers `code * A + action` that have no successors yet, each once."""
    marked = np.zeros(len(first), dtype=np.bool_)
    wanted = np.empty(len(first), dtype=np.int64)
    count = 0
    for node in range(len(before)):
        for entry in range(ends[before[node]], ends[before[node] + 1]):
            place = code[entry] * num_actions + action[node]
            if first[place] < 0 and not marked[place]:
                marked[place] = True
                wanted[count] = place
                count += 1
    return wanted[:count].copy()


@njit(cache=True)
def _step(
    views: np.ndarray,
    row: np.ndarray,
    pose: np.ndarray,
    before: np.ndarray,
    action: np.ndarray,
    ends: np.ndarray,
    code: np.ndarray,
    mass: np.ndarray,
    first: np.ndarray,
    last: np.ndarray,
    then: np.ndarray,
    chance: np.ndarray,
    meant: np.ndarray,
    num_actions: int,
    threshold: float,
    forget: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One step of the distributions of all nodes of a level: their ends, codes and mass."""
    cells = meant.shape[1]
    seen = np.empty(cells, dtype=np.uint8)
    total_of = np.zeros(len(meant))
    touched = np.empty(len(meant), dtype=np.int64)
    wrong = np.empty(len(meant), dtype=np.int64)
    new_ends = np.zeros(len(row) + 1, dtype=np.int64)
    room = 16 * len(row) + 16
    new_code, new_mass = np.empty(room, dtype=np.int64), np.empty(room)
    for node in range(len(row)):
        count = 0
        for entry in range(ends[before[node]], ends[before[node] + 1]):
            place = code[entry] * num_actions + action[node]
            for successor in range(first[place], last[place]):
                number = then[successor]
                if total_of[number] == 0.0:
                    touched[count] = number
                    count += 1
                total_of[number] += mass[entry] * chance[successor]
        count = _prune(touched, count, total_of, threshold)
        recall(views[row[node]], pose[node], seen)
        least = cells
        for place in range(count):
            number, errors = touched[place], 0
            for cell in range(cells):
                if seen[cell] != UNSEEN and seen[cell] != meant[number, cell]:
                    errors += 1
            wrong[place] = errors
            least = min(least, errors)
        for place in range(count):
            total_of[touched[place]] *= forget ** (wrong[place] - least)
        count = _prune(touched, count, total_of, threshold)
        if new_ends[node] + count > room:
            room = 2 * (new_ends[node] + count)
            grown_code, grown_mass = np.empty(room, dtype=np.int64), np.empty(room)
            grown_code[: new_ends[node]] = new_code[: new_ends[node]]
            grown_mass[: new_ends[node]] = new_mass[: new_ends[node]]
            new_code, new_mass = grown_code, grown_mass
        for place in range(count):
            new_code[new_ends[node] + place] = touched[place]
            new_mass[new_ends[node] + place] = total_of[touched[place]]
            total_of[touched[place]] = 0.0
        new_ends[node + 1] = new_ends[node] + count
    return new_ends, new_code[: new_ends[-1]], new_mass[: new_ends[-1]]


@njit(cache=True)
def _prune(touched: np.ndarray, count: int, mass: np.ndarray, threshold: float) -> int:
    """Drop the least probable of the codes `touched[:count]` (never the likeliest), rescale to 1; how many are left."""
    total, peak = 0.0, 0.0
    for place in range(count):
        total += mass[touched[place]]
        peak = max(peak, mass[touched[place]])
    kept, left = 0, 0.0
    for place in range(count):
        number = touched[place]
        if mass[number] > threshold * total or mass[number] == peak:
            touched[kept] = number
            kept += 1
            left += mass[number]
        else:
            mass[number] = 0.0
    for place in range(kept):
        mass[touched[place]] /= left
    return kept


@njit(cache=True)
def _summarise(
    ends: np.ndarray,
    code: np.ndarray,
    mass: np.ndarray,
    digits: np.ndarray,
    beliefs: np.ndarray,
    likeliest: np.ndarray,
    keys: np.ndarray,
) -> None:
    """Marginals [n, N, K] and likeliest codes [n, N] of distributions; of equals, the code of the lowest key."""
    for node in range(len(ends) - 1):
        best = ends[node]
        for entry in range(ends[node], ends[node + 1]):
            if mass[entry] > mass[best] or (mass[entry] == mass[best] and keys[code[entry]] < keys[code[best]]):
                best = entry
            for factor in range(digits.shape[1]):
                beliefs[node, factor, digits[code[entry], factor]] += mass[entry]
        likeliest[node] = digits[code[best]]
