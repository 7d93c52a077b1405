"""Write the pictures of README from a run: python scripts/readme_images.py --run runs/demo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from nesy.errors import UserError
from nesy.report import examples, figures
from nesy.run_folder import RunFolder, atomic_path


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/demo")
    """The run folder."""
    to: Path = Path("docs/images")
    """Where the pictures go."""


def main(options: Arguments) -> None:
    """Write belief.svg."""
    example = examples.belief_example(RunFolder.open(options.run))
    if example is None:
        raise UserError(f"{options.run}: the person is never in view in the experience of this run")
    with atomic_path(options.to / "belief.svg") as temporary:
        temporary.write_text(figures.belief_panel(example), encoding="utf-8")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
