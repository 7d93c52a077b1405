"""How the run was made."""

from __future__ import annotations

from typing import Any

from nesy.report.html_pieces import figures_table
from nesy.run_folder import RunFolder

ANCHOR = "provenance"
TITLE = "How it was made"


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """Settings, versions, machine and times."""
    made = {name: value for name, value in summary["provenance"].items() if name != "steps"}
    timing = {step: seconds for step, seconds in summary["timing"].items() if step != "report"}  # not known yet
    return figures_table(made, "Settings, versions and machine") + figures_table(
        timing, "Seconds per step of the pipeline, this page left out"
    )
