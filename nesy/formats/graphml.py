"""GraphML: the graph of the 2DBN without its tables, for Gephi, yEd and networkx."""

from __future__ import annotations

from pathlib import Path

import networkx

from nesy.dbn.graph import to_networkx
from nesy.dbn.model import TwoSliceDBN
from nesy.names import SLICED
from nesy.run_folder import atomic_path

NAMES = SLICED
"""Nodes."""


def write(dbn: TwoSliceDBN, path: Path) -> None:
    """Write the graph as GraphML; edges carry `action` and `strength`."""
    with atomic_path(path) as temporary:
        networkx.write_graphml(to_networkx(dbn), temporary)
