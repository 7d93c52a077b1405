"""What the values of a factor look like, as small pictures of characters for the terminal."""

from __future__ import annotations

import numpy as np

from domains.core import GOAL, UNSEEN, WALL
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN

SHADES = " ░▒▓█"
"""Share of wall in a cell over the views that have the value, from none to all."""


def thumbnails(dbn: TwoSliceDBN, codebook: Codebook, factor: int) -> str:
    """The mean view of each value of a factor, side by side.

    Darker cells are walls in more of the views; `G` and `g`: the goal in most and in some; `?`: mostly unseen;
    `^`: the viewer, looking up.
    """
    pictures = []
    for value in range(dbn.num_values):
        chosen = codebook.codes[:, factor] == value
        number = int(chosen.sum())
        body = _picture(codebook.views[chosen]) if number else ["  none  ".center(2 * codebook.views.shape[1])]
        pictures.append([f"= {value}", f"{number} views", *body])
    height = max(len(picture) for picture in pictures)
    width = max(len(line) for picture in pictures for line in picture) + 2
    rows = ["".join((p[r] if r < len(p) else "").ljust(width) for p in pictures).rstrip() for r in range(height)]
    name = dbn.factor_names[factor]
    return "\n".join([f"{name}: what its values look like (darker: wall in more of the views)", *rows])


def _picture(views: np.ndarray) -> list[str]:
    size = views.shape[1]
    wall, goal, unseen = ((views == kind).mean(axis=0) for kind in (WALL, GOAL, UNSEEN))
    lines = []
    for y in range(size):
        cells = []
        for x in range(size):
            if (x, y) == (size // 2, size - 1):
                cells.append("^^")
            elif goal[x, y] >= 0.2:
                cells.append("GG" if goal[x, y] >= 0.6 else "gg")
            elif unseen[x, y] > 0.5:
                cells.append("??")
            else:
                cells.append(2 * SHADES[min(len(SHADES) - 1, round(float(wall[x, y]) * (len(SHADES) - 1)))])
        lines.append("".join(cells))
    return lines
