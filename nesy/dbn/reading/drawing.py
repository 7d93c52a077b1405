"""Pictures of the 2DBN, as PNG or SVG by the file's ending: its graph, and what the values of a factor look like."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.dbn.codebook import Codebook
from nesy.dbn.graph import to_networkx
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from nesy.run_folder import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

COLOURS = ("#f2f0e9", "#4a4e54", "#3c9a5f", "#c9c4b8")
"""Of the cell kinds empty, wall, goal, unseen."""
KINDS = ("empty", "wall", "goal", "unseen")
NOW, NEXT = "#3a6ea5", "#b5651d"
"""Arrows from slice t, and within slice t+1."""


def draw_graph(dbn: TwoSliceDBN, path: Path | str, action: int | None = None) -> None:
    """Draw the graph into a file; see `graph_figure`.

    Raises:
        UserError: no such action, or an ending that is no picture format.
    """
    save_figure(graph_figure(dbn, action), path)


def graph_figure(dbn: TwoSliceDBN, action: int | None = None) -> Figure:
    """The graph, one panel per action: slice t left, slice t+1 right, arrows as wide as they are strong.

    Raises:
        UserError: no such action.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    if action is not None and not 0 <= action < dbn.num_actions:
        raise UserError(f"no action {action}; the actions are {', '.join(dbn.action_names)}")
    chosen = range(dbn.num_actions) if action is None else (action,)
    figure = Figure(figsize=(max(4.6, 3.4 * len(chosen)), 0.55 * dbn.num_factors + 1.6), layout="constrained")
    axes = figure.subplots(1, len(chosen), squeeze=False)[0]
    for a, axis in zip(chosen, axes, strict=True):
        _panel(dbn, a, axis)
    handles = [
        Line2D([], [], color=NOW, linewidth=2, label="parent in slice t"),
        Line2D([], [], color=NEXT, linewidth=2, label="parent in slice t+1"),
        Line2D([], [], color="#4a4e54", linewidth=_width(0.05), label="weak"),
        Line2D([], [], color="#4a4e54", linewidth=_width(1.0), label="strong"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4 if len(chosen) > 1 else 2, fontsize=8)
    return figure


def _width(strength: float) -> float:
    return 0.3 + 2.7 * strength


def _panel(dbn: TwoSliceDBN, action: int, axis: Axes) -> None:
    import networkx

    graph = to_networkx(dbn, action)
    places = {node: (float(data["slice"]), -float(data["factor"])) for node, data in graph.nodes(data=True)}
    networkx.draw_networkx_nodes(graph, places, ax=axis, node_size=420, node_color="#ffffff", edgecolors="#4a4e54")
    networkx.draw_networkx_labels(graph, places, ax=axis, font_size=8)
    for source, target, data in graph.edges(data=True):
        inside = graph.nodes[source]["slice"] == 1
        networkx.draw_networkx_edges(
            graph,
            places,
            ax=axis,
            edgelist=[(source, target)],
            width=_width(data["strength"]),
            edge_color=NEXT if inside else NOW,
            # to the right of slice t+1, where no other arrow runs; up or down, the arc has to bend the same way
            connectionstyle=f"arc3,rad={_bend(places[source][1] - places[target][1])}" if inside else "arc3,rad=0.0",
            node_size=420,
            arrowsize=8,
        )
    axis.set_title(dbn.action_names[action], fontsize=10)
    for where, label in enumerate(("slice t", "slice t+1")):
        axis.text(where, 0.62, label, ha="center", va="center", fontsize=8, color="#4a4e54")
    axis.set_xlim(-0.25, 1.85)
    axis.set_ylim(-dbn.num_factors + 0.5, 0.85)
    axis.axis("off")


def _bend(drop: float) -> float:
    return -0.4 if drop > 0 else 0.4


def draw_factor(
    dbn: TwoSliceDBN, codebook: Codebook, factor: int, path: Path | str, action: int | None = None, most_rows: int = 14
) -> None:
    """Draw what each value of a factor looks like and what it means, and below the rows of its table met most often.

    Each cell of a view is the mean colour of its kinds over the views that have the value; how many they are stands
    below. Rows of a table are darker where the factor's next value is more probable.

    Raises:
        UserError: no such factor or action, or an ending that is no picture format.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    if not 0 <= factor < dbn.num_factors:
        raise UserError(f"no factor {factor}; the factors are 0 to {dbn.num_factors - 1}")
    if action is not None and not 0 <= action < dbn.num_actions:
        raise UserError(f"no action {action}; the actions are {', '.join(dbn.action_names)}")
    actions = range(dbn.num_actions) if action is None else (action,)
    figure = Figure(figsize=(max(1.6 * dbn.num_values, 3.4 * len(actions)), 7.2), layout="constrained")
    halves: Any = figure.subfigures(2, 1, height_ratios=(3.0, 4.2))
    above, below = halves
    for value, axis in enumerate(above.subplots(1, dbn.num_values, squeeze=False)[0]):
        _value(dbn, codebook, factor, value, axis)
    name = dbn.factor_names[factor]
    above.suptitle(f"{name}: the mean of the views that have each value, and what these have in common", fontsize=10)
    kinds = sorted(set(np.unique(codebook.views).tolist()) & set(range(len(KINDS))))
    patches = [Patch(facecolor=COLOURS[k], edgecolor="#4a4e54", label=KINDS[k]) for k in kinds]
    above.legend(handles=patches, loc="upper right", ncols=len(patches), fontsize=7)
    below.suptitle(f"{name}': the rows of its table met most often (values of the parents, and visits)", fontsize=10)
    axes = below.subplots(1, len(actions), squeeze=False)[0]
    for a, axis in zip(actions, axes, strict=True):
        image = _table(dbn, factor, a, axis, most_rows)
    bar = below.colorbar(image, ax=list(axes), fraction=0.02, pad=0.01)
    bar.set_label("probability", fontsize=7)
    bar.ax.tick_params(labelsize=6)
    save_figure(figure, path)


def _value(dbn: TwoSliceDBN, codebook: Codebook, factor: int, value: int, axis: Axes) -> None:
    chosen = codebook.codes[:, factor] == value
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_title(f"{dbn.factor_names[factor]} = {value}", fontsize=9)
    side = codebook.views.shape[1]
    if not chosen.any():
        axis.imshow(np.ones((side, side, 3)))
        axis.set_xlabel("no view has it", fontsize=6)
        return
    # views are indexed [vx, vy]; pictures have the row first
    axis.imshow(mean_view(codebook.views[chosen]).transpose(1, 0, 2))
    axis.plot(side // 2, side - 1, "^", color="#D55E00", markersize=5)
    meaning = dbn.value_meanings[factor][value] if dbn.value_meanings else ""
    lines = [line for part in meaning.split(", ") for line in textwrap.wrap(part, 26)]
    axis.set_xlabel("\n".join([f"{int(chosen.sum())} views", *lines]), fontsize=6)


def _table(dbn: TwoSliceDBN, factor: int, action: int, axis: Axes, most_rows: int) -> AxesImage:
    counts = dbn.counts(action, factor)
    rows = np.argsort(-counts, kind="stable")[:most_rows]
    parents = dbn.parents(action, factor)
    digits = np.stack(np.unravel_index(rows, (dbn.num_values,) * len(parents)), axis=1) if parents else None
    texts = ["" if digits is None else " ".join(map(str, digits[r].tolist())) for r in range(len(rows))]
    image = axis.imshow(dbn.cpt(action, factor)[rows], cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axis.set_xticks(np.arange(0.5, dbn.num_values - 1), minor=True)
    axis.set_yticks(np.arange(0.5, len(rows) - 1), minor=True)
    axis.grid(which="minor", color="#ffffff", linewidth=1)
    axis.tick_params(which="minor", length=0)
    axis.set_yticks(range(len(rows)), [f"{t}  ({counts[r]})" for t, r in zip(texts, rows, strict=True)], fontsize=6)
    axis.set_xticks(range(dbn.num_values))
    axis.tick_params(axis="x", labelsize=6)
    names = " ".join(dbn.factor_names[p] + ("'" if where else "") for where, p in parents) or "no parents"
    axis.set_title(f"{dbn.action_names[action]}: {names}", fontsize=8)
    axis.set_xlabel(f"next {dbn.factor_names[factor]}", fontsize=7)
    return image


def mean_view(views: np.ndarray) -> np.ndarray:
    """Mean colours float64 [v, v, 3] of some views uint8 [n, v, v]."""
    palette = np.array([[int(c[j : j + 2], 16) for j in (1, 3, 5)] for c in COLOURS]) / 255.0
    return np.asarray(palette[views].mean(axis=0))


def save_figure(figure: Figure, path: Path | str) -> None:
    """Write a figure as .png or .svg.

    Raises:
        UserError: another ending.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    if kind not in ("png", "svg"):
        raise UserError(f"{path}: pictures are written as .png or .svg")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=kind, dpi=150)
