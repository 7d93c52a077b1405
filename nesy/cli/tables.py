"""Tables that the commands print, all made from the figures of summary.json."""

from __future__ import annotations

import sys
from typing import Any

from rich.console import Console
from rich.table import Table

from nesy.report import text


def print_comparison(cells: list[dict[str, Any]]) -> None:
    """Print the comparison."""
    table = Table(title="Comparison (95 % intervals in brackets)", title_justify="left")
    for column in text.COMPARISON_COLUMNS:
        table.add_column(column, justify="left" if column in text.TEXT_COLUMNS else "right", no_wrap=True)
    for row in text.comparison_rows(cells):
        table.add_row(*row)
    print_wide(table)
    if note := text.shared_note(cells):
        print(note)


def print_left_out(left_out: dict[str, str]) -> None:
    """Print a line for each agent that there is no row of, and why."""
    for name, reason in left_out.items():
        print(f"{name} left out: {reason}")


def print_wide(table: Table) -> None:
    """Print a table on standard output; wide enough for every cell where that is not a terminal."""
    console = Console(file=sys.stdout)
    if not console.is_terminal:
        console = Console(file=sys.stdout, width=Console(width=10_000).measure(table).maximum)
    console.print(table)


def print_figures(title: str, figures: dict[str, Any]) -> None:
    """Print plain figures, one per line; nested ones with dotted names."""
    rows = text.flat(figures)
    width = max((len(name) for name, _ in rows), default=0)
    print(title)
    for name, value in rows:
        print(f"  {name:{width}}  {text.number(value)}")
