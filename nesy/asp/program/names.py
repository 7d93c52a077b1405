"""Names as ASP terms: a constant where clingo takes the name as one, a string otherwise (`"Go left"`)."""

from __future__ import annotations

import re

from nesy.names import TEXT

_CONSTANT = re.compile(r"_*[a-z][A-Za-z0-9_]*")
TERM = r'(?:"(?:\\.|[^"\\])*"|\w+)'
"""A regular expression for what `encode` makes of a name."""


def encode(name: str) -> str:
    """A name as an ASP term; different names stay different terms."""
    if _CONSTANT.fullmatch(name) and name != "not":
        return name
    return '"' + TEXT.encode(name).replace("\\", "\\\\").replace('"', '\\"') + '"'


def decode(term: str) -> str:
    """The name that `encode` made a term of."""
    return TEXT.decode(re.sub(r"\\(.)", r"\1", term[1:-1])) if term.startswith('"') else term
