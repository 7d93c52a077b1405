"""Figures of the comparison, from plain data: for the report as SVG, for papers as PNG and SVG files.

Every figure says how many seeds and episodes are in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nesy.report.figures import PALETTE
from nesy.run_folder import atomic_path

Curve = dict[str, Any]
"""`name`, `seeds`, `episodes`, `window`, `episode` [P], and `policy` and `running_average`: mean, low, high [P]."""


def save_figures(folder: Path, records: Sequence[dict[str, Any]], statistics: dict[str, Any]) -> None:
    """Write every figure of a comparison as PNG and SVG."""
    figures = {"returns": returns(records), "profiles": profiles(statistics["profiles"])}
    if statistics["improvement"]:
        figures["improvement"] = improvement(statistics["improvement"])
    optimum = next((record["return"]["mean"] for record in records if record["agent"] == "optimum"), None)
    if statistics["curves"]:
        figures["learning"] = learning(statistics["curves"], optimum)
    for name, figure in figures.items():
        save(figure, folder / name)


def save(figure: Figure, path: Path) -> None:
    """Write one figure as `path`.png and `path`.svg."""
    for kind in ("png", "svg"):
        with atomic_path(path.with_name(f"{path.name}.{kind}")) as temporary:
            metadata = {"Date": None} if kind == "svg" else {"Software": None}
            figure.savefig(temporary, format=kind, dpi=150, bbox_inches="tight", metadata=metadata)


def returns(records: Sequence[dict[str, Any]]) -> Figure:
    """Mean return (circle) and interquartile mean (diamond) of every condition; exact optima as dotted lines."""
    figure, axes = _axes(8, 0.42 * len(records) + 1.0)
    agents = list(dict.fromkeys(record["agent"] for record in records))
    for row, record in enumerate(records):
        colour = PALETTE[agents.index(record["agent"]) % len(PALETTE)]
        for shift, mark, interval in ((-0.12, "o", record["return"]), (0.12, "D", record["interquartile_mean"])):
            if interval.get("low") is not None:
                axes.plot([interval["low"], interval["high"]], [row + shift] * 2, color=colour, linewidth=1.5)
            axes.plot(interval["mean"], row + shift, mark, color=colour, markersize=4)
        if record["agent"] == "optimum":
            axes.axvline(record["return"]["mean"], color="#000000", linestyle=":", linewidth=1)
    labels = [f"{_name(record)}  ({_counted(len(record['seeds']), record['episodes'])})" for record in records]
    axes.set_yticks(range(len(records)), labels, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("return: mean (circle), interquartile mean (diamond), 95 % intervals; dotted: exact optimum")
    return figure


def profiles(statistics: dict[str, Any]) -> Figure:
    """Share of the episodes with a return above each threshold."""
    figure, axes = _axes(8, 4)
    for position, (name, shares) in enumerate(statistics["shares"].items()):
        label = f"{name} ({_counted(statistics['seeds'][name], statistics['episodes'][name])})"
        style = ("-", "--", ":")[position // len(PALETTE) % 3]
        axes.plot(statistics["thresholds"], shares, style, color=PALETTE[position % len(PALETTE)], label=label)
    axes.set_xlabel("return")
    axes.set_ylabel("share of episodes above")
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def improvement(pairs: Sequence[dict[str, Any]]) -> Figure:
    """Probability that an episode of the row's agent beats one of the column's."""
    ours = list(dict.fromkeys(pair["ours"] for pair in pairs))
    figure, axes = _axes(0.55 * len(ours) + 2.5, 0.45 * len(ours) + 1.5)
    table = np.full((len(ours), len(ours)), np.nan)
    for pair in pairs:
        table[ours.index(pair["ours"]), ours.index(pair["theirs"])] = pair["mean"]
    axes.imshow(np.ma.masked_invalid(table), cmap="RdBu", vmin=0, vmax=1)
    for row, column in np.argwhere(~np.isnan(table)):
        axes.text(column, row, f"{table[row, column]:.2f}", ha="center", va="center", fontsize=6)
    axes.set_xticks(range(len(ours)), ours, rotation=90, fontsize=7)
    axes.set_yticks(range(len(ours)), ours, fontsize=7)
    axes.grid(visible=False)
    axes.set_title("P(an episode of the row beats one of the column)", fontsize=9)
    return figure


def learning(curves: Sequence[Curve], optimum: float | None = None, notes: Sequence[str] = ()) -> Figure:
    """Learning curves with bands: the policy's (left) and the running average over all episodes (right).

    Args:
        curves: one per condition.
        optimum: the exact optimum, drawn as a dotted line.
        notes: lines of text under the figure.
    """
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    panels = figure.subplots(1, 2)
    titles = (
        ("policy", f"policy: mean of the last {curves[0]['window']} training episodes"),
        ("running_average", "running average over all training episodes so far"),
    )
    for axes, (which, title) in zip(panels, titles, strict=True):
        for position, curve in enumerate(curves):
            colour = PALETTE[position % len(PALETTE)]
            label = f"{curve['name']} ({_counted(curve['seeds'], curve['episodes'])})"
            band = curve[which]
            axes.plot(curve["episode"], band["mean"], color=colour, label=label)
            if curve["seeds"] > 1:
                axes.fill_between(curve["episode"], band["low"], band["high"], color=colour, alpha=0.2, linewidth=0)
        if optimum is not None:
            axes.axhline(optimum, color="#000000", linestyle=":", linewidth=1, label="exact optimum")
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("training episode")
        axes.set_ylabel("return")
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=7, loc="upper left")
    if notes:
        figure.supxlabel("\n".join(notes), fontsize=7)
    return figure


def _axes(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height))
    axes = figure.subplots()
    axes.grid(alpha=0.3)
    return figure, axes


def _name(record: dict[str, Any]) -> str:
    parts = (record["agent"], record.get("inputs"), record.get("influence"), record.get("variant"))
    return " / ".join(part for part in parts if part)


def _counted(seeds: int, episodes: int) -> str:
    return f"{seeds} seed{'s' if seeds != 1 else ''}, {episodes} episodes"
