"""DOT: the graph of the 2DBN without its tables, for Graphviz."""

from __future__ import annotations

from pathlib import Path

from nesy.dbn.graph import to_networkx
from nesy.dbn.model import TwoSliceDBN
from nesy.names import SLICED, TEXT
from nesy.run_folder import atomic_path

NAMES = SLICED
"""Labels of nodes, in which `&` is `&amp;`."""


def write(dbn: TwoSliceDBN, path: Path) -> None:
    """Write the graph as DOT: one drawing per action, slice t left, slice t+1 right, width by strength."""
    lines = ["digraph dbn {", "  rankdir=LR; node [shape=circle, fontsize=10];"]
    for a, action in enumerate(dbn.action_names):
        lines += [f"  subgraph {_quoted(f'cluster_{a}')} {{", f"    label={_label(TEXT.encode(action))};"]
        graph = to_networkx(dbn, a)
        lines += [f"    {_quoted(f'{a}/{node}')} [label={_label(node)}];" for node in graph]
        for source, target, data in graph.edges(data=True):
            ends = f"{_quoted(f'{a}/{source}')} -> {_quoted(f'{a}/{target}')}"
            strength = data["strength"]
            lines.append(f"    {ends} [penwidth={0.3 + 3 * strength:.2f}, tooltip={_quoted(f'{strength:.3f}')}];")
        lines.append("  }")
    lines.append("}")
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _label(text: str) -> str:
    """A label that shows the text: Graphviz reads `&lt;` and the like in labels as single characters."""
    return _quoted(text.replace("&", "&amp;"))
