"""The answer to a ready question: in words, as data, and what supports it, as a graph."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nesy.errors import UserError
from nesy.names import TEXT
from nesy.run_folder import atomic_path, write_json

if TYPE_CHECKING:
    import networkx

Edge = tuple[str, str, str]
"""(what supports, what is supported, how)."""

MOST_EDGES = 60
"""A picture shows so many edges; data formats hold all."""


@dataclass(frozen=True)
class Finding:
    """The answer to a ready question."""

    question: str
    """The question in words."""
    text: str
    """The answer in words, for people."""
    rows: tuple[dict[str, Any], ...]
    """The answer as data."""
    seconds: float
    """Wall time."""
    support: tuple[Edge, ...] = ()
    """The rules and rows behind the answer: edges (what supports, what is supported, how)."""

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {**asdict(self), "rows": list(self.rows), "support": [list(edge) for edge in self.support]}

    def graph(self) -> networkx.DiGraph:
        """What supports the answer; edges have a `label`."""
        return graph_of(self.support)


def finding(
    question: str, text: str, rows: Sequence[dict[str, Any]], started: float, support: Sequence[Edge] = ()
) -> Finding:
    """A finding, timed from `started` (time.perf_counter)."""
    return Finding(question, text, tuple(rows), round(time.perf_counter() - started, 4), tuple(support))


def graph_of(edges: Sequence[Edge]) -> networkx.DiGraph:
    """A graph with labelled edges."""
    import networkx

    graph = networkx.DiGraph()
    for source, target, label in edges:
        graph.add_edge(source, target, label=label)
    return graph


def save_graph(edges: Sequence[Edge], path: Path) -> None:
    """Write a graph: a picture (.svg, .png, .pdf), or data (.dot, .graphml, .json).

    Raises:
        UserError: there is nothing to draw, or the ending is none of these.
    """
    if not edges:
        raise UserError(f"{path}: this answer has no graph: nothing in the model supports it")
    ending = path.suffix.lower()
    if ending in (".svg", ".png", ".pdf"):
        with atomic_path(path) as temporary:
            _figure(edges[:MOST_EDGES]).savefig(temporary)
    elif ending == ".json":
        write_json(path, {"edges": [{"from": a, "to": b, "label": label} for a, b, label in edges]})
    elif ending == ".graphml":
        import networkx

        with atomic_path(path) as temporary:
            plain = [(TEXT.encode(a), TEXT.encode(b), label and TEXT.encode(label)) for a, b, label in edges]
            networkx.write_graphml(graph_of(plain), temporary)
    elif ending == ".dot":
        lines = [f"  {_quoted(a)} -> {_quoted(b)} [label={_quoted(label)}];" for a, b, label in edges]
        with atomic_path(path) as temporary:
            temporary.write_text("\n".join(["digraph {", "  rankdir=LR;", *lines, "}", ""]), encoding="utf-8")
    else:
        raise UserError(f"{path}: a graph is written as .svg, .png, .pdf, .dot, .graphml or .json")


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n") + '"'


def _figure(edges: Sequence[Edge]) -> Any:
    """The graph in layers, what supports to the left of what it supports."""
    import networkx
    from matplotlib.figure import Figure

    graph = graph_of(edges)
    layers = _layers(graph)
    places: dict[str, tuple[float, float]] = {}
    for layer in sorted(set(layers.values())):
        # beside those that they support or are supported by, as far as these have places already
        def wish(node: str) -> float:
            near = [places[n][1] for n in (*graph.predecessors(node), *graph.successors(node)) if n in places]
            return sum(near) / len(near) if near else 0.0

        nodes = sorted((n for n in graph if layers[n] == layer), key=lambda n: (-wish(n), n))
        for position, node in enumerate(nodes):
            places[node] = (float(layer), (len(nodes) - 1) / 2 - position)
    height = max(list(layers.values()).count(layer) for layer in layers.values())
    figure = Figure(figsize=(2.5 + 3.0 * len(set(layers.values())), 1.0 + 0.42 * height), layout="constrained")
    axis = figure.subplots()
    networkx.draw_networkx_edges(graph, places, ax=axis, edge_color="#3a6ea5", arrowsize=9, node_size=900)
    box = {"boxstyle": "round,pad=0.3", "facecolor": "#ffffff", "edgecolor": "#4a4e54"}
    for node, (x, y) in places.items():
        axis.text(x, y, node, ha="center", va="center", fontsize=8, bbox=box)
    for a, b, label in edges:
        if label:
            x, y = ((one + other) / 2 for one, other in zip(places[a], places[b], strict=True))
            axis.text(x, y, label, ha="center", va="center", fontsize=6.5, color="#3a6ea5")
    axis.margins(0.2)
    axis.axis("off")
    return figure


def _layers(graph: networkx.DiGraph) -> dict[str, int]:
    """Each node one layer behind the last of those that support it; in a circle, in the order of appearance."""
    layers: dict[str, int] = dict.fromkeys(graph, 0)
    for _ in range(min(len(graph), 20)):
        before = dict(layers)
        for a, b in graph.edges:
            layers[b] = min(max(layers[b], layers[a] + 1), len(graph))
        if layers == before:
            break
    used = sorted(set(layers.values()))
    return {node: used.index(layer) for node, layer in layers.items()}
