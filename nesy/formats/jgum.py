"""jgum, pyAgrum's JSON format: one Bayesian network with a copy of slice t+1 per action; bit-equal when read back.

Written and read here without pyAgrum, which the core does not need. The last property is the SHA-256 of everything
before it, so that any damaged byte is found.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.step_tables import StepTable
from nesy.errors import UserError
from nesy.formats import bayes_nodes
from nesy.formats.bayes_nodes import node_names, nodes
from nesy.run_folder import atomic_path, parse_json, read_json

NAMES = bayes_nodes.NAMES
PROPERTY = "nesy-2dbn"
SEAL, END = ', "sha256": "', '"}}\n'
MOST_VALUES = 10_000


def write(dbn: TwoSliceDBN, path: Path) -> None:
    """Write `dbn` to the file `path`."""
    names: list[str] = []
    parents: dict[str, list[str]] = {}
    tables: dict[str, str] = {}
    for node in nodes(dbn):
        names.append(f"{node.name}[{node.size}]")
        parents[node.name] = list(node.parents)
        # pyAgrum's order: the node's own value runs fastest, then its first parent, ...
        axes = (*range(len(node.parents) - 1, -1, -1), len(node.parents))
        tables[node.name] = json.dumps(node.tensor.transpose(axes).reshape(-1).tolist())
    met = np.flatnonzero(dbn.row_counts)
    document = {
        "factor_names": dbn.factor_names,
        "action_names": dbn.action_names,
        "num_values": dbn.num_values,
        "order": dbn.order,
        "parents_now": dbn.parents_now,
        "parents_next": dbn.parents_next,
        "value_meanings": dbn.value_meanings,
        "provenance": dbn.provenance,
        "met": [met.tolist(), dbn.row_counts[met].tolist()],
        "tables": {name: {"dtype": t.dtype.str, "values": t.tolist()} for name, t in dbn.tables.items()},
        "step_tables": {name: table.plain() for name, table in dbn.step_tables.items()},
    }
    properties = {"name": "2DBN", "software": "nesy", PROPERTY: json.dumps(document)}
    head = {"type": "BN", "GumJsonVersion": "1.0", "nodes": names, "parents": parents}
    digest = hashlib.sha256()
    with atomic_path(path) as temporary, temporary.open("wb") as stream:

        def put(text: str) -> None:
            content = text.encode("utf-8")
            digest.update(content)
            stream.write(content)

        put(json.dumps(head)[:-1] + ', "cpt": {')
        for position, (name, table) in enumerate(tables.items()):
            put(f"{', ' if position else ''}{json.dumps(name)}: {table}")
        put('}, "properties": ' + json.dumps(properties)[:-1] + SEAL)
        stream.write((digest.hexdigest() + END).encode())


def read(path: Path) -> TwoSliceDBN:
    """Read the file `path`, as `write` made it.

    Raises:
        UserError: it is damaged or holds another network.
    """
    content = read_json(path)
    try:
        document = parse_json(content["properties"][PROPERTY])
    except (KeyError, TypeError, ValueError, RecursionError):
        raise UserError(f"{path}: not a jgum file of a 2DBN (its property '{PROPERTY}' is missing)") from None
    _check_seal(path)
    try:
        return _build(document, content)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError) as error:
        raise UserError(f"{path}: not a readable jgum file of a 2DBN ({error!r})") from None


def _check_seal(path: Path) -> None:
    content = path.read_bytes()
    if sealed(content) != content:
        raise UserError(f"{path}: damaged (its checksum does not match its content); export the model again")


def sealed(content: bytes) -> bytes:
    """The file's bytes with the checksum that belongs to what is before it."""
    head = content[: content.rfind(SEAL.encode()) + len(SEAL)]
    return head + (hashlib.sha256(head).hexdigest() + END).encode()


def _build(document: dict[str, Any], content: dict[str, Any]) -> TwoSliceDBN:
    # an empty shell first: it checks the structure before any table is looked for
    k = int(document["num_values"])
    if not 1 <= k <= MOST_VALUES:
        raise UserError(f"{k} values per factor; 1 to {MOST_VALUES} can be read")
    now, later = _tuples(document["parents_now"]), _tuples(document["parents_next"])
    factors, actions = _tuples(document["factor_names"]), _tuples(document["action_names"])
    tables: list[list[np.ndarray]] = []
    shell = TwoSliceDBN.from_tables(
        [[np.full((1, k), 1.0 / k)] * len(factors)] * len(actions),
        [[()] * len(factors)] * len(actions),
        factor_names=factors,
        action_names=actions,
    )
    names_now, names_later = node_names(shell)
    for a, names in enumerate(names_later):
        tables.append([])
        for i, name in enumerate(names):
            arity = len(now[a][i]) + len(later[a][i])
            own = [(names_now, names)[where][p] for where, p in _pairs(now[a][i], later[a][i])]
            if content["parents"][name] != own:
                raise UserError(f"the parents of {name} are not those of the 2DBN")
            flat = np.array(content["cpt"][name], dtype=np.float64).reshape((k,) * (arity + 1))
            axes = (*range(arity - 1, -1, -1), arity)
            tables[-1].append(flat.transpose(axes).reshape(-1, k))
    met_rows, met_counts = (np.array(column, dtype=np.int64) for column in document["met"])
    counts = np.zeros(sum(len(t) for ts in tables for t in ts), dtype=np.int64)
    counts[met_rows] = met_counts
    return TwoSliceDBN(
        factor_names=factors,
        num_values=k,
        action_names=actions,
        parents_now=now,
        parents_next=later,
        order=_tuples(document["order"]),
        probabilities=np.concatenate([t for ts in tables for t in ts]),
        row_counts=counts,
        initial=np.array([content["cpt"][name] for name in names_now], dtype=np.float64),
        value_meanings=_tuples(document["value_meanings"]),
        provenance=dict(document["provenance"]),
        tables={
            str(name): np.array(entry["values"], dtype=np.dtype(str(entry["dtype"])))
            for name, entry in document["tables"].items()
        },
        step_tables={
            str(name): StepTable.from_plain(value, (len(factors), k, len(actions)))
            for name, value in document["step_tables"].items()
        },
    )


def _pairs(now: tuple[int, ...], later: tuple[int, ...]) -> list[tuple[int, int]]:
    return [(0, p) for p in now] + [(1, p) for p in later]


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
