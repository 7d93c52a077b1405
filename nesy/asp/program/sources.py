"""ASP programs as text from strangers: read, checked and freed of directives that reach outside.

No script blocks; `#include "file"` only for files inside the folder of the file that asks for it (they are
read here, so the solver itself never opens a file of the user's choosing). Every program passes through here before
clingo sees it, which ends the process at a character that it does not know, and at terms nested some ten thousand deep.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nesy.errors import UserError

Programs = str | Path | Sequence[str | Path]
"""One program or several: a `Path` is a file, a `str` is the text itself."""

MAX_CHARACTERS = 10_000_000

MAX_DEPTH = 1000
"""Deepest nesting of terms: brackets, and operators in a row."""
MAX_NUMBER = 2**31 - 1
"""clingo counts in 32 bits, and takes greater numbers for others without a word."""

_STRING = r'"(?:\\["\\n]|[^"\\\n])*"'
_TOKENS = re.compile(
    rf"""
    (?P<block>%\*)                       # a comment over several lines, closed by *%, may nest
  | (?P<comment>%[^\n]*)
  | (?P<string>{_STRING})
  | (?P<quote>")
  | (?P<include>\#\s*include\b)
  | (?P<script>\#\s*script\b)
  | (?<![A-Za-z0-9_'])(?P<number>[0-9]{{10,}}|0x[0-9a-fA-F]{{8,}}|0o[0-7]{{11,}}|0b[01]{{32,}})
  | (?P<foreign>[^\t\n\r\x20-\x7e])
    """,
    re.VERBOSE,
)
_LOOKALIKES = dict.fromkeys("\u201c\u201d\u201e\u201f\u00ab\u00bb", '"') | dict.fromkeys("\u2018\u2019", "'")
_LOOKALIKES |= dict.fromkeys("\u2010\u2011\u2012\u2013\u2014\u2212", "-")
_NESTING = re.compile(rf"{_STRING}|\.\.|[()\[\]{{}},;:.]|[-+*/\\?&^~|<>=!]")
_INCLUDED = re.compile(r'\s*"((?:\\.|[^"\\\n])*)"\s*\.')


@dataclass(frozen=True)
class Source:
    """One program text; `name` is what error messages call it."""

    name: str
    text: str
    own: bool = False
    """Whether it is one of our own encodings."""

    def column(self, line: int, column: int) -> int:
        """The column in characters of one that clingo counts in bytes; both from 1."""
        lines = self.text.split("\n", line)
        begin = lines[line - 1].encode()[: column - 1] if 1 <= line <= len(lines) else b""
        return len(begin.decode(errors="ignore")) + 1 if begin else column


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
        before = content[: error.start]
        line, column = before.count(b"\n") + 1, len(before[before.rfind(b"\n") + 1 :].decode("utf-8")) + 1
        utf16 = "; it looks like UTF-16" if content.startswith((b"\xff\xfe", b"\xfe\xff")) else ""
        wrong = f"not UTF-8 text (byte 0x{content[error.start]:02x}{utf16}); save it as UTF-8"
        raise UserError(f"{path}:{line}:{column}: {wrong}") from None


def _add(source: Source, root: Path | None, found: list[Source], seen: set[Path]) -> None:
    source = Source(source.name, source.text.removeprefix("\ufeff"))  # a byte order mark
    text = source.text
    if len(text) > MAX_CHARACTERS:
        raise UserError(f"{source.name}: longer than {MAX_CHARACTERS} characters, which no program should be")
    if (unwritten := re.search("[\0\ud800-\udfff]", text)) is not None:
        what = "a NUL character" if unwritten[0] == "\0" else f"a lone surrogate ({_called(unwritten[0])})"
        raise UserError(f"{source.name}:{_position(text, unwritten.start())}: holds {what}")
    pieces: list[str] = []
    position = 0
    while (match := _TOKENS.search(text, position)) is not None:
        pieces.append(text[position : match.start()])
        end = match.end()
        if match["string"] or (match["number"] and _in_range(match[0])):
            pieces.append(match[0])
        elif (wrong := _wrong(match)) is not None:
            raise UserError(f"{source.name}:{_position(text, match.start())}: {wrong}")
        else:
            if match["block"]:
                end = _end_of_comment(source, match)
            elif match["include"]:
                end = _include(source, root, match, found, seen)
            # blanked, not cut out, so that lines and columns stay
            pieces.append(re.sub(r"[^\n]", " ", text[match.start() : end]))
        position = end
    pieces.append(text[position:])
    checked = "".join(pieces)
    if (deep := _too_deep(checked)) is not None:
        where = _position(checked, deep)
        raise UserError(f"{source.name}:{where}: nested more than {MAX_DEPTH} deep (brackets and operators in a row)")
    found.append(Source(source.name, checked))


def _wrong(token: re.Match[str]) -> str | None:
    """Why a token cannot stand in a program; None where it can."""
    if token["script"]:
        return "script blocks are not allowed in rule files"
    if token["quote"]:
        return r"a string is not closed on its line, or has another \ than in \", \\ and \n"
    if token["number"]:
        return f"{token[0][:40]} is too large: numbers are at most {MAX_NUMBER} (clingo counts in 32 bits)"
    if token["foreign"]:
        meant = _LOOKALIKES.get(token[0]) or (" " if unicodedata.category(token[0]) == "Zs" else "")
        hint = f"; is {meant!r} meant?" if meant else ""
        return f"{_called(token[0])} can stand in strings and comments only{hint}"
    return None


def _in_range(number: str) -> bool:
    """Whether clingo can count so far; Python refuses to read decimal numbers of thousands of digits."""
    digits = number.lstrip("0")
    return (
        int(number, 0) <= MAX_NUMBER if number[1:2].isalpha() else len(digits) <= 10 and int(digits or 0) <= MAX_NUMBER
    )


def _called(character: str) -> str:
    name = unicodedata.name(character, "")
    shown = f"'{character}' " if character.isprintable() else ""
    return f"{shown}U+{ord(character):04X}" + (f" {name}" if name else "")


def _too_deep(text: str) -> int | None:
    """Where terms are nested deeper than `MAX_DEPTH`; None if nowhere."""
    if sum(map(text.count, "([{-+*/\\?&^~|<>=!")) + text.count("..") <= MAX_DEPTH:
        return None
    levels, depth = [0], 0  # operators since the last comma, at each level of brackets
    for match in _NESTING.finditer(text):
        token = match[0]
        if token in "([{":
            levels.append(0)
            depth += 1
        elif token in ")]}":
            if len(levels) > 1:
                depth -= 1 + levels.pop()
        elif token in ",;:.":
            depth -= levels[-1]
            levels[-1] = 0
        elif token[0] != '"':
            levels[-1] += 1
            depth += 1
        if depth > MAX_DEPTH:
            return match.start()
    return None


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
