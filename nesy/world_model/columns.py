"""Experience as training needs it: every step as two numbers of distinct views and an action, in mapped files.

A step takes `BYTES` bytes. The columns of a folder of experience are read batch by batch and written to files that
are mapped into memory and have no name, so that they take no memory that the system cannot have back, and leave
nothing behind when the process is killed. Distinct views are few (958 on the `paper` variant) and stay in memory.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from domains.core import Weighting
from nesy.errors import UserError
from nesy.log.experience import Experience, count_rows, held_out, parts_of, stream
from nesy.world_model.distinct import Transitions, checked_actions, free_ahead, from_edges, view_keys

CHUNK = 1 << 20
"""Steps worked on at once where all are gone through."""
_TYPES = {
    "source": np.int32,
    "target": np.int32,
    "place": np.int32,
    "episode": np.int64,
    "action": np.int8,
    "free": bool,
}
BYTES = sum(np.dtype(kind).itemsize for kind in _TYPES.values())
_READ = ("view", "next_view", "action", "map_id", "episode", "configuration")


@dataclass(frozen=True)
class Columns:
    """Steps in the order in which they were made; arrays [n] may be mapped files.

    Attributes:
        views: uint8 [V, v, v], distinct, in ascending order of `view_keys`.
        maps: int64 [M], distinct, ascending: numbers of the maps.
        source: int32 [n], index of the view before.
        target: int32 [n], index of the view after.
        place: int32 [n], index of the map.
        episode: int64 [n].
        action: int8 [n].
        free: bool [n]; see `distinct.free_ahead`.
        num_actions: A.
    """

    views: np.ndarray
    maps: np.ndarray
    source: np.ndarray
    target: np.ndarray
    place: np.ndarray
    episode: np.ndarray
    action: np.ndarray
    free: np.ndarray
    num_actions: int

    def __len__(self) -> int:
        return len(self.action)

    @classmethod
    def of(cls, experience: Experience, num_actions: int | None = None) -> Columns:
        """Columns in memory, of experience in memory.

        Args:
            experience: the steps.
            num_actions: A; by default the largest action met, plus one.

        Raises:
            UserError: there is none, or it holds views or actions that cannot be learned from.
        """
        rows = {name: np.empty(len(experience), dtype=kind) for name, kind in _TYPES.items()}
        return cls._filled(rows, ({name: np.asarray(getattr(experience, name)) for name in _READ},), num_actions)

    @classmethod
    def mapped(cls, folder: Path | str, scratch: Path | str, num_actions: int | None = None) -> Columns:
        """Columns in mapped files, of a folder of experience.

        Args:
            folder: with `part-*.parquet`.
            scratch: a folder on the disk that is to hold the columns.
            num_actions: A; by default the largest action met, plus one.

        Raises:
            UserError: no experience, a damaged part, or views or actions that cannot be learned from.
        """
        count = sum(count_rows(part) or 0 for part in parts_of(folder))
        Path(scratch).mkdir(parents=True, exist_ok=True)
        rows = {name: _nameless(Path(scratch), count, kind) for name, kind in _TYPES.items()}
        return cls._filled(rows, stream(folder, _READ), num_actions)

    @classmethod
    def _filled(
        cls, rows: dict[str, np.ndarray], batches: Iterable[Mapping[str, np.ndarray]], num_actions: int | None
    ) -> Columns:
        """Number views and maps as they come, then anew in ascending order."""
        if not len(rows["action"]):
            raise UserError("no experience to train on; collect some with: nesy collect")
        views, maps = _Numbering(), _Numbering()
        shown: list[np.ndarray] = []
        end = most = 0
        for batch in batches:
            first, end = end, end + len(batch["action"])
            if any(len(column) != end - first for column in batch.values()):
                raise UserError("the columns of experience differ in length")
            action, here = checked_actions(batch["action"], num_actions)
            most = max(most, here)
            both = np.concatenate([batch["view"], batch["next_view"]])
            index, new = views.add(view_keys(both))
            shown.append(both[new])
            rows["source"][first:end], rows["target"][first:end] = np.split(index, 2)
            rows["place"][first:end] = maps.add(batch["map_id"])[0]
            rows["episode"][first:end], rows["action"][first:end] = batch["episode"], action
            rows["free"][first:end] = free_ahead(batch["configuration"], both.shape[1])
        assert end == len(rows["action"]), f"{end} steps read, {len(rows['action'])} expected"
        for name, numbering in (("source", views), ("target", views), ("place", maps)):
            rank = numbering.rank()
            for part in _chunks(end):
                rows[name][part] = rank[rows[name][part]]
        return cls(np.concatenate(shown)[np.argsort(views.rank())], maps.keys, **rows, num_actions=most)

    def held_out(self, fraction: float, rng: np.random.Generator) -> np.ndarray:
        """Bool [M]: maps to keep out of training, drawn as `nesy.log.experience.held_out` draws them."""
        return np.isin(self.maps, held_out(self.maps, fraction, rng))

    def rows(self, maps: np.ndarray) -> np.ndarray:
        """Unobstructed steps on `maps` (bool [M]): int64, ascending."""
        return np.concatenate(
            [np.flatnonzero(self.free[part] & maps[self.place[part]]) + part.start for part in _chunks(len(self))]
        )

    def transitions(
        self, maps: np.ndarray | None = None, views: np.ndarray | None = None, weighting: Weighting = "visits"
    ) -> Transitions:
        """Distinct views and unobstructed transitions, as `transitions_of` counts them.

        Args:
            maps: bool [M], count the steps on these maps alone.
            views: uint8 [m, v, v], further views to index although nothing was met there.
            weighting: what a transition counts as.

        Raises:
            UserError: too many views and maps to tell the steps on them apart.
        """
        total, num_maps = len(self.views), len(self.maps) if weighting == "maps" else 1
        if total * total * self.num_actions * num_maps > np.iinfo(np.int64).max:
            raise UserError(f"{total} views under {self.num_actions} actions on {num_maps} maps are too many to number")
        wanted = np.ones(len(self.maps), dtype=bool) if maps is None else maps
        visits = np.zeros(total, dtype=np.int64)
        found = []
        for part in _chunks(len(self)):
            here = wanted[self.place[part]]
            source, target = self.source[part][here].astype(np.int64), self.target[part][here].astype(np.int64)
            visits += np.bincount(source, minlength=total) + np.bincount(target, minlength=total)
            met = (source * self.num_actions + self.action[part][here]) * total + target
            if weighting == "maps":
                met = met * num_maps + self.place[part][here]
            found.append(np.unique(met[self.free[part][here]], return_counts=True))
        edge, weight = _sums(*(np.concatenate(part) for part in zip(*found, strict=True)))
        if weighting == "maps":  # one entry per (transition, map) so far
            edge, weight = np.unique(edge // num_maps, return_counts=True)
        shown = np.flatnonzero(visits)
        known = self.views[shown]
        keys, first = np.unique(
            view_keys(known if views is None else np.concatenate([known, views])), return_index=True
        )
        distinct = (known if views is None else np.concatenate([known, views]))[first]
        place = np.zeros(total, dtype=np.int64)
        place[shown] = np.searchsorted(keys, view_keys(known))
        counted = np.bincount(place[shown], visits[shown], minlength=len(keys)).astype(np.int64)
        before, action = np.divmod(edge // total, self.num_actions)
        moved = (place[before] * self.num_actions + action) * len(keys) + place[edge % total]
        return from_edges(distinct, counted, moved, weight, self.num_actions)


def _sums(keys: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct keys in ascending order, and the sum of the counts of each, int64."""
    order = np.argsort(keys, kind="stable")
    distinct, first = np.unique(keys[order], return_index=True)
    return distinct, np.add.reduceat(counts[order], first) if len(first) else counts


