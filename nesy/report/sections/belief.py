"""Belief and shifted belief: moments of episodes, and how near the shifted belief comes to the truth."""

from __future__ import annotations

from typing import Any

from nesy.errors import UserError
from nesy.report import figure3, figures, perspective_figures
from nesy.report.html_pieces import figure, table
from nesy.report.text import number
from nesy.run_folder import RunFolder

ANCHOR = "belief"
TITLE = "Belief and shifted belief"
MOMENTS = 5
_SCORES = {
    "exact": "views exact",
    "cells": "cells",
    "cells_seen": "cells that the robot sees",
    "cells_unseen": "cells that it cannot know",
    "factors": "factors",
    "kl": "KL, nats",
}


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """Figure 3, the table and the plots."""
    try:
        moments = figure3.moments(run, MOMENTS)
    except UserError:
        return "<p>The person is never in view with a way to it in the episodes looked at.</p>"
    picture = figure(
        figures.svg(figure3.draw(moments)),
        "Moments of several episodes, each the first with three or more imagined actions. The robot (orange) sees the "
        "person (blue), imagines walking to its pose (pink) with the learned model, and so estimates what the person "
        "believes. Crosses: cells rebuilt otherwise than they are. L, R, F: imagined actions.",
        "Maps, views, beliefs, imagined walks, shifted beliefs and what they decode to, one column per moment",
    )
    return picture + _scores(summary.get("perspective", {}))


def _scores(perspective: dict[str, Any]) -> str:
    if not perspective:
        return ""
    names = [name for name in perspective_figures.NAMES if name in perspective]
    rows = [[text, *(number(perspective[name][score]) for name in names)] for score, text in _SCORES.items()]
    caption = (
        f"The shifted belief (planner {perspective['planner']}) against the person's true view, on "
        f"{perspective['situations']:,} situations of {perspective['on']}. For {100 * perspective['reachable']:.1f} % "
        "the own view shows a way to the person; the others have the uniform belief and are left out. Best possible: "
        "the posterior over true views given the own view and the configuration."
    )
    columns = ("", *(perspective_figures.NAMES[name] for name in names))
    plots = figure(
        perspective_figures.by_steps_and_distance(perspective),
        "Share of views exact, and KL from the shifted belief to the code of the true view, by imagined actions and "
        "by distance.",
        "Four line plots: views exact and KL, by imagined actions and by distance",
    )
    return table(columns, rows, caption) + plots
