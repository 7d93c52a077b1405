"""The commands of README exist and take the options that it shows."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest

from nesy.cli.main import COMMANDS, parse

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMAND_LINES = re.findall(r"^\.venv/bin/nesy (.*?)\s*(?:#.*)?$", README, re.MULTILINE)


def test_readme_shows_commands() -> None:
    assert len(COMMAND_LINES) > 5


@pytest.mark.parametrize("line", COMMAND_LINES)
def test_command_line_of_readme(line: str) -> None:
    name, *arguments = shlex.split(line)
    assert name in COMMANDS
    parse(importlib.import_module(f"nesy.cli.{name}"), f"nesy {name}", arguments)


@pytest.mark.parametrize("target", re.findall(r"\]\(([^)#:]+)\)", README))
def test_links_of_readme_lead_somewhere(target: str) -> None:
    assert (ROOT / target).exists(), target


def test_make_targets_of_readme() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^make (\w+)", README, re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
