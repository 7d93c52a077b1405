"""Properties of one step, checked over all codes at once: a counterexample, or a proof that there is none.

A property is `premise -> conclusion` about an action: "when a wall is ahead, moving forward changes nothing". Its
literals are `X3=5`, `X3!=5`, a predicate, `not` a predicate, and in the conclusion `same` (the code stays). A predicate
is read off the code by rules induced from the codebook (nesy.asp.semantics).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import clingo
import numpy as np

from nesy.asp.diagrams import diagram, diagram_facts
from nesy.asp.encoding import ENCODINGS
from nesy.asp.facts import LEAST, asp_name
from nesy.asp.rules import RuleSet, asp_rules
from nesy.asp.semantics import predicate_rules
from nesy.dbn.codebook import Codebook
from nesy.dbn.inference import ancestors
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

_LITERAL = re.compile(
    r"\s*(?:(?P<factor>\w+)\s*(?P<relation>!?=)\s*(?P<value>\d+)|(?P<not>not\s+)?(?P<name>[a-z]\w*))\s*$"
)


@dataclass(frozen=True)
class Literal:
    """One condition."""

    term: str
    """As an ASP term, see verify.lp."""
    factor: int | None = None
    predicate: str | None = None


@dataclass(frozen=True)
class Verdict:
    """Whether a property holds."""

    holds: bool
    """Whether no step breaks it."""
    code: tuple[int, ...]
    """Slice t of a step that breaks it; empty if it holds."""
    next_code: tuple[int, ...]
    """Slice t+1 of that step."""
    dropped: float
    """Values of a row less probable than `least` were taken as impossible: the largest mass a row lost by that."""
    least: float
    codes: str
    """Over which codes: `all`, or `met`."""
    rules: tuple[RuleSet, ...]
    """The rules by which predicates were read off the codes."""


def parse_literals(dbn: TwoSliceDBN, codebook: Codebook | None, text: str, conclusion: bool = False) -> list[Literal]:
    """Literals of a comma-separated text; empty for an empty text.

    Raises:
        UserError: a literal is none, or names an unknown factor, value or predicate.
    """
    literals = []
    for part in filter(None, (piece.strip() for piece in text.split(","))):
        match = _LITERAL.match(part)
        if match is None:
            raise UserError(f"'{part}' is no condition; conditions are X3=5, X3!=5, a predicate, or not a predicate")
        if match["factor"] is not None:
            name, value = match["factor"], int(match["value"])
            if name not in dbn.factor_names and not (name.isdecimal() and int(name) < dbn.num_factors):
                raise UserError(f"'{part}': no factor '{name}'; the factors are {', '.join(dbn.factor_names)}")
            factor = dbn.factor_names.index(name) if name in dbn.factor_names else int(name)
            if value >= dbn.num_values:
                raise UserError(f"'{part}': the values of a factor are 0 to {dbn.num_values - 1}")
            literals.append(Literal(f"{'is' if match['relation'] == '=' else 'isnt'}({factor},{value})", factor))
        elif match["name"] == "same" and not match["not"]:
            if not conclusion:
                raise UserError("'same' says that the code does not change: it belongs into the conclusion")
            literals.append(Literal("same"))
        else:
            if codebook is None:
                raise UserError(f"'{part}': this model has no codebook, so nothing is known about predicates")
            codebook.predicate(match["name"])
            kind = "fails" if match["not"] else "holds"
            literals.append(Literal(f"{kind}({asp_name(match['name'])})", predicate=match["name"]))
    return literals


def verify(
    dbn: TwoSliceDBN,
    codebook: Codebook | None,
    action: int,
    premise: str,
    conclusion: str,
    codes: str = "all",
    least: float = LEAST,
) -> Verdict:
    """Check a property of one step.

    Args:
        dbn: the model.
        codebook: what predicates mean; None if the property names none.
        action: the action.
        premise: literals about the code before, all of which hold.
        conclusion: literals about the code after, all of which must hold then.
        codes: `all` K^N codes, or those `met` in experience.
        least: values of a row less probable than this are taken as impossible.

    Raises:
        UserError: a literal is wrong, or `least` leaves a row without any value.
    """
    if codes not in ("all", "met"):
        raise UserError(f"codes '{codes}': a property is checked over all codes or over those met")
    if codes == "met" and (codebook is None or not len(codebook)):
        raise UserError("this model has no codebook, so it is not known which codes were met")
    before = parse_literals(dbn, codebook, premise)
    after = parse_literals(dbn, codebook, conclusion, conclusion=True)
    if not after:
        raise UserError("a property needs a conclusion")
    rules = {
        literal.predicate: predicate_rules(codebook, literal.predicate, held_out=0.0, num_values=dbn.num_values)
        for literal in (*before, *after)
        if literal.predicate is not None and codebook is not None
    }
    needed, used = _factors_that_matter(dbn, action, before, after, rules)
    lines = [f"value(0..{dbn.num_values - 1})."]
    lines += [f"factor({i})." for i in used] + [f"needed({i})." for i in needed]
    lines += [f"premise({literal.term})." for literal in before]
    lines += [f"conclusion({literal.term})." for literal in after]
    for name, found_rules in rules.items():
        lines.append(asp_rules(found_rules, f"means({asp_name(name)},0)", "at"))
        lines.append(asp_rules(found_rules, f"means({asp_name(name)},1)", "next"))
    known = codebook.distinct_codes()[0] if codes == "met" and codebook is not None else None
    dropped = 0.0
    for i in needed:
        found = diagram(dbn, action, i, least, None if known is None else _rows_of(dbn, action, i, known))
        lines += diagram_facts(dbn, action, i, found)
        dropped = max(dropped, found.dropped)
    if known is not None:
        lines += [f"code({c},{i},{code[i]})." for c, code in enumerate(known.tolist()) for i in used]
    found_codes = _solve("\n".join(lines), dbn.num_factors)
    first, later = found_codes or ((), ())
    return Verdict(not found_codes, first, later, dropped, least, codes, tuple(rules.values()))


def _factors_that_matter(
    dbn: TwoSliceDBN,
    action: int,
    before: Sequence[Literal],
    after: Sequence[Literal],
    rules: dict[str, RuleSet],
) -> tuple[list[int], list[int]]:
    """Factors of slice t+1 and of slice t that the property depends on."""

    def mentioned(literals: Sequence[Literal]) -> set[int]:
        found = {literal.factor for literal in literals if literal.factor is not None}
        for literal in literals:
            if literal.predicate is not None:
                found |= {f for rule in rules[literal.predicate].rules for f, _ in rule.conditions}
        return found

    goal = set(range(dbn.num_factors)) if any(literal.term == "same" for literal in after) else mentioned(after)
    needed = set(ancestors(dbn, action, tuple(goal)))
    used = {p for i in needed for p in dbn.parents_now[action][i]} | mentioned(before)
    if any(literal.term == "same" for literal in after):
        used |= goal
    return sorted(needed), sorted(used)


def _rows_of(dbn: TwoSliceDBN, action: int, factor: int, known: np.ndarray) -> np.ndarray:
    """Rows of one table that known codes can use: parents of slice t as there, those of slice t+1 any."""
    k = dbn.num_values
    later = len(dbn.parents_next[action][factor])
    row = np.zeros(len(known), dtype=np.int64)
    for p in dbn.parents_now[action][factor]:
        row = row * k + known[:, p]
    starts = np.unique(row) * k**later
    return (starts[:, None] + np.arange(k**later)).reshape(-1)


def _solve(facts: str, num_factors: int) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    control = clingo.Control(["--warn=none"])
    control.load(str(ENCODINGS / "transition.lp"))
    control.load(str(ENCODINGS / "verify.lp"))
    control.add("base", [], facts)
    control.ground([("base", [])])
    found: list[tuple[tuple[int, ...], tuple[int, ...]]] = []

    def remember(model: clingo.Model) -> None:
        codes = [[-1] * num_factors, [-1] * num_factors]
        for atom in model.symbols(shown=True):
            codes[atom.name == "next"][atom.arguments[0].number] = atom.arguments[1].number
        # factors that do not matter may have any value
        found.append((tuple(max(v, 0) for v in codes[0]), tuple(codes[1])))

    control.solve(on_model=remember)
    return found[0] if found else None
