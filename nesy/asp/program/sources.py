"""ASP programs as text from strangers: read, checked and freed of directives that reach outside.

No script blocks; `#include "file"` only for files inside the folder of the file that asks for it (they are
read here, so the solver itself never opens a file of the user's choosing).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nesy.errors import UserError

Programs = str | Path | Sequence[str | Path]
"""One program or several: a `Path` is a file, a `str` is the text itself."""

MAX_CHARACTERS = 10_000_000

_TOKENS = re.compile(
    r"""
    (?P<block>%\*)                       # a comment over several lines, closed by *%, may nest
  | (?P<comment>%[^\n]*)
  | (?P<string>"(?:\\.|[^"\\\n])*")
  | (?P<include>\#\s*include\b)
  | (?P<script>\#\s*script\b)
    """,
    re.VERBOSE,
)
_INCLUDED = re.compile(r'\s*"((?:\\.|[^"\\\n])*)"\s*\.')


@dataclass(frozen=True)
class Source:
    """One program text; `name` is what error messages call it."""

    name: str
    text: str


def listed(programs: Programs) -> list[str | Path]:
    """Programs as a list, where one may be given by itself."""
    return [programs] if isinstance(programs, str | Path) else list(programs)


def read_sources(programs: Programs) -> list[Source]:
    """All program texts that `programs` consist of, included files among them.

    Args:
        programs: one or several; a `Path` is read as a file, a `str` is program text itself.

    Raises:
        UserError: a file is missing or no UTF-8 text, or a program has a script block or reaches outside.
    """
    found: list[Source] = []
    seen: set[Path] = set()
    for number, program in enumerate(listed(programs), 1):
        if isinstance(program, Path):
            _add_file(program, program.resolve().parent, found, seen)
        elif program.endswith(".lp") and "\n" not in program:
            raise UserError(f"'{program}' is taken for program text; name a file as Path({program!r})")
        else:
            name = "program" if number == 1 else f"program {number}"
            _add(Source(name, program), None, found, seen)
    return found


def _add_file(path: Path, root: Path, found: list[Source], seen: set[Path]) -> None:
    resolved = path.resolve()
    if resolved in seen:
        return
    seen.add(resolved)
    if len(seen) > 100:
        raise UserError(f"{path}: more than 100 rule files in one program")
    _add(Source(str(path), read_text(path)), root, found, seen)


def read_text(path: Path) -> str:
    """The text of a rule file.

    Raises:
        UserError: it is missing, too long, or no UTF-8 text.
    """
    try:
        if path.stat().st_size > MAX_CHARACTERS:
            raise UserError(f"{path}: longer than {MAX_CHARACTERS} bytes, which no rule file should be")
        content = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise UserError(f"{path}:{line}: not UTF-8 text (byte 0x{content[error.start]:02x})") from None


def _add(source: Source, root: Path | None, found: list[Source], seen: set[Path]) -> None:
    text = source.text
    if len(text) > MAX_CHARACTERS:
        raise UserError(f"{source.name}: longer than {MAX_CHARACTERS} characters, which no program should be")
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise UserError(f"{source.name}:{line}: holds a NUL character")
    pieces: list[str] = []
    position = 0
    while (match := _TOKENS.search(text, position)) is not None:
        pieces.append(text[position : match.start()])
        end = match.end()
        if match["string"]:
            pieces.append(match[0])
        elif match["script"]:
            where = _position(text, match.start())
            raise UserError(f"{source.name}:{where}: script blocks are not allowed in rule files")
        else:
            if match["block"]:
                end = _end_of_comment(source, match)
            elif match["include"]:
                end = _include(source, root, match, found, seen)
            # blanked, not cut out, so that lines and columns stay
            pieces.append(re.sub(r"[^\n]", " ", text[match.start() : end]))
        position = end
    pieces.append(text[position:])
    found.append(Source(source.name, "".join(pieces)))


def _end_of_comment(source: Source, start: re.Match[str]) -> int:
    depth, position = 1, start.end()
    while depth:
        mark = re.compile(r"%\*|\*%").search(source.text, position)
        if mark is None:
            where = _position(source.text, start.start())
            raise UserError(f"{source.name}:{where}: a comment %* is not closed by *%")
        depth += 1 if mark[0] == "%*" else -1
        position = mark.end()
    return position


def _include(source: Source, root: Path | None, directive: re.Match[str], found: list[Source], seen: set[Path]) -> int:
    where = f"{source.name}:{_position(source.text, directive.start())}"
    target = _INCLUDED.match(source.text, directive.end())
    if target is None:
        raise UserError(f'{where}: only #include "file". is allowed, for a file in the same folder')
    if root is None:
        raise UserError(f"{where}: #include works in rule files only; pass the file itself instead")
    path = Path(source.name).parent / target[1]
    if not path.resolve().is_relative_to(root):
        raise UserError(f"{where}: #include of a file outside {root} is not allowed")
    if not path.is_file():
        raise UserError(f"{where}: {path}: no such file")
    _add_file(path, root, found, seen)
    return target.end()


def _position(text: str, offset: int) -> str:
    line_start = text.rfind("\n", 0, offset) + 1
    return f"{text.count(chr(10), 0, offset) + 1}:{offset - line_start + 1}"
