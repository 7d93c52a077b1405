"""Belief and shifted belief at one moment."""

from __future__ import annotations

from typing import Any

from nesy.report import examples, figures
from nesy.report.html_pieces import figure
from nesy.run_folder import RunFolder

ANCHOR = "belief"
TITLE = "Belief and shifted belief"


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """One moment of the experience."""
    example = examples.belief_example(run)
    if example is None:
        return "<p>The person is never in view in the experience of this run.</p>"
    return figure(
        figures.belief_panel(example),
        "A moment of the experience: the robot sees the person, imagines walking to its pose with the learned "
        "model, and so estimates what the person believes. Orange triangle: the viewer; blue: the person.",
        "Heat maps of a belief and of the perspective-shifted belief, with what they decode to",
    )
