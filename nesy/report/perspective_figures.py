"""Plots of how good the perspective shift is, from the section `perspective` of summary.json."""

from __future__ import annotations

from typing import Any

import matplotlib

from nesy.report.figures import PALETTE, svg

matplotlib.use("Agg")

from matplotlib import pyplot as plt

NAMES = {"shift": "perspective shift", "best": "best possible", "random": "random"}
_GROUPS = {"by_steps": "imagined actions", "by_distance": "distance of the person, cells"}
_SCORES = {"exact": "views exact", "kl": "KL, nats"}


def by_steps_and_distance(perspective: dict[str, Any]) -> str:
    """Exact views and KL by imagined actions and by distance: the shift, the best possible, and random."""
    figure, grid = plt.subplots(len(_SCORES), len(_GROUPS), figsize=(9, 5.4), sharey="row", squeeze=False)
    for column, (group, title) in enumerate(_GROUPS.items()):
        entries = sorted((int(value), entry) for value, entry in perspective[group].items())
        for row, (score, label) in enumerate(_SCORES.items()):
            axes = grid[row, column]
            for colour, (name, text) in zip(PALETTE, NAMES.items(), strict=False):
                if name in perspective:
                    points = [(value, entry[name][score]) for value, entry in entries]
                    axes.plot(*zip(*points, strict=True), "o-", color=colour, label=text, markersize=4)
            axes.grid(alpha=0.3)
            axes.set_ylim(bottom=0)
            axes.set_xlabel(title)
            if column == 0:
                axes.set_ylabel(label)
    grid[0, 0].legend(fontsize=8)
    figure.tight_layout()
    return svg(figure)
