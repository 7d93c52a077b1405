"""The influence-augmented local model (IALM): what the planners plan with, learned from experience.

    S   (x, y, c, waiting, lost): the robot's code x; the person's code y, that is, what the person sees;
        c = (side, ahead, heading), the person's pose relative to the robot, also where it is out of view
    A   the robot's actions
    O   the robot's next code x', and c' if the person is in view
    T   m  ~ moved(a, x, c)           whether the action moves the robot; the effective motion m
        x' ~ 2DBN(x, m)
        u  ~ I(u | l)                 waits(c after m, x', waiting), otherwise pi(u | y)
        c' = motion of c under (m, u)
        y' ~ 2DBN(y, u)               the person senses and moves as the robot does
        waiting', lost', outcome      tables
    R   table over (c', outcome, ...)

The influence I(u | l) = sum_y pi(u | y) b~(y) mixes the learned table pi with what is believed of y
(nesy.perspective.influence); `beliefs` keeps b~ as particles.

Every table is a `DecisionTable` with counts, learned from logged transitions. Nothing about the task's rules
is written down here: not what blocks a move, when the person waits, how far is too far, or what is rewarded.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from nesy.dbn.inference.kernels import Packed, packed
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from nesy.run_folder import atomic_path, read_json, write_json
from planners.models.tables import DecisionTable, PackedTables, pack
from planners.person_following.ialm_checks import check
from planners.person_following.motion import RelativeMotion

TABLES = ("moved", "waits", "influence", "next_waiting", "distance", "next_lost", "visible", "outcome", "reward")
"""The learned tables, in the order in which they are packed for kernels."""
MOVED, WAITS, INFLUENCE, NEXT_WAITING, DISTANCE, NEXT_LOST, VISIBLE, OUTCOME, REWARD = range(len(TABLES))

SCALARS = (
    "action",
    "motion",
    "person",
    "side",
    "ahead",
    "heading",
    "mid_side",
    "mid_ahead",
    "mid_heading",
    "next_side",
    "next_ahead",
    "next_heading",
    "waiting",
    "lost",
    "distance",
    "next_lost",
    "visible",
    "outcome",
)
"""Variables of one step besides the three codes x, x' and y; `mid_*` is c between the two moves."""
(
    ACTION,
    MOTION,
    PERSON,
    SIDE,
    AHEAD,
    HEADING,
    MID_SIDE,
    MID_AHEAD,
    MID_HEADING,
    NEXT_SIDE,
    NEXT_AHEAD,
    NEXT_HEADING,
    IS_WAITING,
    LOST_COUNT,
    THE_DISTANCE,
    NEXT_LOST_COUNT,
    IS_VISIBLE,
    THE_OUTCOME,
) = range(len(SCALARS))
STATE_SCALARS = 5
"""What a state holds besides the two codes: side, ahead, heading, waiting, lost."""
MAX_DISTANCE = 15
"""Distances from here on count as one."""
TIMEOUT = 5
"""An ending by the clock; the model has no clock, so such a step counts as an ordinary one."""


FORMAT, VERSION = "nesy-ialm", 3
_EVIDENCE = 0.5  # power of the product of what is believed of a code's factors: they come together, as one view
_ELSEWHERE = 0.1  # chance that a person has a code as any robot has it, not as persons were seen to
_DAMAGE = (OSError, ValueError, LookupError, TypeError, AttributeError, NotImplementedError, EOFError,
           RuntimeError, zipfile.BadZipFile, zlib.error)  # fmt: skip
"""What reading a damaged archive may raise."""
_TABLE_ARRAYS = ("slot", "value", "ordered", "yes", "no", "moments")


class Codec(Protocol):
    """What turns views into codes: `nesy.world_model.SymbolicCodec`."""

    def codes(self, views: np.ndarray) -> np.ndarray:
        """uint8 [B, V, V] -> uint8 [B, N]."""
        ...


