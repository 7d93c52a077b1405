"""Ask what factors and values mean, verify, plan, explain; or run any ASP program over the model of a run.

Ready questions, one per call:
  --means 3=5             what does factor 3 = value 5 mean?
  --changes forward       which factors does the action change, and through which parents?
  --predicate wall_ahead  which values mean that the predicate holds?
  --when wall_ahead       which rules over values say when it holds, and how well on views not used for them?
  --verify forward --premise wall_ahead --conclusion same     does this follow, over ALL codes?
  --plan goal_ahead --start 17        the shortest plan from a view (by number) or a code (3,0,...) to a goal
  --after left forward --start 17     what must, can and cannot hold after these actions?
  --explain forward --start 17        why does the action lead where it most probably leads?
  --vocabulary            which predicates and facts are there?
Your own: --program FILE (any ASP program over the facts), with --rules FILE ... as background knowledge.
"""

from __future__ import annotations

from collections.abc import Callable
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
    """FACTOR=VALUE: what the value means, in predicates."""
    changes: str | None = None
    """An action: which factors it changes, and which parents decide it."""
    predicate: str | None = None
    """A predicate: which values of which factors mean that it holds."""
    when: str | None = None
    """A predicate: the rules over values that say when it holds, with precision and recall."""
    verify: str | None = None
    """An action: whether --conclusion holds after every possible step of it from a code with --premise."""
    premise: str = ""
    """Conditions before the step, comma-separated: X3=5, X3!=5, a predicate, not a predicate."""
    conclusion: str = "same"
    """Conditions after the step, likewise; `same`: the code stays as it is."""
    plan: str | None = None
    """Conditions of a goal: the shortest plan of most probable outcomes to it from --start."""
    after: tuple[str, ...] = ()
    """Actions: what must, can and cannot hold after them from --start."""
    explain: str | None = None
    """An action: the rows behind its most probable outcome from --start."""
    start: str = "0"
    """Where plans start: the number of a view (as in the fact view(I)), or a code such as 3,0,1,7,2,2,5,4."""
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
    asked = [name for name in QUESTIONS if getattr(options, name) not in (None, False, ())]
    if len(asked) != 1:
        names = ", ".join("--" + name for name in QUESTIONS)
        found = f" (found {', '.join('--' + name for name in asked)})" if asked else ""
        raise UserError(f"ask one question: {names}{found}")
    run_folder = RunFolder.open(options.run)
    run_folder.require("extract")
    from nesy.asp import KnowledgeBase

    return QUESTIONS[asked[0]](KnowledgeBase.from_run(run_folder.path), options)


def _means(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    assert options.means is not None
    factor, value = _factor_and_value(options.means)
    return knowledge.means(factor, value).to_dict()


def _explain(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    assert options.explain is not None
    explanation = knowledge.explain(_start(knowledge, options.start), options.explain)
    return {"question": f"Why does {options.explain} lead there?", "text": explanation.text}


def _program(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    assert options.program is not None
    answer = knowledge.query(options.program, rules=options.rules, models=options.models, time_limit=options.time_limit)
    return {**answer.to_dict(), "text": _answer_text(answer)}


def _start(knowledge: KnowledgeBase, text: str) -> list[int]:
    """The code that --start names.

    Raises:
        UserError: neither the number of a view met in experience nor a code.
    """
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise UserError(f"--start {text}: expected the number of a view, or a code of comma-separated values")
    if len(parts) > 1:
        return [int(part) for part in parts]
    views = 0 if knowledge.codebook is None else len(knowledge.codebook)
    if knowledge.codebook is None or int(text) >= views:
        raise UserError(f"--start {text}: no such view; the model's views are 0 to {views - 1}")
    return [int(value) for value in knowledge.codebook.codes[int(text)]]


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


QUESTIONS: dict[str, Callable[[KnowledgeBase, Arguments], dict[str, Any]]] = {
    "means": _means,
    "changes": lambda knowledge, options: knowledge.influenced(options.changes or "").to_dict(),
    "predicate": lambda knowledge, options: knowledge.implies(options.predicate or "").to_dict(),
    "when": lambda knowledge, options: knowledge.rules(options.when or "").to_dict(),
    "verify": lambda knowledge, options: knowledge.verify(
        options.verify or "", options.premise, options.conclusion
    ).to_dict(),
    "plan": lambda knowledge, options: knowledge.plan(_start(knowledge, options.start), options.plan or "").to_dict(),
    "after": lambda knowledge, options: knowledge.after(_start(knowledge, options.start), options.after).to_dict(),
    "explain": _explain,
    "vocabulary": lambda knowledge, options: _vocabulary(knowledge),
    "program": _program,
}


def show(result: dict[str, Any]) -> None:
    """Print the answer as text."""
    print(result["text"])
