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
from typing import Annotated, Any

import tyro

from nesy.errors import UserError
from nesy.run_folder import RunFolder


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
        return knowledge.vocabulary().to_dict()
    assert options.program is not None
    answer = knowledge.query(options.program, rules=options.rules, models=options.models, time_limit=options.time_limit)
    return answer.to_dict()


def _factor_and_value(text: str) -> tuple[int, int]:
    factor, equals, value = text.partition("=")
    if not equals or not factor.strip().isdecimal() or not value.strip().isdecimal():
        raise UserError(f"--means {text}: expected FACTOR=VALUE, two numbers such as 3=5")
    return int(factor), int(value)


def show(result: dict[str, Any]) -> None:
    """Print the answer as text."""
    print(result["text"])
