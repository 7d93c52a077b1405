"""Episodes of the comparison, played again step by step."""

from __future__ import annotations

import html
from typing import Any

from nesy.report.html_pieces import embedded_json
from nesy.run_folder import RunFolder, read_json

ANCHOR = "replays"
TITLE = "Replays"


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """The place where the page's script shows the replays, and their data."""
    path = run.results / "replays.json"
    if not path.is_file():
        command = html.escape(f"nesy report --run {run.path}")
        return f"<p>No replays are recorded; make them with: <code>{command}</code></p>"
    document = read_json(path)
    model = read_json(run.dbn / "model.json")
    named = {"factor_names": model["factor_names"], "num_values": model["num_values"]}
    left_out = f" {document['left_out']} further episodes are left out." if document["left_out"] else ""
    return (
        f"<p>Chosen by rule: {html.escape(document['rule'])}.{left_out} Arrow keys, Home and End on the slider move "
        "through time.</p>"
        '<div id="replay-view"><noscript><p>This part of the page needs JavaScript.</p></noscript></div>'
        + embedded_json("replay-data", {**document, **named})
    )