class _Numbering:
    """Numbers keys in the order in which they first come."""

    def __init__(self) -> None:
        self.keys = np.zeros(0, dtype=np.int64)
        self.number = np.zeros(0, dtype=np.int64)

    def add(self, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The numbers int64 [n] of keys [n], and where in `keys` each new one is, in the order of their numbers."""
        distinct, first, index = np.unique(keys, return_index=True, return_inverse=True)
        if not len(self.keys):
            self.keys = self.keys.astype(distinct.dtype)
        new = ~np.isin(distinct, self.keys)
        every = np.concatenate([self.keys, distinct[new]])
        number = np.concatenate([self.number, len(self.keys) + np.arange(new.sum())])
        order = np.argsort(every)
        self.keys, self.number = every[order], number[order]
        return self.number[np.searchsorted(self.keys, distinct)][index], first[new]

    def rank(self) -> np.ndarray:
        """For every number, the rank of its key among all keys."""
        rank = np.empty(len(self.number), dtype=np.int64)
        rank[self.number] = np.arange(len(self.number))
        return rank


def _nameless(folder: Path, count: int, kind: type) -> np.ndarray:
    if not count:
        return np.empty(0, dtype=kind)
    with tempfile.TemporaryFile(dir=folder) as stream:
        # really reserved: writing into a hole of a full disk would end the process
        os.posix_fallocate(stream.fileno(), 0, count * np.dtype(kind).itemsize)
        return np.memmap(stream, dtype=kind, mode="r+", shape=(count,))


def _chunks(count: int) -> Iterator[slice]:
    for first in range(0, count, CHUNK):
        yield slice(first, min(first + CHUNK, count))
