"""The symbolic 2DBN."""

from __future__ import annotations

import html
from typing import Any

from nesy.report import figures
from nesy.report.html_pieces import figure, figures_table, table
from nesy.run_folder import RunFolder

ANCHOR = "dbn"
TITLE = "Symbolic 2DBN"


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """Figures of the extraction, the graph, the parents and an excerpt of the tables."""
    from nesy.dbn import TwoSliceDBN, describe
    from nesy.dbn.reading.drawing import graph_figure

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
    parents = table(
        ("factor", *dbn.action_names),
        rows,
        "Parents of every factor under every action: factors of slice t, and with ' earlier factors of slice t+1.",
        text_columns=1 + len(dbn.action_names),
    )
    action = dbn.action_names.index("forward") if "forward" in dbn.action_names else 0
    graph = figure(
        figures.svg(graph_figure(dbn)),
        "Parents of every factor per action; arrows as wide as they are strong, brown inside slice t+1.",
        "Graph of the 2DBN",
    )
    lines = describe(dbn, factor=dbn.order[0], action=action).splitlines()
    excerpt = "\n".join(lines[:40]) + ("\n..." if len(lines) > 40 else "")
    own = {name: value for name, value in summary["dbn"].items() if name != "fidelity"}
    command = f"nesy extract --run {run.path} --table --factor {dbn.order[0]} --action {dbn.action_names[action]}"
    return (
        figures_table(own, "Figures of the extraction")
        + graph
        + parents
        + f"<p>An excerpt; all of it: <code>{html.escape(command)}</code></p><pre>{html.escape(excerpt)}</pre>"
    )
