"""How the learning agents learned."""

from __future__ import annotations

from typing import Any

from nesy.errors import UserError
from nesy.report import comparison_figures, figures
from nesy.report.html_pieces import figure
from nesy.run_folder import RunFolder, read_json

ANCHOR = "learning"
TITLE = "Learning curves"


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """Learning curves of the agents that learn: the policy's, and the running average."""
    path = run.results / "statistics.json"
    statistics = read_json(path)
    if not isinstance(statistics, dict) or "curves" not in statistics:
        raise UserError(f"{path}: not what a comparison leaves; make it with: nesy compare")
    curves = statistics["curves"]
    if not curves:
        return "<p>No agent of this comparison learned.</p>"
    return figure(
        figures.svg(comparison_figures.learning(curves, comparison_figures.exact_optima(summary["comparison"]))),
        "Return of the training episodes, exploration included. Left the policy as it was, right the average over "
        "everything since the beginning, as the paper plots it. Bands: 95 % over seeds, where there are several.",
        "Learning curves of the DQN",
    )
