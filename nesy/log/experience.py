"""Experience: transitions in columns, one row per step, in Parquet files that are written in shards.

A folder of experience holds `part-*.parquet`; every part has the columns of `SCHEMA`. Views are flattened in
C order of `[vx, vy]` and given back as `[n, 5, 5]`. Nothing is ever pickled.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from domains.core import CELL_KINDS, OUTCOMES
from nesy.errors import UserError
from nesy.run_folder import atomic_path

SOURCES = (
    "crossing-random",
    "crossing-expert",
    "crossing-explore",
    "following-random",
    "following-expert",
    "following-mixture",
)
"""In which task, and who acted; the column `source` holds one of these. `crossing-explore` is a walk on maps as
they are in person following, whose freed cells the generated maps of the crossing task lack."""

MOST_ACTIONS = 64
"""Actions are numbered 0 to 63 at most."""

_VIEWS = ("view", "next_view", "person_view", "next_person_view")
_POSES = ("relative_pose", "next_relative_pose")
_SCALARS: dict[str, type[np.generic]] = {
    "episode": np.int64,
    "t": np.int32,
    "map_id": np.int64,
    "configuration": np.int16,
    "next_configuration": np.int16,
    "waiting": np.int16,
    "lost": np.int16,
    "action": np.int8,
    "person_action": np.int8,
    "reward": np.float32,
    "terminated": np.bool_,
    "truncated": np.bool_,
    "outcome": np.int8,
    "distance": np.float32,
    "visible": np.bool_,
}


@dataclass(frozen=True)
class Experience:
    """Transitions as a struct of arrays; row i of every array is one step.

    `view`, `next_view`, `person_view`, `next_person_view`: uint8 `[n, V, V]`; `relative_pose`,
    `next_relative_pose`: int16 `[n, 3]`; everything else `[n]`. `source` holds strings of `SOURCES`.
    """

    episode: np.ndarray
    t: np.ndarray
    source: np.ndarray
    map_id: np.ndarray
    view: np.ndarray
    configuration: np.ndarray
    relative_pose: np.ndarray
    waiting: np.ndarray
    lost: np.ndarray
    person_view: np.ndarray
    action: np.ndarray
    person_action: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    outcome: np.ndarray
    distance: np.ndarray
    visible: np.ndarray
    next_view: np.ndarray
    next_configuration: np.ndarray
    next_relative_pose: np.ndarray
    next_person_view: np.ndarray

    def __len__(self) -> int:
        return len(self.action)

    @classmethod
    def load(cls, folder: Path | str, sources: Iterable[str] | None = None) -> Experience:
        """Read every part of `folder`, in the order of the file names.

        Args:
            folder: where the parts lie.
            sources: only rows of these sources (names of `SOURCES`); None for all.

        Raises:
            UserError: no folder, no parts, a damaged part, or an unknown source.
        """
        return cls(**load_columns(folder, COLUMNS, sources))

    def select(self, mask: np.ndarray) -> Experience:
        """The rows that `mask` (bool `[n]` or an index array) picks, in that order."""
        return Experience(**{field.name: getattr(self, field.name)[mask] for field in fields(self)})

    def split_by_map(self, fraction: float, rng: np.random.Generator) -> tuple[Experience, Experience]:
        """Split into experience of some maps and of the others.

        Args:
            fraction: share of the distinct maps that goes to the second part; at least one map stays in the
                first part, and a positive fraction takes at least one where there are two or more.
            rng: draws the maps.

        Returns:
            `(train, held_out)`; no map is in both.

        Raises:
            UserError: `fraction` is outside [0, 1).
        """
        held_out = self.held_out_maps(fraction, rng)
        return self.select(~held_out), self.select(held_out)

    def held_out_maps(self, fraction: float, rng: np.random.Generator) -> np.ndarray:
        """Bool `[n]`: rows of the maps that `split_by_map` would put into its second part."""
        return np.isin(self.map_id, held_out(np.unique(self.map_id), fraction, rng))


def held_out(maps: np.ndarray, fraction: float, rng: np.random.Generator) -> np.ndarray:
    """A share of `maps` (distinct numbers), drawn at random: at least one where there are two or more, never all.

    Raises:
        UserError: `fraction` is outside [0, 1).
    """
    if not 0 <= fraction < 1:
        raise UserError(f"the held-out share of the maps must be in [0, 1), not {fraction}")
    count = min(len(maps) - 1, max(1, round(fraction * len(maps)))) if fraction > 0 else 0
    return rng.permutation(maps)[:count]


COLUMNS = tuple(field.name for field in fields(Experience))


def load_columns(
    folder: Path | str, names: Sequence[str], sources: Iterable[str] | None = None
) -> dict[str, np.ndarray]:
    """Some columns of every part of `folder`, in the order of the file names: a fraction of the time of all.

    Args:
        folder: where the parts lie.
        names: names of `COLUMNS`, or `source_number`, the place in `SOURCES` (int8; cheaper than the names).
        sources: only rows of these sources; None for all.

    Raises:
        UserError: as `Experience.load`.
    """
    folder = Path(folder)
    wanted = None if sources is None else set(sources)
    if wanted is not None and not wanted <= set(SOURCES):
        raise UserError(f"unknown experience source {sorted(wanted - set(SOURCES))}; known: {', '.join(SOURCES)}")
    parts = parts_of(folder)
    loaded = [columns for part in parts if (columns := _read_part(part, wanted, names)) is not None]
    if not loaded:
        raise UserError(f"{folder}: no transitions of the sources {sorted(wanted or ())}")
    return {name: np.concatenate([columns[name] for columns in loaded]) for name in names}


def schema(cells: int) -> pa.Schema:
    """The Parquet schema for views of `cells` cells."""
    types = {"source": pa.dictionary(pa.int8(), pa.string())}
    types |= {name: pa.from_numpy_dtype(dtype) for name, dtype in _SCALARS.items()}
    types |= {name: pa.list_(pa.uint8(), cells) for name in _VIEWS}
    types |= {name: pa.list_(pa.int16(), 3) for name in _POSES}
    return pa.schema([(name, types[name]) for name in COLUMNS])


def write_part(path: Path, columns: Mapping[str, np.ndarray | Sequence[str]]) -> int:
    """Write one part atomically.

    Args:
        path: `part-*.parquet`.
        columns: every name of `COLUMNS`, with the shapes of `Experience`.

    Returns:
        The number of rows.

    Raises:
        UserError: what is written could not be read again: columns missing or too many, of other lengths or shapes, or
            with values that the column's type or range does not hold.
    """
    if set(columns) != set(COLUMNS):
        raise UserError(f"{path}: not written, columns missing or unknown: {sorted(set(columns) ^ set(COLUMNS))}")
    rows, shape = len(columns["action"]), np.shape(columns["view"])[1:]
    if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
        raise UserError(
            f"{path}: not written, views must be square, [n, v, v], found {list(np.shape(columns['view']))}"
        )
    cells = shape[0] * shape[1]
    arrays = []
    for name in COLUMNS:
        wanted = (rows, *(shape if name in _VIEWS else (3,) if name in _POSES else ()))
        values = np.asarray(columns[name])
        if values.shape != wanted:
            raise UserError(
                f"{path}: not written, {name} must have the shape {list(wanted)}, found {list(values.shape)}"
            )
        if name == "source":
            unknown = sorted(set(np.unique(values).tolist()) - set(SOURCES))
            if unknown:
                raise UserError(f"{path}: not written, unknown source {unknown[0]!r} (known: {', '.join(SOURCES)})")
            arrays.append(pa.array(values.astype(object)).dictionary_encode().cast(schema(cells).field(name).type))
            continue
        flat = _exact(path, name, values).reshape(-1)
        width = len(flat) // rows if rows else int(np.prod(wanted[1:]))
        arrays.append(pa.array(flat) if len(wanted) == 1 else pa.FixedSizeListArray.from_arrays(pa.array(flat), width))
    with atomic_path(path) as temporary:
        pq.write_table(pa.Table.from_arrays(arrays, schema=schema(cells)), temporary, compression="zstd")
    return rows


def _exact(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    """A column in the type it is stored in, no value of it changed."""
    kind = np.dtype(np.uint8 if name in _VIEWS else np.int16 if name in _POSES else _SCALARS[name])
    if values.dtype.kind not in "biuf":
        raise UserError(f"{path}: not written, column {name} holds {values.dtype.name} values, no numbers")
    if kind.kind == "f":
        stored, same = values.astype(kind), np.isfinite(values) | (name != "reward")  # a distance may be unknown
    else:
        with np.errstate(invalid="ignore"):
            stored = values.astype(kind)
        same = stored == values
    low, high = _RANGES.get(name, (None, None))
    if low is not None:
        same = same & (values >= low) & (values <= high)
    if not same.all():
        limits = f"{low}..{high}" if low is not None else "numbers that are finite" if kind.kind == "f" else kind.name
        raise UserError(f"{path}: not written, column {name} holds {values[~same][0]}, which is none of {limits}")
    return np.ascontiguousarray(stored)


def count_rows(path: Path) -> int | None:
    """Rows of a part, from its footer; None if the file is missing or not a readable part."""
    try:
        metadata = pq.read_metadata(path)
        names = set(pq.read_schema(path).names)
    except (OSError, pa.ArrowException):
        return None
    return int(metadata.num_rows) if names == set(COLUMNS) else None


# What later steps index with must not lead anywhere else.
_RANGES: dict[str, tuple[int, int]] = {
    **dict.fromkeys(_VIEWS, (0, len(CELL_KINDS) - 1)),
    **dict.fromkeys(("configuration", "next_configuration"), (0, (1 << 15) - 1)),
    "action": (0, MOST_ACTIONS - 1),
    "person_action": (-1, MOST_ACTIONS - 1),
    "outcome": (0, len(OUTCOMES) - 1),
}


def parts_of(folder: Path | str) -> list[Path]:
    """The parts of a folder of experience, in the order of their names.

    Raises:
        UserError: there are none.
    """
    parts = sorted(Path(folder).glob("part-*.parquet"))
    if not parts:
        raise UserError(f"{folder}: no experience here (no part-*.parquet); make it with: nesy collect")
    return parts


def stream(folder: Path | str, columns: Sequence[str], rows: int = 1 << 16) -> Iterator[dict[str, np.ndarray]]:
    """Some columns of every part of `folder`, batch by batch, so that few rows are in memory at a time.

    Args:
        folder: where the parts lie.
        columns: names of `COLUMNS` but `source`.
        rows: most rows in a batch.

    Yields:
        Arrays as in `Experience`.

    Raises:
        UserError: no parts, or a damaged one.
    """
    for path in parts_of(folder):
        try:
            with path.open("rb") as source, pq.ParquetFile(source, memory_map=True) as file:
                side = _checked_side(path, file.schema_arrow)
                for batch in file.iter_batches(batch_size=rows, columns=list(columns)):
                    yield {name: _values(path, name, batch.column(name), side, len(batch)) for name in columns}
        except UserError:
            raise
        except (OSError, ValueError, pa.ArrowException) as error:
            raise _damaged(path, error) from None


def _damaged(path: Path, error: Exception) -> UserError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return UserError(f"{path}: damaged, cannot be read as Parquet ({reason}); delete it, collect again")


def _checked_side(path: Path, found: pa.Schema) -> int:
    """The side of a view, from a part's schema."""
    missing = [name for name in COLUMNS if name not in found.names]
    if missing:
        raise UserError(f"{path}: not a part of experience, columns missing: {', '.join(missing)}")
    cells = getattr(found.field("view").type, "list_size", 0)
    side = round(cells**0.5)
    if side * side != cells or not cells or not _same_types(found, schema(cells)):
        raise UserError(f"{path}: not a part of experience, its columns have other types than expected")
    return side


