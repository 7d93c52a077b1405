"""The local model where minds matter: the IALM with what the person has in mind, and with remembered surroundings.

    S   (s, q, p, z, g, n, lost, t): a scene s that experience knows; the robot's station q in it, which is its code x,
        the person's station p, which is the person's code y; the goal z that the person heads for, the goal g that is
        its own now; for how many steps it has stood there; the lost counter; the clock
    A   the robot's actions
    O   the robot's next code x', and c' where the person is in view
    T   g' ~ vanish(t, whether the person sees g)      goals move
        q' ~ moved(a, t, what is ahead)                the scene says where a motion leads
        u  ~ I(u | l) = pi(u | p, z in s)              mixed by the belief over (s, p, z): the influence
        p' = where u leads; z' = g where the person sees that z shows no goal
        lost', outcome: tables
    R   table over (imagined walk to the person, sight, arrival, lost', ...)

The belief over (s, p, z) is the perspective shift kept over time: what the person sees is what the scene shows at its
station, and what it has seen decides what it heads for. All tables have counts and are learned from logged steps.
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
from planners.models.tables import DecisionTable, Parents, stored_table
from planners.person_following.motion import NUM_MOVES
from planners.person_following.structured.known_maps.intentions import Intentions, ways_to
from planners.person_following.structured.known_maps.mind_checks import check_minds
from planners.person_following.structured.known_maps.scenes import Scenes

PHASES = (2, 3, 4, 5, 6)
"""The clock is asked about as t modulo these."""
MOVES = Parents(
    ("action", *(f"clock modulo {k}" for k in PHASES), "wall_ahead", "person_ahead"),
    tuple(range(3 + len(PHASES))),
    (False,) * (3 + len(PHASES)),
)
STEP = Parents(
    ("walk", "sight", "at_goal", "standing", "lost", "enters_goal", "person_ahead", "same_place"),
    tuple(range(8)),
    (True, False, False, True, True, False, False, False),
)
"""What reward and outcome ask about: the imagined walk to the person; whether it is in view; whether it is at its goal
and for how many steps; the lost counter before the step; whether the robot enters the person's goal; whether it went
towards the person's cell; whether both share a cell."""
MAX_WALK, MAX_STANDING = 15, 8
_PRIOR = 1.0  # examples that pi counts as, against what persons did at that very place
_FLOOR = 1e-3


