"""The comparison: every agent beside the exact optimum, by every measure."""

from __future__ import annotations

import csv
import html
from typing import Any

from nesy.errors import UserError
from nesy.report import comparison_figures, figures
from nesy.report.html_pieces import figure, table
from nesy.report.text import COMPARISON_COLUMNS, comparison_rows, number, shared_note, shown
from nesy.run_folder import RunFolder, read_json

ANCHOR = "comparison"
TITLE = "Comparison"
INTERVALS = (
    "Evaluation on the same maps and seeds for all. Brackets: 95 % bootstrap intervals, stratified by map; where each "
    "map comes once, of what the optimum there does not explain; where more maps are there than have been played, over "
    "maps; of agents that learn, with two seeds or more, over seeds (with one they leave out how much one training "
    "differs from another). [-]: nothing varied, or there is but one episode. 'learned from' counts environment steps "
    "besides those of the world model."
)


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """The cells of the comparison as tables and as pictures."""
    cells = summary["comparison"]
    parts = [
        table(COMPARISON_COLUMNS, comparison_rows(cells), f"{INTERVALS} {shared_note(cells)}".strip(), text_columns=4),
        _deciders(cells),
        figure(
            figures.svg(comparison_figures.returns(cells)),
            "Return per episode. The optimum's policy is exact: dynamic programming over the full state.",
            "Mean return of every agent with its interval",
        ),
    ]
    if (run.results / "statistics.json").is_file():
        statistics = read_json(run.results / "statistics.json")
        left_out = [f"{name} left out: {reason}." for name, reason in statistics.get("left_out", {}).items()]
        if left_out:
            parts.insert(1, f"<p>{'<br>'.join(map(html.escape, left_out))}</p>")
        parts.append(
            figure(
                figures.svg(comparison_figures.profiles(statistics["profiles"])),
                "Performance profiles: for every return, the share of episodes that reach more.",
                "Performance profiles",
            )
        )
        if statistics["improvement"]:
            parts.append(
                figure(
                    figures.svg(comparison_figures.improvement(statistics)),
                    "Probability of improvement: how often an episode of one agent beats one of another on the same "
                    "map, ties half.",
                    "Probability of improvement for every pair of agents",
                )
            )
    return "".join([*parts, _metrics(cells), _regret(run)])


def _deciders(cells: list[dict[str, Any]]) -> str:
    """What decided in each agent's rows, and with what model: once per agent, or per variant where that differs."""
    columns = ("agent", "algorithm", "model")
    said: dict[tuple[str, ...], list[str]] = {}
    for cell in cells:
        variants = said.setdefault(tuple(cell.get(column, "") for column in columns), [])
        variants += [cell["variant"]] if cell["variant"] not in variants else []
    rows = [(*key, ", ".join(variants)) for key, variants in said.items()]
    return table((*columns, "variants"), rows, "What decides, and with what model.", text_columns=4)


def _metrics(cells: list[dict[str, Any]]) -> str:
    """Every metric of docs/metrics.md, one column per agent and condition."""
    measured = [cell for cell in map(shown, cells) if cell.get("metrics")]
    if not measured:
        return ""
    names = list(dict.fromkeys(name for cell in measured for name in cell["metrics"]))
    rows = [[name, *(number(_rounded(cell["metrics"].get(name))) for cell in measured)] for name in names]
    caption = "Every metric (meaning and source: docs/metrics.md), mean over evaluation episodes."
    return _folded(caption, table(("metric", *map(_name, measured)), rows, caption))


def _regret(run: RunFolder) -> str:
    """Per map what each agent leaves of the optimum's return."""
    path = run.results / "regret.csv"
    if not path.is_file():
        return ""
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        maps: dict[str, dict[str, str]] = {}
        optimum: dict[str, float] = {}
        for row in rows:
            key = f"{row['variant']} {row['map_id']}"
            maps.setdefault(key, {})[_name(row)] = f"{float(row['regret']):.1f}"
            optimum[key] = float(row["optimum_return"])
    except (KeyError, ValueError) as error:
        raise UserError(f"{path}: damaged ({error}); make it with: nesy compare") from None
    agents = list(dict.fromkeys(_name(row) for row in rows))
    body = [
        [key, f"{optimum[key]:.1f}", *(maps[key].get(agent, "") for agent in agents)]
        for key in sorted(maps, key=lambda key: optimum[key])
    ]
    caption = (
        "Regret per map: the exact optimum's return minus the agent's mean, maps by the optimum's return. On about a "
        "fifth of the maps of `paper` nobody can succeed."
    )
    return _folded(caption, table(("map", "optimum", *agents), body, caption))


def _folded(title: str, content: str) -> str:
    return f"<details><summary>{title.split(':')[0].split('(')[0]}</summary>{content}</details>"


def _name(cell: dict[str, Any]) -> str:
    return " / ".join(filter(None, (cell["agent"], cell.get("inputs"), cell.get("influence"), cell.get("variant"))))


def _rounded(value: float | None) -> float | str:
    return "" if value is None else float(f"{value:.3g}")
