"""The fidelity report as one picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from nesy.dbn.reading.drawing import save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#7a7f87"


def draw_fidelity(report: dict[str, Any], path: Path | str) -> None:
    """Draw `summary["dbn"]["fidelity"]` into a file, .png or .svg.

    Raises:
        UserError: an ending that is no picture format.
    """
    save_figure(fidelity_figure(report), path)


def fidelity_figure(report: dict[str, Any]) -> Figure:
    """Four panels: likelihood of new steps, rollouts, plans, impossible steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 6.2), layout="constrained")
    panels = figure.subplots(2, 2)
    _likelihood(panels[0, 0], report["held_out"])
    _rollouts(panels[0, 1], report["rollouts"])
    _plans(panels[1, 0], report["plans"])
    _impossible(panels[1, 1], report["impossible"])
    return figure


def _bars(axis: Axes, names: list[str], values: list[float], colours: list[str], form: str) -> None:
    axis.barh(range(len(names)), values, color=colours, height=0.6)
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    top = max([*values, 1e-9])
    axis.set_xlim(0, 1.22 * top)
    for row, value in enumerate(values):
        axis.text(value + 0.02 * top, row, form.format(value), va="center", fontsize=9)
    axis.spines[["top", "right"]].set_visible(False)


def _likelihood(axis: Axes, held_out: dict[str, Any]) -> None:
    names = ["table", "network", "limit"]
    _bars(axis, names, [held_out[name] for name in names], [BLUE, ORANGE, GREY], "{:.3f}")
    axis.set_title("New episodes: negative log-likelihood", fontsize=10)
    axis.set_xlabel("nats per step; no model of the next view can be below the limit", fontsize=8)


def _rollouts(axis: Axes, rollouts: dict[str, Any]) -> None:
    for name, colour in (("joint", ORANGE), ("marginal", BLUE)):
        low, high = rollouts[f"{name}_low"], rollouts[f"{name}_high"]
        label = "whole codes" if name == "joint" else "single factors (mean)"
        axis.fill_between(rollouts["steps"], low, high, color=colour, alpha=0.25, linewidth=0)
        axis.plot(rollouts["steps"], low, "o-", color=colour, markersize=3.5, label=label)
    axis.set_ylim(-0.02, 1.02)
    axis.set_title("Rollouts of marginals against exact ones", fontsize=10)
    axis.set_xlabel("steps; band: what the cut branches leave open", fontsize=8)
    axis.set_ylabel("total variation")
    axis.legend(fontsize=8, frameon=False, loc="lower right")
    axis.spines[["top", "right"]].set_visible(False)


def _plans(axis: Axes, plans: dict[str, Any]) -> None:
    names, values, colours = [], [], []
    for planner, label, colour in (("model", "model", BLUE), ("commonest", "commonest next view", GREY)):
        figures = plans.get(planner)
        if figures is None:
            continue
        names += [f"{label}: found", f"{label}: then valid", f"{label}: exhausted"]
        values += [figures["found"], figures["valid"], figures["exhausted"]]
        colours += [colour] * 3
    _bars(axis, names, values, colours, "{:.0%}")
    axis.set_title(f"Plans for {plans['asked']} pairs of views, executed", fontsize=10)


def _impossible(axis: Axes, impossible: dict[str, Any]) -> None:
    if not impossible:
        axis.axis("off")
        axis.text(0.5, 0.5, "the maps are too many to be listed", ha="center", va="center", fontsize=9)
        return
    names = {"states": "next state of no map", "transitions": "step of no map", "likeliest": "likeliest step of no map"}
    values = [impossible[name] for name in names]
    _bars(axis, list(names.values()), values, [GREEN] * len(names), "{:.2%}")
    axis.set_title("Impossible steps", fontsize=10)