@dataclass(frozen=True)
class MindModel:
    """The model as data.

    Attributes:
        scenes: the library.
        intentions: what persons head for.
        moved: P(the action moves the robot | `MOVES`).
        next_lost: P(lost' | walk after the step, lost).
        outcome, reward: given `STEP`.
        displacement: int64 [motions, 3], see `planners.person_following.structured.known_maps.scenes.Frame`.
        code_noise: how often a factor of the robot's code is not that of what the scene shows.
        horizon: for how many steps persons' ways are imagined.
        provenance: where the tables come from.
    """

    scenes: Scenes
    intentions: Intentions
    moved: DecisionTable
    next_lost: DecisionTable
    outcome: DecisionTable
    reward: DecisionTable
    code_noise: float
    horizon: int
    provenance: dict[str, Any]

    @property
    def num_lost(self) -> int:
        """Values of the lost counter."""
        return int(self.next_lost.moments.shape[1])

    @cached_property
    def policy(self) -> np.ndarray:
        """pi(u | s, z, p): float64 [S, G, Q, 4], rows sum to 1."""
        scenes, known = self.scenes, self.intentions
        shape = known.counts.shape
        out = np.full(shape, 1.0 / NUM_MOVES)
        estimates = known.ways.estimates()
        for s in range(shape[0]):
            stations = np.flatnonzero(scenes.cell[s] >= 0)
            for k in np.flatnonzero(scenes.goals[s] >= 0):
                cell = np.full(len(stations), int(scenes.goals[s, k]))
                rows = estimates[known.ways.locate(ways_to(scenes, np.full(len(stations), s), stations, cell))]
                counts = known.counts[s, k, stations]
                mixed = (counts + _PRIOR * rows) / (counts.sum(-1, keepdims=True) + _PRIOR)
                out[s, k, stations] = (1 - _FLOOR) * mixed + _FLOOR / NUM_MOVES
        return out

    @cached_property
    def moved_chance(self) -> np.ndarray:
        """P(moved | t, action, wall ahead, person ahead): float64 [T, A, 2, 2]."""
        shape = (self.horizon + 1, 4, 2, 2)
        t, action, wall, person = (part.ravel() for part in np.indices(shape))
        variables = move_variables(t, action, wall, person)
        return np.asarray(self.moved.estimates()[self.moved.locate(variables)][:, 1].reshape(shape))

    @cached_property
    def lost_chance(self) -> np.ndarray:
        """P(lost' | walk, lost): float64 [D, L, L]."""
        shape = (MAX_WALK + 1, self.num_lost)
        variables = np.stack([part.ravel() for part in np.indices(shape)], 1).astype(np.int32)
        return np.asarray(self.next_lost.estimates()[self.next_lost.locate(variables)].reshape(*shape, -1))

    @cached_property
    def judgement(self) -> np.ndarray:
        """(E[r], P(it goes on)) by the variables of `STEP`: float64 [D, 2, 2, N, L, 2, 2, 2, 2]."""
        shape = (MAX_WALK + 1, 2, 2, MAX_STANDING + 1, self.num_lost, 2, 2, 2)
        variables = np.stack([part.ravel() for part in np.indices(shape)], 1).astype(np.int32)
        reward = self.reward.estimates()[self.reward.locate(variables)][:, 0]
        goes_on = self.outcome.estimates()[self.outcome.locate(variables)][:, 0]
        return np.stack([reward, goes_on], -1).reshape(*shape, 2)

    def vanish_chance(self, t: int, seen: bool) -> float:
        """P(the person's goal moves in the step after t | whether the person sees it at t)."""
        counts = self.intentions.vanish
        if t >= len(counts):
            return 0.0
        stayed, gone = counts[t, int(seen)]
        return float(gone / (stayed + gone + 1.0))

    def save(self, folder: Path) -> None:
        """Write minds.json and minds.npz into `folder`."""
        arrays = {f"scenes.{name}": array for name, array in self.scenes.arrays().items()}
        known = self.intentions
        arrays |= {"counts": known.counts, "prior": known.prior, "vanish": known.vanish, "starts": known.starts}
        for name, table in self._tables().items():
            arrays |= {f"{name}.{part}": array for part, array in table.arrays().items()}
        with atomic_path(folder / "minds.npz") as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
        description = {
            "format": "nesy-minds",
            "code_noise": self.code_noise,
            "horizon": self.horizon,
            "tables": {
                name: {"kind": table.kind, "names": {str(s): text for s, text in table.names.items()}}
                for name, table in self._tables().items()
            },
            "scenes": len(self.scenes.keys),
            "provenance": self.provenance,
        }
        write_json(folder / "minds.json", description)

    @classmethod
    def load(cls, folder: Path) -> MindModel:
        """Read what `save` wrote.

        Raises:
            UserError: a file is missing or damaged.
        """
        description = read_json(folder / "minds.json")
        path = folder / "minds.npz"
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}

            def table(name: str) -> DecisionTable:
                return stored_table(name, description["tables"][name], arrays)

            scenes = {name.removeprefix("scenes."): a for name, a in arrays.items() if name.startswith("scenes.")}
            model = cls(
                Scenes.from_arrays(scenes),
                Intentions(table("ways"), arrays["counts"], arrays["prior"], arrays["vanish"], arrays["starts"]),
                table("moved"),
                table("next_lost"),
                table("outcome"),
                table("reward"),
                float(description["code_noise"]),
                int(description["horizon"]),
                dict(description["provenance"]),
            )
            variables = {
                "moved": len(MOVES.names),
                "next_lost": 2,
                "outcome": len(STEP.names),
                "reward": len(STEP.names),
            }
            check_minds(model, variables)
            return model
        except (OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error):
            raise UserError(f"{path}: missing or damaged; learn the tables again (nesy compare)") from None

    def _tables(self) -> dict[str, DecisionTable]:
        return {
            "ways": self.intentions.ways,
            "moved": self.moved,
            "next_lost": self.next_lost,
            "outcome": self.outcome,
            "reward": self.reward,
        }


def move_variables(t: np.ndarray, action: np.ndarray, wall: np.ndarray, person: np.ndarray) -> np.ndarray:
    """The variables of `MOVES`: int32 [n, 3 + phases]."""
    return np.stack([action, *(t % k for k in PHASES), wall, person], axis=1).astype(np.int32)
