"""What codes mean: every value with its picture and its rule, and the rules that read predicates off codes."""

from __future__ import annotations

import html
from typing import Any

import numpy as np

from nesy.report.html_pieces import table
from nesy.run_folder import RunFolder

ANCHOR = "semantics"
TITLE = "What codes mean"

CELL = 9
MOST_RULES = 2
"""Of the rules for one value or predicate, the page shows so many."""


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """Scores of the rules, a row per factor value, a row per predicate."""
    from nesy.dbn import Codebook, TwoSliceDBN

    found = summary.get("semantics")
    if not found:
        return f"<p>Not measured for this run; redo it with: <code>nesy extract --run {run.path} --redo</code></p>"
    dbn, book = TwoSliceDBN.load(run.dbn), Codebook.load(run.dbn)
    return (
        _scores(found)
        + "".join(_factor(dbn.factor_names[f], f, book, found["values"]["each"]) for f in range(dbn.num_factors))
        + _predicates(found["predicates"]["each"])
    )


def _scores(found: dict[str, Any]) -> str:
    kinds = {
        "predicates": "predicates from codes, where at most three factors settle them",
        "all_predicates": "predicates from codes, all",
        "values": "values from predicates",
    }
    figures = [(title, found[kind]) for kind, title in kinds.items()]
    # a run measured by an earlier version has none
    for number, record in found.get("by_factors", {}).items():
        figures.append((f"predicates from codes, settled by {number} factor{'s' * (number != '1')}", record))
    rows = [
        [
            title,
            str(record["count"]),
            *(_share(record.get(name)) for name in ("precision", "recall", "maps_precision", "maps_recall")),
            f"{record.get('length', 0.0):.1f}",
        ]
        for title, record in figures
    ]
    caption = (
        f"Rules learned from three quarters of {found['views']} distinct views and scored on the others, each view "
        "once; by maps: scored on views met on no map that was learned from. Averages over predicates or values."
    )
    columns = ("rules", "count", "precision", "recall", "precision, by maps", "recall, by maps", "conditions")
    recovered = found.get("recovered")
    text = ""
    if recovered:
        names = ", ".join(f"{name} {value:.4f}" for name, value in recovered["accuracy"].items())
        text = f"<p>Read off the codes of all {recovered['views']} views of the domain: {html.escape(names)}.</p>"
    return table(columns, rows, caption) + text


def _factor(name: str, factor: int, book: Any, each: dict[str, Any]) -> str:
    rows = []
    for value in np.unique(book.codes[:, factor]).tolist():
        record = each.get(f"{name}={value}")
        chosen = book.views[book.codes[:, factor] == value]
        cells = ["", ""]
        if record is not None:
            cells = [_rules(record["text"]), f"{_share(record['precision'])}, {_share(record['recall'])}"]
        rows.append(
            f"<tr><td>{name} = {value}</td><td>{_picture(chosen, f'{name} = {value}')}</td><td>{cells[0]}</td>"
            f'<td class="number">{len(chosen)}</td><td class="number">{cells[1]}</td></tr>'
        )
    return (
        f'<details><summary>{html.escape(name)}</summary><div class="scroll"><table>'
        f"<caption>The values of {html.escape(name)}: the mean of their views, and when they hold.</caption>"
        "<thead><tr><th>value</th><th>mean view</th><th>holds if</th><th>views</th><th>precision, recall</th></tr>"
        f"</thead><tbody>{''.join(rows)}</tbody></table></div></details>"
    )


def _picture(views: np.ndarray, label: str) -> str:
    """The mean colours of some views as inline SVG, the viewer at the bottom."""
    from nesy.dbn.reading.drawing import mean_view

    colours = (mean_view(views) * 255).round().astype(int)
    width, height = colours.shape[:2]
    cells = "".join(
        f'<rect x="{x * CELL}" y="{y * CELL}" width="{CELL}" height="{CELL}" '
        f'fill="#{colours[x, y, 0]:02x}{colours[x, y, 1]:02x}{colours[x, y, 2]:02x}"/>'
        for x in range(width)
        for y in range(height)
    )
    return (
        f'<svg width="{width * CELL}" height="{height * CELL}" viewBox="0 0 {width * CELL} {height * CELL}" '
        f'role="img" aria-label="mean view of {html.escape(label)}">{cells}</svg>'
    )


def _predicates(each: dict[str, Any]) -> str:
    rows = [
        [
            name,
            "; or ".join(record["text"][:MOST_RULES])
            + (f"; or {record['rules'] - MOST_RULES} more" if record["rules"] > MOST_RULES else ""),
            str(record["views"]),
            _share(record["precision"]),
            _share(record["recall"]),
            str(record["length"]),
        ]
        for name, record in sorted(each.items(), key=lambda item: (item[1]["length"], item[0]))
        if record["supported"]
    ]
    caption = "Predicates read off codes, the shortest rules first; precision and recall on held-out views."
    inner = table(
        ("predicate", "holds if", "views", "precision", "recall", "conditions"), rows, caption, text_columns=2
    )
    return f"<details><summary>Predicates</summary>{inner}</details>"


def _rules(text: list[str]) -> str:
    shown = "; or ".join(text[:MOST_RULES])
    return html.escape(shown + (f"; or {len(text) - MOST_RULES} more" if len(text) > MOST_RULES else ""))


def _share(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
