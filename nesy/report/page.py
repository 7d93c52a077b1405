"""report.html: one self-contained page, made from the run folder alone."""

from __future__ import annotations

import base64
import hashlib
import html
from importlib.resources import files
from pathlib import Path
from string import Template
from types import ModuleType
from typing import Any

from nesy.errors import UserError
from nesy.progress import SILENT, Progress
from nesy.report.sections import SECTIONS
from nesy.run_folder import RunFolder, atomic_path

SCRIPTS = ("ui.js", "graph.js", "replay.js", "start.js")


def write_report(run: RunFolder, progress: Progress = SILENT) -> Path:
    """Write report.html; every number on it comes from summary.json.

    Returns:
        The page's path.

    Raises:
        UserError: the run lacks a step, or a file of it is damaged.
    """
    run.require("collect", "train", "extract", "compare")
    summary = run.read_summary()
    sections, navigation = [], []
    with progress.task("report", len(SECTIONS)) as task:
        for section in SECTIONS:
            title = html.escape(section.TITLE)
            body = section_body(section, run, summary)
            sections.append(f'<section id="{section.ANCHOR}"><h2>{title}</h2>\n{body}\n</section>')
            navigation.append(f'<a href="#{section.ANCHOR}">{title}</a>')
            task.advance()
    made = summary.get("provenance", {})
    templates = files("nesy.report") / "templates"
    script = "\n".join(['"use strict";', *((templates / name).read_text(encoding="utf-8") for name in SCRIPTS)])
    page = Template((templates / "page.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(f"nesy run: {run.path.name}"),
        subtitle=html.escape(
            f"World {made.get('domain')}, variant {made.get('variant')}, preset {made.get('preset')}, "
            f"seed {made.get('seed')}."
        ),
        style=(templates / "style.css").read_text(encoding="utf-8"),
        navigation="\n".join(navigation),
        sections="\n".join(sections),
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        footer="Every number on this page is in summary.json beside it.",
    )
    with atomic_path(run.report) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return run.report


def section_body(section: ModuleType, run: RunFolder, summary: dict[str, Any]) -> str:
    """HTML of one section.

    Raises:
        UserError: what the section is made from is missing or damaged.
    """
    try:
        return str(section.make(run, summary))
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(
            f"{run.path}: the section '{section.TITLE}' of the report cannot be made from summary.json and the results "
            f"({type(error).__name__}: {str(error)[:200]}); make them again with: nesy compare --run {run.path} --redo"
        ) from error
