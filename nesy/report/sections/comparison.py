"""The comparison: every agent beside the exact optimum."""

from __future__ import annotations

from typing import Any

from nesy.report import figures
from nesy.report.html_pieces import figure, table
from nesy.report.text import COMPARISON_COLUMNS, comparison_rows
from nesy.run_folder import RunFolder

ANCHOR = "comparison"
TITLE = "Comparison"


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """The cells of the comparison as a table and as a picture."""
    cells = summary["comparison"]
    caption = "Evaluation on the same maps and seeds for all; 95 % bootstrap intervals in brackets."
    return table(COMPARISON_COLUMNS, comparison_rows(cells), caption, text_columns=4) + figure(
        figures.comparison(cells),
        "Mean return per episode. The optimum is exact: dynamic programming over the full state.",
        "Mean return of every agent with its interval",
    )
