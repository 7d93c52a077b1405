"""Text and tokens of `.pomdp` files.

A token is a colon, or what stands between white space and colons; so names may hold more characters than the format
grants them. Where a token is no name and no number it is taken apart as pomdp-solve's scanner would (`*-5`). A sign
is a token of its own or the beginning of a number. `#` begins a comment.
"""

from __future__ import annotations

import codecs
import re

import numpy as np

from nesy.errors import UserError

LARGEST = 50_000_000
"""Entries of a table that a file may name at once."""

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_TOKEN = re.compile(r":|[^\s:]+")
_GLUED = re.compile(r"[A-Za-z][\w-]*|\d+(?:\.\d*)?(?:[eE][+-]?\d+)?|[*+-]")  # what pomdp-solve's scanner knows


def decoded(data: bytes) -> str:
    """Text in UTF-8, or in UTF-16 with its mark; comments of old files may be in Latin-1."""
    try:
        text = data.decode("utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n")


class Scanner:
    """Tokens of a text with their lines, a line at a time; the next token is the last one of the stack."""

    def __init__(self, text: str, name: str) -> None:
        self.name, self.line = name, 1
        self._rest = enumerate(text.split("\n"), 1)
        self._tokens: list[str] = []
        self._lines: list[int] = []

    def fail(self, message: str) -> UserError:
        """The error of the token taken last."""
        return UserError(f"{self.name}, line {self.line}: {message}")

    def peek(self, ahead: int = 0) -> str | None:
        """A token to come; None behind the end."""
        while len(self._tokens) <= ahead:
            for number, line in self._rest:
                found = _TOKEN.findall(line.partition("#")[0])
                if found:
                    self._tokens = found[::-1] + self._tokens
                    self._lines = [number] * len(found) + self._lines
                    break
            else:
                return None
        return self._tokens[-1 - ahead]

    def take(self) -> str:
        """The next token."""
        if not self._tokens and self.peek() is None:
            raise self.fail("the file ends in the middle of an entry")
        self.line = self._lines.pop()
        return self._tokens.pop()

    def split(self, token: str) -> bool:
        """Puts a token taken back as the several that pomdp-solve sees in it (`*-5`); False where it sees none."""
        parts = _GLUED.findall(token)
        if len(parts) < 2 or "".join(parts) != token:
            return False
        self._tokens += parts[::-1]
        self._lines += [self.line] * len(parts)
        return True

    def colon(self) -> None:
        """Takes a colon."""
        if (token := self.take()) != ":":
            raise self.fail(f"expected ':', found '{token}'")

    def number(self) -> float:
        """A number; its sign may stand apart."""
        token = self.take()
        sign = token if token in ("+", "-") else ""
        if sign:
            token = self.take()
        if not (sign and token[0] in "+-"):
            if NUMBER.fullmatch(token) and np.isfinite(value := float(sign + token)):
                return value
            if self.split(token):
                return float(f"{sign}1") * self.number()
        raise self.fail(f"expected a number, found '{token}'")

    def numbers(self, count: int) -> np.ndarray:
        """As many numbers: float64 [count]."""
        if count > LARGEST:
            raise self.fail(f"a table of {count} numbers is too large")
        out, filled = np.empty(count), 0
        while filled < count:
            self.peek()
            some = max(1, min(count - filled, len(self._tokens)))
            try:
                out[filled : filled + some] = list(map(float, tokens := self._tokens[: -some - 1 : -1]))
                plain = bool(tokens) and np.isfinite(out[filled : filled + some]).all() and "_" not in "".join(tokens)
            except ValueError:
                plain = False
            if plain:
                self.line = self._lines[-some]
                del self._tokens[-some:], self._lines[-some:]
            else:
                out[filled : filled + some] = [self.number() for _ in range(some)]
            filled += some
        return out
