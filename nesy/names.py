r"""Names in files for other programs: any name becomes one that the format takes, and no two become the same.

A name that a format takes as it is stays as it is. Elsewhere a character is written as `_x20`, `_u20ac` or `_w01f600`
(its code point in hexadecimal, two, four or six digits), as Python writes `\x20`: "go left" becomes `go_x20left`.
Where that would begin with `_` in a format that wants a letter, an `n` goes before it. `decode` undoes all of this, so
that a name is known again from the file alone: "go-left" and "go left", "N" and "n" in a format that knows no case,
`init` where that is a word of the format, and `go_x20left` itself all get names of their own.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

_ESCAPE = r"_(?:x[0-9a-f]{2}|u[0-9a-f]{4}|w[0-9a-f]{6})"
_MARKED = re.compile(f"n(?={_ESCAPE})")
EMPTY = "n_empty"
"""What a name without any character becomes."""
PRINTED = "[^\\x00-\\x1f\\x7f-\\x9f\\u2028\\u2029\\ud800-\\udfff\\ufffe\\uffff]"
"""Not the characters that text files do not hold, or that end a line in them."""


@dataclass(frozen=True)
class Grammar:
    """What a format takes as a name. Digits, lower-case letters and `_` are allowed after the first character."""

    first: str = "[A-Za-z]"
    """Characters that a name may begin with, as a regular expression."""
    others: str = "[A-Za-z0-9_]"
    """Characters that may follow. Without `A-Z`, for formats that know no case, capitals are escaped."""
    never: str = ""
    """A regular expression for one character that may not stand where it stands (with what is around it)."""
    reserved: frozenset[str] = frozenset()
    """Words of the format, and names that the file has for things of its own."""
    prefix: str = ""
    """What every name in the file begins with."""
    suffix: str = ""
    """A regular expression for what may follow a name in the file; no name ends like that."""

    @cached_property
    def _barred(self) -> re.Pattern[str]:
        """Each match is one character that has to be escaped."""
        words = "|".join(map(re.escape, sorted(self.reserved | {EMPTY})))
        parts = [rf"\A(?!{self.first}).", f"(?!{self.others}).", f"_(?={_ESCAPE[1:]})", rf"\A(?=(?:{words})\Z)."]
        return re.compile("|".join([*parts, *filter(None, [self.never])]), re.DOTALL)

    def encode(self, name: str) -> str:
        """The name as the format takes it; different names stay different."""
        text = self._barred.sub(lambda match: _escaped(match[0]), name) or EMPTY
        if _MARKED.match(text):
            text = _escaped("n") + text[1:]
        return self.prefix + (text if re.match(self.first, text) else "n" + text)

    def decode(self, text: str) -> str:
        """The name that `encode` made `text` of, with or without what the file lets follow it."""
        text = text.removeprefix(self.prefix)
        if self.suffix:
            text = re.sub(rf"(?:{self.suffix})\Z", "", text)
        if text == EMPTY:
            return ""
        plain = text[1:] if _MARKED.match(text) else text
        return re.sub(_ESCAPE, lambda match: chr(int(match[0][2:], 16)), plain)


def _escaped(character: str) -> str:
    point = ord(character)
    return f"_x{point:02x}" if point < 0x100 else f"_u{point:04x}" if point < 0x10000 else f"_w{point:06x}"


TEXT = Grammar(first=PRINTED, others=PRINTED)
"""Text on one line: GraphML, labels in DOT, strings in ASP."""
SLICED = Grammar(first=PRINTED, others=PRINTED, never=r"'(?=\Z)", suffix="'")
"""The same where a stroke after a name marks slice t+1."""

ASCII = Grammar(first="[ -~]", others="[ -~]")
"""Comments, which some programs read in the encoding of the machine."""


def remarks(names: Iterable[tuple[str, str]], mark: str) -> list[str]:
    """Comments `mark NAME IN THE FILE: NAME`; ASCII.decode gives the name as it was."""
    return [f"{mark} {written}: {ASCII.encode(name)}" for written, name in names]


def sliced(name: str, later: int | bool) -> str:
    """The name of a factor in slice t, or with a stroke in slice t+1; no two factors get the same."""
    return SLICED.encode(name) + ("'" if later else "")
