"""report.html: one self-contained page, made from the run folder alone."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nesy.errors import UserError
from nesy.progress import SILENT, Progress
from nesy.report import examples, figures
from nesy.report.text import COMPARISON_COLUMNS, comparison_rows, flat, number
from nesy.run_folder import RunFolder, atomic_path


def write_report(run: RunFolder, progress: Progress = SILENT) -> Path:
    """Write report.html; every number on it comes from summary.json.

    Returns:
        The page's path.

    Raises:
        UserError: the run lacks a step, or a file of it is damaged.
    """
    run.require("collect", "train", "extract", "compare")
    summary = run.read_summary()
    makers = (
        ("comparison", "Comparison", lambda: _comparison(summary)),
        ("learning", "Learning curves", lambda: _learning(run, summary)),
        ("belief", "Belief and shifted belief", lambda: _belief(run)),
        ("world-model", "World model", lambda: _world_model(summary["world_model"])),
        ("dbn", "Symbolic 2DBN", lambda: _dbn(run, summary)),
        ("provenance", "How it was made", lambda: _provenance(summary)),
    )
    sections, navigation = [], []
    with progress.task("report", len(makers)) as task:
        for anchor, title, make in makers:
            sections.append(f'<section id="{anchor}"><h2>{html.escape(title)}</h2>\n{make()}\n</section>')
            navigation.append(f'<a href="#{anchor}">{html.escape(title)}</a>')
            task.advance()
    made = summary["provenance"]
    templates = files("nesy.report") / "templates"
    page = Template((templates / "page.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(f"nesy run: {run.path.name}"),
        subtitle=html.escape(f"Variant {made['variant']}, preset {made['preset']}, seed {made['seed']}."),
        style=(templates / "style.css").read_text(encoding="utf-8"),
        navigation="\n".join(navigation),
        sections="\n".join(sections),
        footer="Every number on this page is in summary.json beside it.",
    )
    with atomic_path(run.report) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return run.report


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]], caption: str, text_columns: int = 1) -> str:
    def cells(tag: str, values: Sequence[str]) -> str:
        kinds = ["" if position < text_columns else ' class="number"' for position in range(len(values))]
        return "".join(f"<{tag}{kind}>{html.escape(value)}</{tag}>" for kind, value in zip(kinds, values, strict=True))

    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return (
        f'<div class="scroll"><table><caption>{html.escape(caption)}</caption>'
        f"<thead><tr>{cells('th', columns)}</tr></thead><tbody>\n{body}\n</tbody></table></div>"
    )


def _figure(svg: str, caption: str, label: str) -> str:
    return (
        f'<figure><div class="plot" role="img" aria-label="{html.escape(label)}">{svg}</div>'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _comparison(summary: dict[str, Any]) -> str:

    cells = summary["comparison"]
    caption = "Evaluation on the same maps and seeds for all; 95 % bootstrap intervals in brackets."
    return _table(COMPARISON_COLUMNS, comparison_rows(cells), caption, text_columns=4) + _figure(
        figures.comparison(cells),
        "Mean return per episode. The optimum is exact: dynamic programming over the full state.",
        "Mean return of every agent with its interval",
    )


def _learning(run: RunFolder, summary: dict[str, Any]) -> str:
    path = run.results / "episodes.parquet"
    columns = ["agent", "inputs", "influence", "variant", "seed", "phase", "episode", "return"]
    try:
        table = pq.read_table(path, columns=columns, filters=[("phase", "=", "train")])
    except (OSError, pa.ArrowException) as error:
        raise UserError(
            f"{path}: not readable as Parquet ({type(error).__name__}); make it with: nesy compare"
        ) from None
    rows = table.to_pydict()
    groups: dict[str, list[int]] = {}
    for position in range(table.num_rows):
        name = " / ".join(str(rows[column][position]) for column in columns[:5] if column != "variant")
        groups.setdefault(name.replace(" / 0", "") if len(set(rows["seed"])) == 1 else name, []).append(position)
    if not groups:
        return "<p>No agent of this comparison learned.</p>"
    returns = np.asarray(rows["return"], dtype=np.float64)
    episodes = np.asarray(rows["episode"])
    curves = {name: returns[sorted(members, key=lambda i: episodes[i])] for name, members in groups.items()}
    optimum = next((cell["return"]["mean"] for cell in summary["comparison"] if cell["agent"] == "optimum"), None)
    window = 200
    return _figure(
        figures.learning_curves(curves, optimum, window),
        f"Return of the training episodes, exploration included: mean of the last {window} episodes.",
        "Learning curves of the DQN",
    )


def _belief(run: RunFolder) -> str:
    example = examples.belief_example(run)
    if example is None:
        return "<p>The person is never in view in the experience of this run.</p>"
    return _figure(
        figures.belief_panel(example),
        "A moment of the experience: the robot sees the person, imagines walking to its pose with the learned "
        "model, and so estimates what the person believes. Orange triangle: the viewer; blue: the person.",
        "Heat maps of a belief and of the perspective-shifted belief, with what they decode to",
    )


def _world_model(gates: dict[str, Any]) -> str:
    """The gates on all data and on held-out maps, each beside what the data allow at best."""
    held_out, names = gates.get("held_out", {}), [n for n, value in gates.items() if isinstance(value, int | float)]
    rows = [
        [name, number(gates[name]), *(_cell(part, name) for part in (gates.get("limits", {}), gates.get("passed", {}))),
         _cell(held_out, name), _cell(held_out.get("limits", {}), name)]
        for name in names
    ]  # fmt: skip
    columns = ("gate", "figure", "limit of the data", "passed", "held-out maps", "limit there")
    usage = ", ".join(f"{value:.1f}" for value in gates.get("perplexity", ()))
    return _table(columns, rows, "Gates of the world model.") + (
        f"<p>Perplexity of the values of each factor: {usage}.</p>" if usage else ""
    )


def _cell(figures: dict[str, Any], name: str) -> str:
    value = figures.get(name)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "" if value is None else number(value)


def _dbn(run: RunFolder, summary: dict[str, Any]) -> str:
    from nesy.dbn import TwoSliceDBN, describe
    from nesy.dbn.drawing import graph_figure

    dbn = TwoSliceDBN.load(run.dbn)
    rows = [
        [
            name,
            *(
                ", ".join([str(p) for p in dbn.parents_now[a][i]] + [f"{p}'" for p in dbn.parents_next[a][i]]) or "none"
                for a in range(len(dbn.action_names))
            ),
        ]
        for i, name in enumerate(dbn.factor_names)
    ]
    parents = _table(
        ("factor", *dbn.action_names),
        rows,
        "Parents of every factor under every action: factors of slice t, and with ' earlier factors of slice t+1.",
        text_columns=1 + len(dbn.action_names),
    )
    action = dbn.action_names.index("forward") if "forward" in dbn.action_names else 0
    graph = _figure(
        figures.svg(graph_figure(dbn)),
        "Parents of every factor per action; arrows as wide as they are strong, brown inside slice t+1.",
        "Graph of the 2DBN",
    )
    lines = describe(dbn, factor=dbn.order[0], action=action).splitlines()
    excerpt = "\n".join(lines[:40]) + ("\n..." if len(lines) > 40 else "")
    command = f"nesy extract --run {run.path} --table --factor {dbn.order[0]} --action {dbn.action_names[action]}"
    return (
        _figures_table(summary["dbn"], "Figures of the extraction")
        + graph
        + parents
        + f"<p>An excerpt; all of it: <code>{html.escape(command)}</code></p><pre>{html.escape(excerpt)}</pre>"
    )


def _figures_table(values: dict[str, Any], caption: str) -> str:

    return _table(("figure", "value"), [(name, number(value)) for name, value in flat(values)], caption)


def _provenance(summary: dict[str, Any]) -> str:
    return _figures_table(summary["provenance"], "Settings, versions and machine") + _figures_table(
        summary["timing"], "Seconds per step of the pipeline"
    )
