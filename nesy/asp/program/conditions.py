"""Conditions on codes as people write them: `X3=5`, `X3!=5`, a predicate, `not` a predicate; a comma means and.

Names with commas or spaces can be written in quotes, as in rules: `"a, b"`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal as OneOf

import numpy as np

from nesy.asp.program.names import TERM, decode
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

_PART = re.compile(r'(?:"(?:\\.|[^"\\])*"|[^,])+')
_LITERAL = re.compile(
    r"(?P<factor>.+?)\s*(?P<relation>!?=)\s*(?P<value>[0-9]+)|(?P<not>not\s+)?(?P<name>.+)", re.DOTALL
)


@dataclass(frozen=True)
class Literal:
    """One condition."""

    kind: OneOf["is", "isnt", "holds", "fails", "same"]
    """A factor has a value, or has not; a predicate holds, or does not; the code stays as it is."""
    factor: int = -1
    value: int = -1
    predicate: str = ""


def parse_literals(dbn: TwoSliceDBN, codebook: Codebook | None, text: str, conclusion: bool = False) -> list[Literal]:
    """Literals of a comma-separated text; empty for an empty text.

    Args:
        dbn: the model.
        codebook: knows the predicates; None if the model has none.
        text: the conditions.
        conclusion: whether `same` is allowed.

    Raises:
        UserError: a literal is none, or names an unknown factor, value or predicate.
    """
    literals = []
    for part in filter(None, (piece.strip() for piece in _PART.findall(text))):
        match = _LITERAL.fullmatch(part)
        assert match is not None
        predicates = () if codebook is None else codebook.predicate_names
        if match["factor"] is not None and _name(part) not in predicates:
            name, value = _name(match["factor"]), int(match["value"])
            if name not in dbn.factor_names and not (name.isdecimal() and int(name) < dbn.num_factors):
                raise UserError(f"'{part}': no factor '{name}'; the factors are {', '.join(dbn.factor_names)}")
            factor = dbn.factor_names.index(name) if name in dbn.factor_names else int(name)
            if value >= dbn.num_values:
                raise UserError(f"'{part}': the values of a factor are 0 to {dbn.num_values - 1}")
            literals.append(Literal("is" if match["relation"] == "=" else "isnt", factor=factor, value=value))
            continue
        fails = _name(part) not in predicates and bool(match["not"])
        name = _name(match["name"] if fails else part)
        if name == "same" and not fails and name not in predicates:
            if not conclusion:
                raise UserError("'same' says that the code does not change: it belongs into the conclusion")
            literals.append(Literal("same"))
        elif name not in predicates and not re.fullmatch(r"\w+", name):
            raise UserError(f"'{part}' is no condition; conditions are X3=5, X3!=5, a predicate, or not a predicate")
        else:
            if codebook is None:
                raise UserError(f"'{part}': this model has no codebook, so nothing is known about predicates")
            codebook.predicate(name)
            literals.append(Literal("fails" if fails else "holds", predicate=name))
    return literals


def _name(text: str) -> str:
    """A name as people write it, or in quotes as rules do: `"a, b"`."""
    return decode(text) if re.fullmatch(TERM, text) else text


def of_factor(literal: Literal, codes: np.ndarray) -> np.ndarray:
    """Where a literal about a factor (`is` or `isnt`) is true: bool [n] for codes integers [n, N]."""
    same = np.asarray(codes)[:, literal.factor] == literal.value
    return same if literal.kind == "is" else ~same
