"""Gates of the world model."""

from __future__ import annotations

from typing import Any

from nesy.report.html_pieces import table
from nesy.report.text import number
from nesy.run_folder import RunFolder

ANCHOR = "world-model"
TITLE = "World model"


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """The gates on all data and on held-out maps, each beside what the data allow at best."""
    gates = summary["world_model"]
    held_out, names = gates.get("held_out", {}), [n for n, value in gates.items() if isinstance(value, int | float)]
    rows = [
        [name, number(gates[name]), *(_cell(part, name) for part in (gates.get("limits", {}), gates.get("passed", {}))),
         _cell(held_out, name), _cell(held_out.get("limits", {}), name)]
        for name in names
    ]  # fmt: skip
    columns = ("gate", "figure", "limit of the data", "passed", "held-out maps", "limit there")
    usage = ", ".join(f"{value:.1f}" for value in gates.get("perplexity", ()))
    return table(columns, rows, "Gates of the world model.") + (
        f"<p>Perplexity of the values of each factor: {usage}.</p>" if usage else ""
    )


def _cell(figures: dict[str, Any], name: str) -> str:
    value = figures.get(name)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "" if value is None else number(value)
