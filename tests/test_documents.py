"""README and docs: every command line parses, every code block runs, every link leads somewhere.

A block is run in a folder that holds a finished small run as runs/demo. A block that takes too long is marked in the
source by a comment that says why: `<!-- not run: REASON -->`. `<!-- file: NAME -->` saves a block under a name.
"""

from __future__ import annotations

import importlib
import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from nesy.cli.main import COMMANDS, main, parse

ROOT = Path(__file__).resolve().parent.parent
PAGES = ("README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")))
RUN_ELSEWHERE = {
    "docs/asp.md": "tests/nesy/asp/test_documentation.py",
    "docs/formats.md": "tests/nesy/formats/test_documentation.py",
    "docs/new-domain.md": "tests/domains/test_new_domain.py",
}
"""Pages whose blocks a test of their own runs, with more to say about what comes out."""
MOST_NOT_RUN = 6
_BLOCK = re.compile(r"((?:<!--[^\n]*-->\n)*)```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


class Block(NamedTuple):
    """One fenced block: its language, what it says, and its marks."""

    language: str
    text: str
    not_run: str
    file: str


def source(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(page: str) -> list[Block]:
    found = []
    for marks, language, text in _BLOCK.findall(source(page)):
        named = dict(re.findall(r"<!-- ([\w ]+): (.*?) -->", marks))
        found.append(Block(language, text, named.get("not run", ""), named.get("file", "")))
    return found


def command_lines() -> list[tuple[str, str]]:
    """Every `nesy` command of the pages, in blocks and in running text, but those with places to fill in."""
    found = []
    for page in PAGES:
        lines = [line for block in blocks(page) if block.language == "sh" for line in block.text.splitlines()]
        lines += re.findall(r"`((?:\.venv/bin/)?nesy [^`\n]*)`", re.sub(_BLOCK, "", source(page)))
        for line in lines:
            command = re.fullmatch(r"(?:\.venv/bin/)?nesy (\w.*?)\s*(?:#.*)?", line.strip())
            if command and not re.search(r"[\[\]|]|\.\.\.|(?<![\w.-])[A-Z]{2,}(?![\w.])", command[1]):
                found.append((page, command[1]))
    return list(dict.fromkeys(found))


@pytest.fixture
def workplace(run_copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder as the reader's: the run is runs/demo, the environment .venv."""
    folder = tmp_path / "workplace"
    (folder / "runs").mkdir(parents=True)
    shutil.move(run_copy, folder / "runs" / "demo")
    (folder / ".venv").symlink_to(ROOT / ".venv")
    (folder / "mine.lp").write_text("#show wide/1. wide(I) :- holds(I,goal_visible), seen(I,C), C > 3.\n")
    monkeypatch.chdir(folder)
    return folder


def run_shell(line: str) -> None:
    """One line of a block: a `nesy` command in this process, anything else in a shell."""
    command = re.fullmatch(r"(?:\.venv/bin/)?nesy (.*?)\s*(?:#.*)?", line)
    if command and not set("|>&;") & set(command[1]):
        assert main(shlex.split(command[1])) == 0, line
    else:
        subprocess.run(["bash", "-euc", line], check=True, timeout=120)


@pytest.mark.parametrize("page", [page for page in PAGES if page not in RUN_ELSEWHERE])
def test_blocks_run(page: str, workplace: Path) -> None:
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks(page):
        if block.not_run:
            continue
        if block.file:
            (workplace / block.file).write_text(block.text, encoding="utf-8")
        elif block.language == "sh":
            for line in block.text.replace("\\\n", " ").splitlines():
                if line.strip() and not line.startswith("#"):
                    run_shell(line.strip())
        elif block.language == "python":
            exec(compile(block.text, page, "exec"), names)
        else:
            assert block.language in ("text", "json", ""), f"{page}: who runs a block of '{block.language}'?"


def test_blocks_that_are_not_run_are_few_and_say_why() -> None:
    reasons = [block.not_run for page in PAGES for block in blocks(page) if block.not_run]
    assert len(reasons) <= MOST_NOT_RUN
    assert all(len(reason) > 20 for reason in reasons)


def test_pages_run_elsewhere_are_run_there() -> None:
    for page, test in RUN_ELSEWHERE.items():
        assert Path(page).name in (ROOT / test).read_text(encoding="utf-8")


def test_there_are_commands() -> None:
    assert len(command_lines()) > 15


@pytest.mark.parametrize(("page", "line"), command_lines())
def test_command_line_parses(page: str, line: str) -> None:
    name, *arguments = shlex.split(line)
    assert name in COMMANDS
    try:
        parse(importlib.import_module(f"nesy.cli.commands.{name}"), f"nesy {name}", arguments)
    except SystemExit as request:  # --help
        assert not request.code


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    for target in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", source(page)):
        assert ((ROOT / page).parent / target).exists(), target


def test_make_targets_of_readme() -> None:
    makefile = source("Makefile")
    for target in re.findall(r"^make (\w+)", source("README.md"), re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_the_page_of_commands_is_up_to_date(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from scripts.write_cli_docs import text

    monkeypatch.chdir(tmp_path)  # defaults do not come from a run that lies about
    assert source("docs/cli.md") == text(), "write it again: .venv/bin/python scripts/write_cli_docs.py"


def test_the_notebook_runs(workplace: Path) -> None:
    notebook = json.loads(source("docs/tutorial.ipynb"))
    names: dict[str, Any] = {}
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(cells) >= 5
    for number, cell in enumerate(cells):
        exec(compile(cell, f"cell {number}", "exec"), names)
    for cell in notebook["cells"]:
        assert not cell.get("outputs"), "the notebook is stored without outputs"
