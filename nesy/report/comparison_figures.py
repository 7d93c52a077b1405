"""Figures of the comparison, from plain data: for the report as SVG, for papers as PNG and SVG files.

Every figure says how many seeds and episodes are in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nesy.report.figures import PALETTE
from nesy.report.text import shown
from nesy.run_folder import atomic_path

MORE = ("#7F5539", "#8A8A8A", "#6A4C93")
"""Colours beyond the palette's, for comparisons of many agents."""
Curve = dict[str, Any]
"""`name`, `variant`, `seeds`, `episodes`, `window`, `episode` [P]; `policy`, `running_average`: mean, low, high [P]."""


def save_figures(folder: Path, records: Sequence[dict[str, Any]], statistics: dict[str, Any]) -> None:
    """Write every figure of a comparison as PNG and SVG."""
    figures = {"returns": returns(records), "profiles": profiles(statistics["profiles"])}
    if statistics["improvement"]:
        figures["improvement"] = improvement(statistics)
    if statistics["curves"]:
        figures["learning"] = learning(statistics["curves"], exact_optima(records))
    for name, figure in figures.items():
        save(figure, folder / name)


def exact_optima(records: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Mean return of the exact optimum over all worlds by variant, where it is among the agents compared."""
    return {
        record["variant"]: record["exact"]["return"] if "exact" in record else record["return"]["mean"]
        for record in records
        if record["agent"] == "optimum"
    }


def save(figure: Figure, path: Path) -> None:
    """Write one figure as `path`.png and `path`.svg."""
    for kind in ("png", "svg"):
        with atomic_path(path.with_name(f"{path.name}.{kind}")) as temporary:
            metadata = {"Date": None} if kind == "svg" else {"Software": None}
            figure.savefig(temporary, format=kind, dpi=150, bbox_inches="tight", metadata=metadata)


def returns(records: Sequence[dict[str, Any]]) -> Figure:
    """Mean return (circle) and interquartile mean (diamond) of every condition; optima as dotted lines."""
    records = [shown(record) for record in records]
    figure, axes = _axes(8, 0.34 * len(records) + 1.0)
    colours = _colours([record["agent"] for record in records])
    for row, record in enumerate(records):
        colour = colours[record["agent"]]
        for shift, mark, interval in ((-0.12, "o", record["return"]), (0.12, "D", record["interquartile_mean"])):
            if interval.get("low") is not None:
                axes.plot([interval["low"], interval["high"]], [row + shift] * 2, color=colour, linewidth=1.5)
            axes.plot(interval["mean"], row + shift, mark, color=colour, markersize=4)
    optima = {record["variant"]: record["return"]["mean"] for record in records if record["agent"] == "optimum"}
    for variant, optimum in optima.items():
        rows = [row for row, record in enumerate(records) if record["variant"] == variant]
        axes.plot([optimum] * 2, [min(rows) - 0.5, max(rows) + 0.5], color="#000000", linestyle=":", linewidth=1)
    labels = [f"{_name(record)}  ({_counted(len(record['seeds']), record['episodes'])})" for record in records]
    axes.set_yticks(range(len(records)), labels, fontsize=8)
    axes.set_ylim(len(records) - 0.4, -0.6)
    axes.set_xlabel("return: mean (circle), interquartile mean (diamond), 95 % intervals;\ndotted: optimum")
    return figure


def profiles(statistics: dict[str, Any]) -> Figure:
    """Share of episodes with a return above each threshold: a panel per variant, colours by agent, dashes by mode."""
    names = [name.split(" / ") for name in statistics["shares"]]
    variants = list(dict.fromkeys(name[-1] for name in names))
    colours = _colours([name[0] for name in names])
    inside = [tuple(name[1:-1]) for name in names]
    dashes = dict(zip(dict.fromkeys(inside), cycle(("-", "--", ":", "-.")), strict=False))
    figure = Figure(figsize=(9, 3.2 * len(variants)), layout="constrained")
    panels = figure.subplots(len(variants), 1, squeeze=False)[:, 0]
    for axes, variant in zip(panels, variants, strict=True):
        entries = statistics["shares"].items()
        for (name, shares), parts, condition in zip(entries, names, inside, strict=True):
            if parts[-1] == variant:
                label = (
                    f"{' / '.join(parts[:-1])} ({_counted(statistics['seeds'][name], statistics['episodes'][name])})"
                )
                axes.plot(
                    *(statistics["thresholds"], shares, dashes[condition]),
                    color=colours[parts[0]],
                    label=label,
                    linewidth=1.2,
                )
        axes.set_title(variant, fontsize=9)
        axes.set_xlabel("return")
        axes.set_ylabel("share of episodes above")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def improvement(statistics: dict[str, Any]) -> Figure:
    """Probability that an episode of the row's agent beats one of the column's on the same map: a panel per variant."""
    pairs, counted = statistics["improvement"], statistics["profiles"]
    variants: dict[str, list[str]] = {}
    for pair in pairs:
        names = variants.setdefault(pair["ours"].rpartition(" / ")[2], [])
        names += [pair["ours"]] if pair["ours"] not in names else []
    sizes = [0.36 * len(names) for names in variants.values()]
    letters = 0.06 * max(len(pair["ours"]) for pair in pairs)  # inches that the longest name takes
    width = max(0.45 * max(map(len, variants.values())), 3.0) + letters + 2.0
    figure = Figure(figsize=(width, sum(sizes) + 0.9 * len(sizes)), layout="constrained")
    panels = figure.subplots(len(variants), 1, squeeze=False, height_ratios=sizes)[:, 0]
    for axes, (variant, names) in zip(panels, variants.items(), strict=True):
        table = np.full((len(names), len(names)), np.nan)
        for pair in pairs:
            if pair["ours"] not in names:
                continue
            row, column = names.index(pair["ours"]), names.index(pair["theirs"])
            table[row, column] = value = pair["mean"]
            axes.text(
                *(column, row, f"{value:.2f}"),
                ha="center",
                va="center",
                fontsize=6,
                color="#ffffff" if abs(value - 0.5) > 0.3 else "#000000",  # both ends of the scale are dark
                weight="normal" if pair["low"] <= 0.5 <= pair["high"] else "bold",
            )
        axes.imshow(np.ma.masked_invalid(table), cmap="RdBu", vmin=0, vmax=1)
        short = [name.removesuffix(f" / {variant}") for name in names]
        counts = [_counted(counted["seeds"][name], counted["episodes"][name]) for name in names]
        axes.set_xticks(range(len(names)), [str(at + 1) for at in range(len(names))], fontsize=7)
        labels = [f"{name}  ({count})  {at + 1}" for at, (name, count) in enumerate(zip(short, counts, strict=True))]
        axes.set_yticks(range(len(names)), labels, fontsize=7)
        axes.set_title(
            f"{variant}: P(an episode of the row beats one of the column on the same map);\n"
            "bold: its 95 % interval leaves out 0.5",
            fontsize=8,
        )
    return figure


def learning(curves: Sequence[Curve], optima: Mapping[str, float], notes: Sequence[str] = ()) -> Figure:
    """Learning curves with bands, a row per variant: the policy's (left), the average over all episodes so far (right).

    Args:
        curves: one per condition.
        optima: the exact optimum by variant, drawn as a dotted line.
        notes: lines of text under the figure.
    """
    variants = list(dict.fromkeys(curve.get("variant", "") for curve in curves))
    figure = Figure(figsize=(11, 4.4 * len(variants)), layout="constrained")
    rows = figure.subplots(len(variants), 2, squeeze=False)
    for panels, variant in zip(rows, variants, strict=True):
        mine = [curve for curve in curves if curve.get("variant", "") == variant]
        titles = (
            ("policy", f"{variant}, policy: mean of the last {mine[0]['window']} training episodes"),
            ("running_average", f"{variant}, running average over all training episodes so far"),
        )
        for axes, (which, title) in zip(panels, titles, strict=True):
            for position, curve in enumerate(mine):
                colour = PALETTE[position % len(PALETTE)]
                label = f"{curve['name']} ({_counted(curve['seeds'], curve['episodes'])})"
                band = curve[which]
                axes.plot(curve["episode"], band["mean"], color=colour, label=label, linewidth=1.2)
                if curve["seeds"] > 1:
                    axes.fill_between(curve["episode"], band["low"], band["high"], color=colour, alpha=0.2, linewidth=0)
            if variant in optima:
                axes.axhline(optima[variant], color="#000000", linestyle=":", linewidth=1, label="exact optimum")
            axes.set_title(title, fontsize=9)
            axes.set_xlabel("training episode")
            axes.set_ylabel("return")
            axes.grid(alpha=0.3)
        # On the right all curves start low and stay below: room in the corner above.
        panels[1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(0.0, 0.97))
    if notes:
        figure.supxlabel("\n".join(notes), fontsize=7)
    return figure


def _colours(agents: Sequence[str]) -> dict[str, str]:
    """A colour for each agent, black for the optimum."""
    others = [agent for agent in dict.fromkeys(agents) if agent != "optimum"]
    return {"optimum": "#000000"} | dict(zip(others, cycle((*PALETTE[:-1], *MORE)), strict=False))


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
