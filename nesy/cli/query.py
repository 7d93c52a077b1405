"""Ask what factors and values mean, or run any ASP program over the model of a run.

Ready questions:
  --means 3=5             what does factor 3 = value 5 mean?
  --changes forward       which factors does the action change, and through which parents?
  --predicate wall_ahead  which values mean that the predicate holds?
  --vocabulary            which predicates and facts are there?
Your own: --program FILE (any ASP program over the facts), with --rules FILE ... as background knowledge.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from nesy.errors import UserError
from nesy.run_folder import RunFolder

if TYPE_CHECKING:
    from nesy.asp import Answer, KnowledgeBase


@dataclass(frozen=True)
class Arguments:
    """Options of `nesy query`."""

    run: Path = Path("runs/default")
    """The run folder."""
    means: str | None = None
    """FACTOR=VALUE: what the value means, in predicates and as a picture in characters."""
    changes: str | None = None
    """An action: which factors it changes, and which parents decide it."""
    predicate: str | None = None
    """A predicate: which values of which factors mean that it holds."""
    vocabulary: bool = False
    """List the predicates and the facts that programs can use."""
    program: Path | None = None
    """An ASP program to run over the facts of the model."""
    rules: tuple[Path, ...] = ()
    """Rule files added to the program."""
    time_limit: float = 10.0
    """Seconds after which a program is stopped."""
    models: int = 1
    """Most answer sets to show; 0 for all."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the result as one JSON object on standard output."""


def run(options: Arguments) -> dict[str, Any]:
    """Answer one question."""
    asked = [name for name in ("means", "changes", "predicate", "program") if getattr(options, name) is not None] + [
        "vocabulary"
    ] * options.vocabulary
    if len(asked) != 1:
        raise UserError(
            "ask one question: --means F=V, --changes ACTION, --predicate NAME, --vocabulary or --program FILE"
            + (f" (found {', '.join('--' + name for name in asked)})" if asked else "")
        )
    run_folder = RunFolder.open(options.run)
    run_folder.require("extract")
    from nesy.asp import KnowledgeBase

    knowledge = KnowledgeBase.from_run(run_folder.path)
    if options.means is not None:
        factor, value = _factor_and_value(options.means)
        return knowledge.means(factor, value).to_dict()
    if options.changes is not None:
        return knowledge.influenced(options.changes).to_dict()
    if options.predicate is not None:
        return knowledge.implies(options.predicate).to_dict()
    if options.vocabulary:
        return _vocabulary(knowledge)
    assert options.program is not None
    answer = knowledge.query(options.program, rules=options.rules, models=options.models, time_limit=options.time_limit)
    return {**answer.to_dict(), "text": _answer_text(answer)}


def _vocabulary(knowledge: KnowledgeBase) -> dict[str, Any]:
    from nesy.asp import VOCABULARY

    book = knowledge.codebook
    predicates = {} if book is None else dict(zip(book.predicate_names, book.predicate_meanings, strict=True))
    lines = []
    for title, words in (("Facts that a program can use:", VOCABULARY), ("Observable predicates P:", predicates)):
        width = max(map(len, words), default=0)
        lines += [title, *(f"  {name:{width}}  {meaning}" for name, meaning in words.items())]
    return {"facts": dict(VOCABULARY), "predicates": predicates, "text": "\n".join(lines)}


def _answer_text(answer: Answer) -> str:
    """The models, one per paragraph, and what is known about completeness."""
    lines = []
    for number, (atoms, cost) in enumerate(zip(answer.models, answer.costs, strict=True), start=1):
        suffix = f" (cost {' '.join(map(str, cost))})" if cost else ""
        lines += [f"Model {number}{suffix}:", *(f"  {atom}" for atom in atoms)]
    if answer.satisfiable is None:
        lines.append("No answer within the time limit.")
    elif not answer.satisfiable:
        lines.append("No model: the program is unsatisfiable.")
    elif not answer.exhausted:
        lines.append("There may be further models (--models 0 for all, --time-limit for longer).")
    if not answer.optimal:
        lines.append("Not proven optimal within the time limit.")
    if answer.dropped:
        lines.append(f"The facts leave out at most {answer.dropped:.2g} of a row's probability.")
    lines += [f"Note: {note}" for note in answer.notes]
    lines.append(f"{answer.seconds['total']:.3f} s")
    return "\n".join(lines)


def _factor_and_value(text: str) -> tuple[int, int]:
    factor, equals, value = text.partition("=")
    if not equals or not factor.strip().isdecimal() or not value.strip().isdecimal():
        raise UserError(f"--means {text}: expected FACTOR=VALUE, two numbers such as 3=5")
    return int(factor), int(value)


def show(result: dict[str, Any]) -> None:
    """Print the answer as text."""
    print(result["text"])
