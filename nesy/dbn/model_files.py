"""A 2DBN as the two files model.json and tables.npz (layout: docs/formats.md)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.dbn import storage
from nesy.dbn.rows import distinct_rows, expanded_rows, scattered_counts
from nesy.dbn.step_tables import StepTable
from nesy.errors import UserError

if TYPE_CHECKING:
    from nesy.dbn.model import Parents, TwoSliceDBN

FORMAT = "nesy-2dbn"
VERSION = 1


def save(dbn: TwoSliceDBN, path: Path) -> None:
    """Write `dbn` into the folder `path`."""
    document = {
        "format": FORMAT,
        "version": VERSION,
        "factor_names": list(dbn.factor_names),
        "num_values": dbn.num_values,
        "action_names": list(dbn.action_names),
        "order": list(dbn.order),
        "parents_now": [[list(ps) for ps in per_action] for per_action in dbn.parents_now],
        "parents_next": [[list(ps) for ps in per_action] for per_action in dbn.parents_next],
        "value_meanings": [list(texts) for texts in dbn.value_meanings],
        "provenance": dbn.provenance,
        "step_tables": {name: table.document() for name, table in dbn.step_tables.items()},
    }
    met = np.flatnonzero(dbn.row_counts)
    distinct, index = distinct_rows(dbn.probabilities)
    arrays = {
        "distinct_rows": distinct,
        "row_index": index,
        "met_rows": met,
        "met_counts": dbn.row_counts[met],
        "initial": dbn.initial,
    }
    arrays |= {f"table_{name}": table for name, table in dbn.tables.items()}
    for name, table in dbn.step_tables.items():
        arrays |= {f"step_{name}_{key}": array for key, array in table.arrays().items()}
    storage.save(path, "model", "tables", document, arrays)


def load(path: Path, kind: type[TwoSliceDBN]) -> TwoSliceDBN:
    """Read a `kind` from the folder `path`.

    Raises:
        UserError: a file is missing, damaged, or does not hold a 2DBN.
    """
    if not path.is_dir():
        raise UserError(f"{path}: no such folder (a 2DBN is a folder with model.json and tables.npz)")
    document, arrays = storage.load(path, "model", FORMAT)
    if document.get("version") != VERSION:
        raise UserError(f"{path / 'model.json'}: version {document.get('version')!r}, this program reads {VERSION}")
    try:
        return kind(**_parts(document, arrays))
    except UserError as error:
        raise UserError(f"{path / 'model.json'}: {error}") from None
    except (KeyError, TypeError, ValueError, OverflowError, IndexError, AttributeError) as error:
        raise UserError(f"{path / 'model.json'}: does not describe a 2DBN ({error!r})") from None


def _parts(document: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    return {
        "factor_names": _strings(document["factor_names"]),
        "num_values": int(document["num_values"]),
        "action_names": _strings(document["action_names"]),
        "parents_now": _parents(document["parents_now"]),
        "parents_next": _parents(document["parents_next"]),
        "order": tuple(int(i) for i in document["order"]),
        "probabilities": expanded_rows(arrays["distinct_rows"], arrays["row_index"]),
        "row_counts": scattered_counts(arrays["met_rows"], arrays["met_counts"], len(arrays["row_index"])),
        "initial": arrays["initial"],
        "value_meanings": tuple(_strings(texts) for texts in document["value_meanings"]),
        "provenance": dict(document["provenance"]),
        "tables": {k.removeprefix("table_"): v for k, v in arrays.items() if k.startswith("table_")},
        "step_tables": _step_tables(document, arrays),
    }


def _step_tables(document: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, StepTable]:
    model = len(document["factor_names"]), int(document["num_values"]), len(document["action_names"])
    return {
        str(name): StepTable.restore(
            described, {key: arrays[f"step_{name}_{key}"] for key in ("rows", "index", "met", "counts")}, model
        )
        for name, described in document.get("step_tables", {}).items()
    }


def _strings(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise ValueError("expected a list of texts")
    return tuple(value)


def _parents(value: Any) -> Parents:
    return tuple(tuple(tuple(int(p) for p in ps) for ps in per_action) for per_action in value)
