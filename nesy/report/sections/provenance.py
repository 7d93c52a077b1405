"""How the run was made."""

from __future__ import annotations

from typing import Any

from nesy.report.html_pieces import figures_table
from nesy.run_folder import RunFolder

ANCHOR = "provenance"
TITLE = "How it was made"


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """Settings, versions, machine and times."""
    return figures_table(summary["provenance"], "Settings, versions and machine") + figures_table(
        summary["timing"], "Seconds per step of the pipeline"
    )
