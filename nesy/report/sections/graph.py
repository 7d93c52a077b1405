"""The 2DBN, factor by factor: click one for its parents, tables, meanings and rules."""

from __future__ import annotations

from typing import Any

from nesy.report.html_pieces import embedded_json
from nesy.report.model_data import graph_data
from nesy.run_folder import RunFolder

ANCHOR = "graph"
TITLE = "The model, factor by factor"


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """The place where the page's script draws the graph, and its data."""
    from nesy.dbn import Codebook, TwoSliceDBN

    data = graph_data(TwoSliceDBN.load(run.dbn), Codebook.load(run.dbn))
    return (
        "<p>Each factor of the next moment depends on a few factors now and on factors already decided in the same "
        "moment (marked ′). Choose an action and a factor: with the mouse, or with Tab and the arrow keys.</p>"
        '<div id="graph-view"><noscript><p>This part of the page needs JavaScript; the tables of the section '
        "'Symbolic 2DBN' do without.</p></noscript></div>" + embedded_json("graph-data", data)
    )