def _values(path: Path, name: str, column: pa.Array, side: int, count: int) -> np.ndarray:
    """One column but `source` as an array [count, ...]."""
    if name in _VIEWS or name in _POSES:
        values = column.flatten().to_numpy(zero_copy_only=False)
        values = values.reshape(-1, side, side) if name in _VIEWS else values.reshape(-1, 3)
    else:
        values = column.to_numpy(zero_copy_only=False)
    if len(values) != count or values.dtype == object:
        raise UserError(f"{path}: damaged, column {name} has missing values")
    lowest, highest = _RANGES.get(name, (None, None))
    if lowest is not None and len(values) and (values.min() < lowest or values.max() > highest):
        raise UserError(f"{path}: damaged, column {name} holds a value outside {lowest}..{highest}")
    return np.asarray(values)


def _read_part(path: Path, sources: set[str] | None, names: Sequence[str]) -> dict[str, np.ndarray] | None:
    try:
        # Read from an open file: a path would be taken for a data set and its folder names for columns.
        with path.open("rb") as stream:
            file = pq.ParquetFile(stream)
            side = _checked_side(path, file.schema_arrow)
            stored = ["source" if name == "source_number" else name for name in names]
            table = file.read(columns=list(dict.fromkeys([*stored, *(() if sources is None else ("source",))])))
    except (OSError, ValueError, pa.ArrowException) as error:
        raise _damaged(path, error) from None
    source, number = np.zeros(0, dtype="U20"), np.zeros(0, dtype=np.int8)
    if "source" in table.column_names:
        if table["source"].null_count:
            raise UserError(f"{path}: damaged, column source has missing values")
        indexed = table["source"].unify_dictionaries().combine_chunks()
        known, place = np.asarray(indexed.dictionary.to_pylist(), dtype="U20"), indexed.indices.to_numpy()
        number = np.array([SOURCES.index(name) if name in SOURCES else -1 for name in known], dtype=np.int8)[place]
        source = known[place] if "source" in names or sources is not None else source
    keep = None if sources is None else np.isin(source, sorted(sources))
    if keep is not None and not keep.any():
        return None
    columns: dict[str, np.ndarray] = {}
    for name in names:
        if name == "source":
            values = source
        elif name == "source_number":
            values = number
        else:
            values = _values(path, name, table[name].combine_chunks(), side, table.num_rows)
        columns[name] = values if keep is None else values[keep]
    return columns


def _same_types(found: pa.Schema, wanted: pa.Schema) -> bool:
    return all(found.field(field.name).equals(field) for field in wanted)