@dataclass(frozen=True)
class IALM:
    """The model as data.

    Attributes:
        dbn: the extracted 2DBN that drives x and y.
        motion: how the relative pose c changes.
        tables: one `DecisionTable` per name in `TABLES`.
        known_codes: uint8 [V, N], the codes that experience holds; what is not among them is no view at all.
        person_counts: float64 [V], how often persons had each of them.
        initial_poses: int16 [M, 3] relative poses at the start of episodes, with `initial_pose_counts` [M].
        leaf_values: float64 [2W + 1, 2W + 1, 4, L], see planners.person_following.bounds.
        initial_waiting: counts [W] of the waiting counter at the start of episodes.
        view_size: side of the robot's view.
        provenance: where the tables come from (JSON values).
    """

    dbn: TwoSliceDBN
    motion: RelativeMotion
    tables: dict[str, DecisionTable]
    known_codes: np.ndarray
    person_counts: np.ndarray
    initial_poses: np.ndarray
    initial_pose_counts: np.ndarray
    initial_waiting: np.ndarray
    leaf_values: np.ndarray
    view_size: int
    provenance: dict[str, Any]

    @property
    def num_factors(self) -> int:
        """N, factors of a code."""
        return self.dbn.num_factors

    @property
    def num_values(self) -> int:
        """K, values of a factor."""
        return self.dbn.num_values

    @property
    def state_size(self) -> int:
        """Length of a state vector: x, y, side, ahead, heading, waiting, lost."""
        return 2 * self.num_factors + STATE_SCALARS

    @cached_property
    def packed_dbn(self) -> Packed:
        """The 2DBN in flat arrays."""
        return packed(self.dbn)

    @cached_property
    def packed_tables(self) -> PackedTables:
        """The learned tables in flat arrays."""
        return pack([self.tables[name] for name in TABLES])

    def influence_of(self, codes: np.ndarray) -> np.ndarray:
        """pi(u | y) for person's codes uint8 [n, N] -> float64 [n, 3]."""
        table = self.tables["influence"]
        variables = np.zeros((len(codes), 3 * self.num_factors), np.int32)
        variables[:, 2 * self.num_factors :] = codes
        return table.estimates()[table.locate(variables)]

    def code_chances(self, prior: np.ndarray, floor: float = 0.02) -> np.ndarray:
        """P(y) over the known codes when each factor is believed as `prior` says.

        Factors are believed one by one, but their values come together: of the products of values that `prior`
        allows only the known codes are views, and persons are seldom where most of these are had: codes are weighed
        by how often persons had them. What is believed of the factors is no independent evidence (a view that is
        believed by a tenth has most of its factors believed by a tenth), so the root of its product counts. Each
        factor keeps `floor` for all its values, so that a prior which fits no known code still prefers the codes that
        it fits best.

        Args:
            prior: float [N, K].
            floor: in (0, 1].

        Returns:
            float64 [V], sums to 1.
        """
        floored = (1 - floor) * np.asarray(prior, np.float64) + floor / self.num_values
        logarithms = _EVIDENCE * np.log(floored)[np.arange(self.num_factors), self.known_codes].sum(axis=1)
        chances = np.exp(logarithms - logarithms.max()) * self.person_chances
        return np.asarray(chances / chances.sum())

    @cached_property
    def person_chances(self) -> np.ndarray:
        """P(y) before anything is known of the person; `_ELSEWHERE` of it spread over all known codes."""
        counts = self.person_counts
        share = counts / counts.sum() if counts.sum() > 0 else np.full(len(counts), 1.0 / len(counts))
        return np.asarray((1 - _ELSEWHERE) * share + _ELSEWHERE / len(counts))

    def describe(self) -> list[dict[str, Any]]:
        """One record per table: name, rows, parents, examples."""
        return [
            {
                "table": name,
                "rows": table.rows,
                "parents": list(table.parents()),
                "examples": float(table.moments[0].sum() if table.kind == "distribution" else table.moments[0, 0]),
            }
            for name, table in self.tables.items()
        ]

    def save(self, folder: Path) -> None:
        """Write model.json and tables.npz into `folder`; the 2DBN is not repeated (it lies in `dbn/`)."""
        folder = Path(folder)
        arrays: dict[str, np.ndarray] = {f"motion.{name}": array for name, array in self.motion.arrays().items()}
        for name, table in self.tables.items():
            arrays |= {f"{name}.{part}": getattr(table, part) for part in _TABLE_ARRAYS}
        arrays["codes"] = self.known_codes
        arrays["codes.counts"] = self.person_counts
        arrays["initial.poses"] = self.initial_poses
        arrays["initial.pose_counts"] = self.initial_pose_counts
        arrays["initial.waiting"] = self.initial_waiting
        arrays["leaf.values"] = self.leaf_values
        with atomic_path(folder / "tables.npz") as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
        description = {
            "format": FORMAT,
            "version": VERSION,
            "num_factors": self.num_factors,
            "num_values": self.num_values,
            "view_size": self.view_size,
            "window": self.motion.window,
            "motion_exact": self.motion.exact,
            "kinds": {name: table.kind for name, table in self.tables.items()},
            "names": {name: {str(s): text for s, text in table.names.items()} for name, table in self.tables.items()},
            "tables": self.describe(),
            "provenance": self.provenance,
        }
        write_json(folder / "model.json", description)

    @classmethod
    def load(cls, folder: Path | str, dbn: TwoSliceDBN | None = None) -> IALM:
        """Read what `save` wrote.

        Args:
            folder: the `ialm/` of a run.
            dbn: the 2DBN; by default the one in `dbn/` beside `folder`.

        Raises:
            UserError: a file is missing, damaged, or does not belong to the 2DBN.
        """
        folder = Path(folder)
        description = read_json(folder / "model.json")
        if not isinstance(description, dict) or description.get("format") != FORMAT:
            raise UserError(f"{folder / 'model.json'}: not an influence-augmented local model")
        if description.get("version") != VERSION:
            found = f"version {description.get('version')}, this program has {VERSION}"
            raise UserError(f"{folder / 'model.json'}: {found}; learn the tables again (nesy compare)")
        dbn = TwoSliceDBN.load(folder.parent / "dbn") if dbn is None else dbn
        if (description.get("num_factors"), description.get("num_values")) != (dbn.num_factors, dbn.num_values):
            raise UserError(f"{folder}: its tables were learned for another 2DBN; learn them again (nesy compare)")
        path = folder / "tables.npz"
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            names, kinds = description["names"], description["kinds"]
            tables = {
                name: DecisionTable(
                    slot=arrays[f"{name}.slot"],
                    value=arrays[f"{name}.value"],
                    ordered=arrays[f"{name}.ordered"],
                    yes=arrays[f"{name}.yes"],
                    no=arrays[f"{name}.no"],
                    moments=arrays[f"{name}.moments"],
                    kind=str(kinds[name]),
                    names={int(slot): str(text) for slot, text in names[name].items()},
                )
                for name in TABLES
            }
            motion = RelativeMotion.from_arrays(
                {part: arrays[f"motion.{part}"] for part in ("coefficients", "next_heading", "counts")},
                int(description["window"]),
            )
            model = cls(
                dbn=dbn,
                motion=motion,
                tables=tables,
                known_codes=arrays["codes"],
                person_counts=arrays["codes.counts"],
                initial_poses=arrays["initial.poses"],
                initial_pose_counts=arrays["initial.pose_counts"],
                initial_waiting=arrays["initial.waiting"],
                leaf_values=arrays["leaf.values"],
                view_size=int(description["view_size"]),
                provenance=dict(description["provenance"]),
            )
            check(model, 3 * dbn.num_factors + len(SCALARS))
            return model
        except FileNotFoundError:
            raise UserError(f"{path}: no such file; learn the tables again (nesy compare)") from None
        except _DAMAGE as error:
            reason = f"{type(error).__name__}: {str(error)[:200]}"
            raise UserError(f"{path}: damaged ({reason}); learn the tables again (nesy compare)") from None
