"""Tables that the commands print, all made from the figures of summary.json."""

from __future__ import annotations

import sys
from typing import Any

from rich.console import Console
from rich.table import Table


def comparison_rows(cells: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """One row of text per cell of the comparison, in the order of `COMPARISON_COLUMNS`."""
    rows = []
    for cell in cells:
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
                str(cell["episodes"]),
            )
        )
    return rows


COMPARISON_COLUMNS = (
    "agent",
    "inputs",
    "influence",
    "variant",
    "mean return",
    "success",
    "of optimum",
    "ms/decision",
    "episodes",
)


def interval(figure: dict[str, float], digits: int) -> str:
    """`mean [low, high]`, or the mean alone where it is exact."""
    mean, low, high = figure["mean"], figure.get("low"), figure.get("high")
    if low is None or high is None:
        return f"{mean:.{digits}f} (exact)"
    return f"{mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def print_comparison(cells: list[dict[str, Any]]) -> None:
    """Print the comparison table."""
    print_table("Comparison (95 % intervals)", COMPARISON_COLUMNS, comparison_rows(cells))


def print_table(title: str, columns: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """Print a table on standard output; wide enough for every cell where that is not a terminal."""
    table = Table(title=title, title_justify="left")
    for column in columns:
        table.add_column(column, justify="left" if column in columns[:4] else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console = Console(file=sys.stdout)
    if not console.is_terminal:
        console = Console(file=sys.stdout, width=160)
    console.print(table)


def print_figures(title: str, figures: dict[str, Any]) -> None:
    """Print plain figures, one per line; nested ones with dotted names."""
    rows = [(name, value) for name, value in _flat(figures)]
    width = max((len(name) for name, _ in rows), default=0)
    print(title)
    for name, value in rows:
        print(f"  {name:{width}}  {value:.6g}" if isinstance(value, float) else f"  {name:{width}}  {value}")


def _flat(figures: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for name, value in figures.items():
        if isinstance(value, dict):
            rows += _flat(value, f"{prefix}{name}.")
        elif not isinstance(value, list):
            rows.append((prefix + name, value))
    return rows
