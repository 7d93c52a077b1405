"""Writes docs/cli.md from the commands' own option classes.

    .venv/bin/python scripts/write_cli_docs.py

Names, types, default values and descriptions are those that `nesy COMMAND --help` shows.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import sys
import textwrap
import typing
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from nesy.cli.main import COMMANDS

TARGET = Path(__file__).parents[1] / "docs" / "cli.md"
HEAD = """# Commands

Written by `scripts/write_cli_docs.py` from the code; do not edit. `nesy COMMAND --help` says the same.

Every command takes `--json` (one JSON object on standard output, everything else on standard error). Exit status: 0 \
done, 1 a bug of ours, 2 a mistake of the caller's in one clear line, 130 interrupted. Every step of the pipeline can \
be interrupted and goes on where it stopped when called again.
"""


def text() -> str:
    """The whole page."""
    return HEAD + "".join(_command(name, summary) for name, summary in COMMANDS.items())


def _command(name: str, summary: str) -> str:
    module = importlib.import_module(f"nesy.cli.commands.{name}")
    description = inspect.cleandoc(module.__doc__ or "")
    default = module.defaults([]) if hasattr(module, "defaults") else module.Arguments()
    first, _, rest = description.partition("\n\n")
    parts = [f"\n## nesy {name}\n\n{first if rest else description}\n"]
    if rest:
        parts.append(f"\n```text\n{rest}\n```\n")
    parts.append("\n| option | default | meaning |\n| --- | --- | --- |\n")
    parts += [f"| `{option}` | {value} | {meaning} |\n" for option, value, meaning in _options(default, "")]
    return "".join(parts)


def _options(value: Any, prefix: str) -> list[tuple[str, str, str]]:
    """(option, default, meaning) of every field, those of nested classes with their name in front."""
    kinds, meanings = typing.get_type_hints(type(value), include_extras=True), _meanings(type(value))
    rows = []
    for field in dataclasses.fields(value):
        item, option = getattr(value, field.name), field.name.replace("_", "-")
        if dataclasses.is_dataclass(item):
            # a section without a name of its own hands its options up
            nameless = any(
                getattr(extra, "name", None) == "" for extra in getattr(kinds[field.name], "__metadata__", ())
            )
            rows += _options(item, prefix if nameless else f"{prefix}{option}.")
            continue
        shown = option.upper() if "Positional" in str(kinds[field.name]) else f"--{prefix}{option}"
        help_text = next((extra.help for extra in getattr(kinds[field.name], "__metadata__", ())
                          if getattr(extra, "help", None)), "")  # fmt: skip
        meaning = meanings.get(field.name) or help_text
        rows.append((shown, _shown(item), meaning.replace("|", "\\|")))
    return rows


def _meanings(kind: type) -> dict[str, str]:
    """The text under every field of a class, those of its bases included."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(body, ast.ClassDef)
        for field, below in zip(body.body, body.body[1:], strict=False):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(below, ast.Expr)
                and isinstance(below.value, ast.Constant)
            ):
                assert isinstance(field.target, ast.Name)
                found[field.target.id] = " ".join(str(below.value.value).split())
    return found


def _shown(value: Any) -> str:
    if value is None or value == () or value == "":
        return ""
    if isinstance(value, tuple):
        return f"`{' '.join(map(str, value))}`"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"`{value}`"


if __name__ == "__main__":
    TARGET.write_text(text(), encoding="utf-8")
    print(TARGET)
