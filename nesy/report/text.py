"""The figures of summary.json as text: the same rows for the terminal and for the page."""

from __future__ import annotations

from typing import Any

COMPARISON_COLUMNS = (
    "agent",
    "inputs",
    "influence",
    "variant",
    "mean return",
    "success",
    "of optimum",
    "ms/decision",
    "learned from",
    "episodes",
    "algorithm",
    "model",
)


TEXT_COLUMNS = ("agent", "inputs", "influence", "variant", "algorithm", "model")
"""The columns of words; the others are figures."""


def shown(cell: dict[str, Any]) -> dict[str, Any]:
    """A record with the figures that tables show: of the episodes that all agents of its variant have played."""
    return {**cell, **(cell.get("shared") or {})}


def shared_note(cells: list[dict[str, Any]]) -> str:
    """Which episodes the figures are of, where agents have played different ones; else empty."""
    counts = {cell["variant"]: shown(cell)["episodes"] for cell in cells if cell.get("shared")}
    if not counts:
        return ""
    episodes = ", ".join(f"{count} episodes of {variant}" for variant, count in counts.items())
    return f"Figures are of the {episodes} that all agents have played; of all their episodes: results/comparison.csv."


def comparison_rows(cells: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """One row of text per cell of the comparison, in the order of `COMPARISON_COLUMNS`."""
    rows: list[tuple[str, ...]] = []
    for cell in map(shown, cells):
        share = cell.get("share_of_optimum")
        rows.append(
            (
                cell["agent"],
                cell.get("inputs") or "",
                cell.get("influence") or "",
                cell["variant"],
                interval(cell["return"], 1),
                interval(cell["success"], 3),
                "" if share is None else f"{100 * share:.1f} %",
                f"{cell['ms_per_decision']:.3g}",
                f"{cell['experience_steps']:,}" if cell.get("experience_steps") else "",
                f"{cell['episodes']} ({len(cell['seeds'])} seeds)"
                if len(cell.get("seeds", ())) > 1
                else str(cell["episodes"]),
                cell.get("algorithm", ""),
                cell.get("model", ""),
            )
        )
    return rows


def interval(figure: dict[str, Any], digits: int) -> str:
    """`mean [low, high]`; `mean (exact)` where it is worked out, `mean [-]` where there is no interval."""
    mean, low, high = figure["mean"], figure.get("low"), figure.get("high")
    if low is None or high is None:
        return f"{mean:.{digits}f} {'(exact)' if figure.get('exact') else '[-]'}"
    return f"{mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def flat(figures: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Nested figures as (dotted name, value); lists are left out."""
    rows: list[tuple[str, Any]] = []
    for name, value in figures.items():
        if isinstance(value, dict):
            rows += flat(value, f"{prefix}{name}.")
        elif not isinstance(value, list):
            rows.append((prefix + name, value))
    return rows


def number(value: Any) -> str:
    """Six significant digits for floats; anything else as it is."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
