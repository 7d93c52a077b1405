"""The local model over a map drawn on the way: the IALM where views hide what lies behind walls.

    S   (m, q, p, lost): m the map so far; the robot's pose q in it, which with m is its code x kept over time; the
        person's pose p, where m says what the person's code y is; the lost counter
    A   the robot's actions
    O   the robot's next view, which goes into m, and c' where the person is in view
    T   q' ~ moved(a, what is ahead);  u ~ I(u | l) = sum_p pi(u | y = what m says around p) b~(p);  p' = where u leads
        lost', outcome: tables
    R   table over (imagined walk to the person's pose, sight, arrival, lost, ...)

What the map does not know stays unknown to pi, which was learned from maps as incomplete as those it is asked about:
persons who walk towards something that the robot cannot see are part of it. All tables have counts.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nesy.errors import UserError
from nesy.run_folder import atomic_path, read_json, write_json
from planners.models.tables import DecisionTable, PackedTables, Parents, pack, stored_table
from planners.person_following.motion import NUM_MOVES
from planners.person_following.structured.drawn_maps.mapped_checks import check_mapped
from planners.person_following.structured.drawn_maps.mapping import Chart

REACH, BACK, FRONT = 3, 2, 5
"""How far to the sides, behind and ahead of the person pi looks on the map."""
AROUND = (2 * REACH + 1) * (BACK + FRONT + 1)
PERSON = Parents(
    (*(f"cell {s} right, {f} ahead" for f in range(-BACK, FRONT + 1) for s in range(-REACH, REACH + 1)), "x", "y", "h"),
    tuple(range(AROUND + 3)),
    (False,) * AROUND + (True, True, False),
)
"""What pi asks about: what the map says around the person, and where in the frame that is."""
MOVES = Parents(("action", "wall_ahead", "person_ahead"), (0, 1, 2), (False,) * 3)
MAX_WALK = 15
_BELOW = tuple(f"walk <= {k}" for k in range(MAX_WALK))


def _with_walk(*others: str) -> Parents:
    """The walk as questions "at most k", in which what was never met goes with what is next to it; and others."""
    names = (*_BELOW, *others)
    return Parents(names, tuple(range(len(names))), (False,) * len(names))


STEP = _with_walk("sight", "at_goal", "lost", "enters_goal", "person_ahead", "same_place")
"""What reward and outcome ask about: the imagined walk to the person's pose; whether it is in view; whether it stands
on a goal; the lost counter before the step; whether the robot enters a goal; whether it went towards the person's
cell; whether both share a cell."""
LOST = _with_walk("lost")
LATER = _with_walk("sight", "lost")
"""What the return of the steps that are not looked at any more asks about, of robots that merely follow in them."""
_FLOOR = 1e-3
_VARIABLES = {
    name: len(parents.names)
    for name, parents in {
        "person": PERSON,
        "informed": PERSON,
        "moved": MOVES,
        "next_lost": LOST,
        "outcome": STEP,
        "reward": STEP,
        "later": LATER,
    }.items()
}


@dataclass(frozen=True)
class MappedModel:
    """The model as data.

    Attributes:
        chart: where maps lie, how poses add up, what is usual.
        person: pi, P(u | `PERSON`), on maps of what the robot has seen.
        informed: the same on maps of what both have seen, for `perfect-information`.
        shown: P(a cell of a view is shown | which cells of the view are wall), one table per cell, row by row from
            the viewer's own.
        moved: P(the action moves the robot | `MOVES`).
        next_lost: P(lost' | walk after the step, lost).
        outcome, reward: given `STEP`; the first class of outcome is that it goes on.
        later: E[return of the rest of the episode of a robot that follows | `LATER`].
        starts: int64 [n, 2], (pose, count) of persons at the start of episodes.
        view_size: V.
        provenance: where the tables come from.
    """

    chart: Chart
    person: DecisionTable
    informed: DecisionTable
    shown: tuple[DecisionTable, ...]
    moved: DecisionTable
    next_lost: DecisionTable
    outcome: DecisionTable
    reward: DecisionTable
    later: DecisionTable
    starts: np.ndarray
    view_size: int
    provenance: dict[str, Any]

    @property
    def num_lost(self) -> int:
        """Values of the lost counter."""
        return int(self.next_lost.moments.shape[1])

    def policy(self, informed: bool) -> tuple[PackedTables, np.ndarray]:
        """The table pi for kernels, and P(u) by its nodes: float64 [nodes, 4], nowhere 0."""
        table = self.informed if informed else self.person
        return pack([table]), (1 - _FLOOR) * table.estimates() + _FLOOR / NUM_MOVES

    @cached_property
    def sight(self) -> PackedTables:
        """`shown` for kernels."""
        return pack(list(self.shown))

    @cached_property
    def moved_chance(self) -> np.ndarray:
        """P(moved | action, wall ahead, person ahead): float64 [A, 2, 2]."""
        return self._over(self.moved, (NUM_MOVES, 2, 2))[..., 1]

    @cached_property
    def lost_after(self) -> np.ndarray:
        """The likeliest lost' by (walk, lost): int64 [D, L]."""
        return self._over(self.next_lost, (MAX_WALK + 1, self.num_lost)).argmax(-1)

    @cached_property
    def judgement(self) -> np.ndarray:
        """(E[r], P(it goes on)) by the variables of `STEP`: float64 [D, 2, 2, L, 2, 2, 2, 2]."""
        shape = (MAX_WALK + 1, 2, 2, self.num_lost, 2, 2, 2)
        reward, goes_on = self._over(self.reward, shape)[..., 0], self._over(self.outcome, shape)[..., 0]
        return np.stack([reward, goes_on], -1)

    @cached_property
    def afterwards(self) -> np.ndarray:
        """E[return of the rest] by the variables of `LATER`: float64 [D, 2, L]."""
        return self._over(self.later, (MAX_WALK + 1, 2, self.num_lost))[..., 0]

    @staticmethod
    def _over(table: DecisionTable, shape: tuple[int, ...]) -> np.ndarray:
        """What a table says of all combinations of its variables; the first is the walk where it goes that far."""
        variables = np.stack([part.ravel() for part in np.indices(shape)], 1)
        if shape[0] == MAX_WALK + 1:
            variables = walk_variables(variables[:, 0], *variables[:, 1:].T)
        found = table.estimates()[table.locate(variables.astype(np.int32))]
        return np.ascontiguousarray(found.reshape(*shape, -1))

    def save(self, folder: Path) -> None:
        """Write mapped.json and mapped.npz into `folder`."""
        arrays = {f"chart.{name}": array for name, array in self.chart._asdict().items()} | {"starts": self.starts}
        tables = self.tables()
        for name, table in tables.items():
            arrays |= {f"{name}.{part}": array for part, array in table.arrays().items()}
        with atomic_path(folder / "mapped.npz") as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, **arrays)
        description = {
            "format": "nesy-mapped",
            "view_size": self.view_size,
            "tables": {
                name: {
                    "kind": table.kind,
                    "names": {str(s): text for s, text in table.names.items()},
                    "rows": table.rows,
                }
                for name, table in tables.items()
            },
            "provenance": self.provenance,
        }
        write_json(folder / "mapped.json", description)

    @classmethod
    def load(cls, folder: Path) -> MappedModel:
        """Read what `save` wrote.

        Raises:
            UserError: a file is missing or damaged.
        """
        description = read_json(folder / "mapped.json")
        path = folder / "mapped.npz"
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}

            def table(name: str) -> DecisionTable:
                return stored_table(name, description["tables"][name], arrays)

            view_size = int(description["view_size"])
            model = cls(
                Chart(**{name: arrays[f"chart.{name}"] for name in Chart._fields}),
                table("person"),
                table("informed"),
                tuple(table(f"shown{i}") for i in range(min(view_size, 99) ** 2)),
                table("moved"),
                table("next_lost"),
                table("outcome"),
                table("reward"),
                table("later"),
                arrays["starts"],
                view_size,
                dict(description["provenance"]),
            )
            check_mapped(model, _VARIABLES)
            return model
        except (OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error):
            raise UserError(f"{path}: missing or damaged; learn the tables again (nesy compare)") from None

    def tables(self) -> dict[str, DecisionTable]:
        """All tables by name."""
        return {
            "person": self.person,
            "informed": self.informed,
            **{f"shown{i}": table for i, table in enumerate(self.shown)},
            "moved": self.moved,
            "next_lost": self.next_lost,
            "outcome": self.outcome,
            "reward": self.reward,
            "later": self.later,
        }


def walk_variables(walk: np.ndarray, *others: np.ndarray) -> np.ndarray:
    """The variables of tables that ask about a walk [n], and about others [n] besides: int32 [n, ...]."""
    below = walk[:, None] <= np.arange(MAX_WALK)
    return np.concatenate([below, np.stack(others, 1)], axis=1).astype(np.int32)
