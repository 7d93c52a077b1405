"""BIF, the interchange format of Bayesian networks: as jgum, with probabilities to nine digits."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nesy.dbn.model import TwoSliceDBN
from nesy.formats.bayes_nodes import NAMES, nodes
from nesy.names import remarks
from nesy.run_folder import atomic_path


def write(dbn: TwoSliceDBN, path: Path) -> None:
    """Write `dbn` to the file `path`."""
    every = list(nodes(dbn))
    named = [(NAMES.encode(name), name) for name in (*dbn.factor_names, *dbn.action_names)]
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.writelines(f"{line}\n" for line in remarks(named, "//"))
        stream.write("network dbn { }\n")
        for node in every:
            values = ", ".join(map(str, range(node.size)))
            stream.write(f"variable {node.name} {{ type discrete [ {node.size} ] {{ {values} }}; }}\n")
        for node in every:
            if not node.parents:
                stream.write(f"probability ( {node.name} ) {{ table {_numbers(node.tensor)}; }}\n")
                continue
            stream.write(f"probability ( {node.name} | {', '.join(node.parents)} ) {{\n")
            table = node.tensor.reshape(-1, node.size)
            for context, row in zip(np.ndindex(*node.tensor.shape[:-1]), table, strict=True):
                stream.write(f"  ({', '.join(map(str, context))}) {_numbers(row)};\n")
            stream.write("}\n")


def _numbers(row: np.ndarray) -> str:
    return ", ".join(f"{p:.9g}" for p in row.tolist())
