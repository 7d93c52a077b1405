"""Run every question, command and program of docs/asp.md on a run, and show the answers.

    python scripts/worked_questions.py --run runs/demo

Commands that need more of the run than is there (the comparison's agents) are left out, and that is said.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

from nesy.asp import KnowledgeBase
from nesy.cli.main import main as nesy
from nesy.errors import UserError
from nesy.run_folder import RunFolder

DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "asp.md"
BLOCK = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NAMED = "runs/demo"
"""The run that the document names."""


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/default")
    """The run folder."""


def main() -> None:
    """Run everything; the first failure ends it."""
    options = tyro.cli(Arguments, description=__doc__)
    count = work_through(options.run.resolve())
    print(f"\n{count} questions, commands and programs of {DOCUMENT.name} ran on {options.run}")


def work_through(folder: Path) -> int:
    """Run all blocks on a run folder; how many there were.

    Raises:
        UserError: a command failed, or a program has no answer.
    """
    run = RunFolder.open(folder)
    names: dict[str, object] = {}
    count = 0
    with _rules_here():
        for language, remark, text in BLOCK.findall(DOCUMENT.read_text(encoding="utf-8")):
            needed = remark.removeprefix(" needs ").split() if remark.startswith(" needs ") else []
            if language == "sh" and not all(run.has(step) for step in needed):
                print(f"# left out, needs {', '.join(needed)}: {text.strip()}")
            elif language == "sh":
                for line in text.strip().splitlines():
                    count += 1
                    _command(line, folder)
            elif language == "python":
                count += 1
                print(f">>> {text}")
                exec(compile(text.replace(NAMED, str(folder)), str(DOCUMENT), "exec"), names)
            elif language == "lp":
                count += 1
                print(f"% {text}")
                answer = KnowledgeBase.from_run(folder).query(text)
                if not answer.models or answer.notes:
                    raise UserError(f"no answer to the program {text}: {answer}")
                print(answer.models[0][:20])
    return count


def _command(line: str, folder: Path) -> None:
    print(f"$ {line}")
    words = [str(folder) if word == NAMED else word for word in shlex.split(line)]
    if words[0] != "nesy" or nesy(words[1:]) != 0:
        raise UserError(f"this command of {DOCUMENT.name} failed: {line}")


@contextlib.contextmanager
def _rules_here() -> Iterator[None]:
    """A folder with the document's rules.lp, to work in."""
    rules = "".join(text for language, _, text in BLOCK.findall(DOCUMENT.read_text("utf-8")) if language == "rules")
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "rules.lp").write_text(rules, encoding="utf-8")
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(before)


if __name__ == "__main__":
    main()
