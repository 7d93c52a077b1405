"""Figure 3 of the paper as PNG or SVG: `nesy show figure3`, with the number of moments and the seed to choose.

python scripts/figure3.py --run runs/demo --output figure3.png
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from nesy.report import figure3
from nesy.run_folder import RunFolder, atomic_path


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/default")
    """A run with a trained world model."""
    output: Path = Path("figure3.png")
    """The picture, .png or .svg."""
    moments: int = 6
    """Columns: moments with the person in view, of one episode each."""
    seed: int = 3
    """Seed of the episodes."""


def main(arguments: Arguments) -> None:
    """Play, then draw."""
    run = RunFolder.open(arguments.run)
    run.require("train")
    figure = figure3.draw(figure3.moments(run, arguments.moments, arguments.seed))
    with atomic_path(arguments.output) as temporary:
        figure.savefig(temporary, dpi=110)
    print(arguments.output)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
