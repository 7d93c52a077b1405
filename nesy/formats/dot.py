"""DOT: the graph of the 2DBN without its tables, for Graphviz."""

from __future__ import annotations

from pathlib import Path

from nesy.dbn.graph import to_networkx
from nesy.dbn.model import TwoSliceDBN
from nesy.run_folder import atomic_path


def write(dbn: TwoSliceDBN, path: Path) -> None:
    """Write the graph as DOT: one drawing per action, slice t left, slice t+1 right, width by strength."""
    lines = ["digraph dbn {", "  rankdir=LR; node [shape=circle, fontsize=10];"]
    for a, action in enumerate(dbn.action_names):
        lines += [f"  subgraph {_quoted(f'cluster_{a}')} {{", f"    label={_quoted(action)};"]
        graph = to_networkx(dbn, a)
        lines += [f"    {_quoted(f'{action}/{node}')} [label={_quoted(node)}];" for node in graph]
        for source, target, data in graph.edges(data=True):
            ends = f"{_quoted(f'{action}/{source}')} -> {_quoted(f'{action}/{target}')}"
            strength = data["strength"]
            lines.append(f"    {ends} [penwidth={0.3 + 3 * strength:.2f}, tooltip={_quoted(f'{strength:.3f}')}];")
        lines.append("  }")
    lines.append("}")
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
