"""Tables of a comparison for papers and spreadsheets: Parquet, CSV, Markdown and LaTeX.

comparison   one row per agent and condition: all figures (.parquet, .csv), the main ones (.md, .tex)
measures     every metric of docs/metrics.md with its interval, a few to a table (.md, .tex)

What people read (.md, .tex) shows every agent on the episodes that all agents of its variant have played; data files
have the figures of all episodes too, and those of the shared ones under `shared`.

regret       one row per agent, condition and map (.parquet, .csv)
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from nesy.report.text import COMPARISON_COLUMNS, TEXT_COLUMNS, comparison_rows, interval, number, shown
from nesy.run_folder import atomic_path

ACROSS = 5
"""Metrics side by side in one table."""
SUMMED_UP = ("return", "interquartile_mean", "success", "regret", "behind_bayes_optimum")
"""Figures of a record that have an interval of their own."""


def write_tables(folder: Path, records: Sequence[dict[str, Any]], regrets: Sequence[dict[str, Any]]) -> None:
    """Write every table."""
    for name, rows in (("comparison", [_flat(record) for record in records]), ("regret", regrets)):
        if not rows:
            continue
        columns = list(dict.fromkeys(column for row in rows for column in row))
        with atomic_path(folder / f"{name}.parquet") as temporary:
            table = pa.table({column: [row.get(column) for row in rows] for column in columns})
            pq.write_table(table, temporary, compression="zstd")
        with (
            atomic_path(folder / f"{name}.csv") as temporary,
            temporary.open("w", newline="", encoding="utf-8") as stream,
        ):
            writer = csv.DictWriter(stream, columns)
            writer.writeheader()
            writer.writerows(rows)
    main = [(COMPARISON_COLUMNS, comparison_rows(list(records)))]
    for name, tables in (("comparison", main), ("measures", _measures([shown(record) for record in records]))):
        for ending, text in (("md", _markdown), ("tex", _latex)):
            with atomic_path(folder / f"{name}.{ending}") as temporary:
                temporary.write_text("\n".join(text(columns, rows) for columns, rows in tables), encoding="utf-8")


def _flat(record: dict[str, Any]) -> dict[str, Any]:
    """A record as one row: nested figures with dotted names, the seeds as text."""
    row: dict[str, Any] = {}
    for name, value in record.items():
        if name == "metrics":
            for metric, mean in value.items():
                low, high = record["metric_intervals"][metric]
                row |= {f"metrics.{metric}": mean, f"metrics.{metric}.low": low, f"metrics.{metric}.high": high}
        elif name == "shared":
            row |= {f"shared.{inner}": figure for inner, figure in _flat(value).items()}
        elif isinstance(value, dict) and name != "metric_intervals":
            row |= {f"{name}.{inner}": figure for inner, figure in value.items()}
        elif name != "metric_intervals":
            row[name] = " ".join(map(str, value)) if isinstance(value, list) else value
    return row


def _measures(records: Sequence[dict[str, Any]]) -> list[tuple[tuple[str, ...], list[tuple[str, ...]]]]:
    """Tables of every figure that has an interval: what is summed up first, then every metric."""
    names = list(dict.fromkeys(name for record in records for name in record["metrics"] if name not in SUMMED_UP))
    blocks = [SUMMED_UP, *(tuple(names[at : at + ACROSS]) for at in range(0, len(names), ACROSS))]
    return [(("agent", "episodes", *block), [_measure_row(record, block) for record in records]) for block in blocks]


def _measure_row(record: dict[str, Any], names: Sequence[str]) -> tuple[str, ...]:
    parts = (record["agent"], record["inputs"], record["influence"], record["variant"])
    seeds = len(record["seeds"])
    counted = f"{record['episodes']} ({seeds} seed{'s' if seeds != 1 else ''})"
    return (" / ".join(filter(None, parts)), counted, *(_measure(record, name) for name in names))


def _measure(record: dict[str, Any], name: str) -> str:
    """`mean [low, high]`, empty where this record has no such figure."""
    if name in SUMMED_UP:
        return "" if record.get(name) is None else interval(record[name], 3 if name == "success" else 1)
    if name not in record["metrics"]:
        return ""
    figures = (record["metrics"][name], *record["metric_intervals"][name])
    mean, low, high = ("" if figure is None else number(float(f"{figure:.3g}")) for figure in figures)
    return f"{mean} [{low}, {high}]" if low else f"{mean} [-]"


def _markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


def _latex(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    special = {character: f"\\{character}" for character in "&%$#_{}"}
    special |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}

    def line(cells: Sequence[str]) -> str:
        return " & ".join("".join(special.get(c, c) for c in cell) for cell in cells) + r" \\"

    layout = "".join("l" if column in TEXT_COLUMNS else "r" for column in columns)
    return "\n".join(
        [rf"\begin{{tabular}}{{{layout}}}", line(columns), r"\hline", *map(line, rows), r"\end{tabular}", ""]
    )
