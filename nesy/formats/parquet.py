"""Parquet: one row per action, factor, parents' values and value, with probability and count; bit-equal.

Columns: `action`, `factor` (names), `parents` (list of names; a stroke marks slice t+1), `parent_values` (list),
`value`, `probability`, `count`. What the columns do not hold is JSON in the file's metadata (`nesy-2dbn`), with a
SHA-256 of the model beside it, so that no damage passes as another model.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.step_tables import StepTable
from nesy.errors import UserError
from nesy.formats.long_table import Part, parts
from nesy.names import SLICED
from nesy.run_folder import atomic_path, parse_json

NAMES = SLICED
"""Names in the column `parents`."""
KEY, SUM = b"nesy-2dbn", b"nesy-2dbn-sha256"
_DAMAGE = (pa.ArrowException, OSError, ValueError, KeyError, TypeError, RecursionError, IndexError, AttributeError)
_TEXTS = ("factor_names", "action_names", "num_values", "order", "parents_now", "parents_next", "value_meanings")


def write(dbn: TwoSliceDBN, path: Path) -> None:
    """Write `dbn` to the file `path`."""
    document: dict[str, Any] = {name: getattr(dbn, name) for name in _TEXTS}
    document |= {"provenance": dbn.provenance, "initial": dbn.initial.tolist()}
    document["tables"] = {
        name: {"dtype": table.dtype.str, "values": table.tolist()} for name, table in dbn.tables.items()
    }
    document["step_tables"] = {name: table.plain() for name, table in dbn.step_tables.items()}
    text = json.dumps(document).encode()
    schema = _schema(dbn).with_metadata({KEY: text, SUM: digest(text, dbn.probabilities, dbn.row_counts).encode()})
    with atomic_path(path) as temporary, pq.ParquetWriter(temporary, schema, compression="zstd") as writer:
        for part in parts(dbn):
            writer.write_table(_table(dbn, part, schema))


def digest(text: bytes, probabilities: np.ndarray, counts: np.ndarray) -> str:
    """SHA-256 of a model: the JSON beside its rows, their probabilities and counts."""
    sha = hashlib.sha256(text)
    for array in (probabilities, counts):
        sha.update(np.ascontiguousarray(array).view(np.uint8).reshape(-1).data)
    return sha.hexdigest()


def _schema(dbn: TwoSliceDBN) -> pa.Schema:
    name = pa.dictionary(pa.int16(), pa.string())
    return pa.schema(
        [
            ("action", name),
            ("factor", name),
            ("parents", pa.list_(pa.string())),
            ("parent_values", pa.list_(pa.from_numpy_dtype(dbn.code_type))),
            ("value", pa.from_numpy_dtype(dbn.code_type)),
            ("probability", pa.float64()),
            ("count", pa.int64()),
        ]
    )


def _table(dbn: TwoSliceDBN, part: Part, schema: pa.Schema) -> pa.Table:
    rows, k = part.probabilities.shape
    entries, arity = rows * k, len(part.parents)
    offsets = pa.array(np.arange(entries + 1, dtype=np.int32) * arity)
    names = pa.array(list(part.parents) or [""]).dictionary_encode()
    parent_names = names.dictionary.take(pa.array(np.tile(np.arange(arity), entries)))
    values = pa.array(np.repeat(part.parent_values, k, axis=0).reshape(-1))
    return pa.Table.from_arrays(
        [
            _constant(part.action, dbn.action_names, entries),
            _constant(part.factor, dbn.factor_names, entries),
            pa.ListArray.from_arrays(offsets, parent_names),
            pa.ListArray.from_arrays(offsets, values),
            pa.array(np.tile(np.arange(k, dtype=dbn.code_type), rows)),
            pa.array(part.probabilities.reshape(-1)),
            pa.array(np.repeat(part.counts, k)),
        ],
        schema=schema,
    )


def _constant(index: int, names: tuple[str, ...], length: int) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(np.full(length, index, dtype=np.int16)), pa.array(names))


def read(path: Path) -> TwoSliceDBN:
    """Read the file `path`.

    Raises:
        UserError: it is damaged or holds no 2DBN.
    """
    try:
        table = pq.read_table(path, columns=["action", "factor", "value", "probability", "count"])
        metadata = table.schema.metadata or {}
        if KEY not in metadata:
            raise UserError(f"{path}: a Parquet file, but not of a 2DBN (metadata '{KEY.decode()}' is missing)")
        document = parse_json(metadata[KEY])
        dbn = _build(document, table)
        if digest(metadata[KEY], dbn.probabilities, dbn.row_counts).encode() != metadata.get(SUM):
            raise UserError(f"{path}: damaged (its checksum does not match its content); export the model again")
        _check_keys(dbn, table, path)
    except UserError as error:
        raise UserError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: not a readable Parquet file of a 2DBN ({reason})") from None
    return dbn


def _build(document: dict[str, Any], table: pa.Table) -> TwoSliceDBN:
    k = int(document["num_values"])
    probabilities = table["probability"].to_numpy()
    if k < 1 or len(probabilities) % k:
        raise UserError(f"{len(probabilities)} rows do not fit {k} values")
    known = {f.name for f in fields(TwoSliceDBN)}
    plain = {name: _tuples(document[name]) for name in _TEXTS if name in known and name != "num_values"}
    return TwoSliceDBN(
        **plain,
        num_values=k,
        probabilities=probabilities.reshape(-1, k),
        row_counts=table["count"].to_numpy().reshape(-1, k)[:, 0],
        initial=np.array(document["initial"], dtype=np.float64),
        provenance=dict(document["provenance"]),
        tables={
            str(name): np.array(entry["values"], dtype=np.dtype(str(entry["dtype"])))
            for name, entry in document["tables"].items()
        },
        step_tables={
            str(name): StepTable.from_plain(value, (len(document["factor_names"]), k, len(document["action_names"])))
            for name, value in document["step_tables"].items()
        },
    )


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def _check_keys(dbn: TwoSliceDBN, table: pa.Table, path: Path) -> None:
    """Whether the rows are in the order written: another order would silently be another model."""
    actions, factors = table["action"].combine_chunks(), table["factor"].combine_chunks()
    sizes = np.array([[dbn.num_rows(a, i) for i in range(dbn.num_factors)] for a in range(dbn.num_actions)])
    entries = sizes.reshape(-1) * dbn.num_values
    wanted_actions = np.repeat(np.repeat(dbn.action_names, dbn.num_factors), entries)
    wanted_factors = np.repeat(np.tile(dbn.factor_names, dbn.num_actions), entries)
    values = np.tile(np.arange(dbn.num_values), len(dbn.probabilities))
    same = (
        np.array_equal(table["value"].to_numpy(), values)
        and np.array_equal(np.asarray(actions).astype(str), wanted_actions)
        and np.array_equal(np.asarray(factors).astype(str), wanted_factors)
    )
    if not same:
        raise UserError(f"{path}: its rows are not in the order of the model; export it again")
