"""Ask what factors and values mean, verify, plan, explain; or run any ASP program over the model of a run.

Ready questions, one per call:
  meaning
  --means 3=5             what does factor 3 = value 5 mean? (predicates, rule, picture)
  --predicate wall_ahead  which values mean that the predicate holds?
  --when wall_ahead       which rules over values say when it holds (or --when 3=5: over predicates, when the factor
                          has the value), and how well on views not used for them?
  --changes forward       which factors does the action change, and through which parents?
  steps
  --verify forward --premise wall_ahead --conclusion same     does this follow, over ALL codes?
  --plan goal_ahead       the shortest plan of most probable outcomes to a goal
  --trajectory goal_ahead the most probable way to it, where outcomes may be hoped for
  --reach goal_ahead      how soon can it hold? (--reach "": each predicate)
  --after left forward    what must, can and cannot hold after these actions?
  --explain forward       why does the action lead where it most probably leads?
  minds
  --knows goal_visible    what does the robot know about what the person sees (--person), or about its own view if it
                          may be any of --views?
  rules of people (--rules FILE ...)
  --shield                which actions do they allow, and which rules forbid the others?
  --constrain             what do they remove from the table? (--out FOLDER: write the model that is left)
  --why dqn               why does this agent of the comparison act as it does?
  --vocabulary            which predicates and facts are there?
All about a situation start from --start, a view by its number (view(I)) or a code (3,0,1,...), and --person, the
person's place as side,ahead,heading (0,1,2: one cell ahead, facing down in the view), or unseen.
--graph FILE draws what supports the answer (.svg, .png, .dot, .graphml, .json).
Your own: --program FILE (any ASP program over the facts), with --rules FILE ... as background knowledge.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from nesy.errors import UserError
from nesy.run_folder import RunFolder


@dataclass(frozen=True)
class Arguments:
    """Options of `nesy query`."""

    run: Path = Path("runs/default")
    """The run folder."""
    means: str | None = None
    """FACTOR=VALUE: what the value means, in predicates, as a rule and as a picture."""
    predicate: str | None = None
    """A predicate: which values of which factors mean that it holds."""
    when: str | None = None
    """A predicate, or FACTOR=VALUE: the rules that say when it holds, with precision and recall."""
    changes: str | None = None
    """An action: which factors it changes, and which parents decide it."""
    verify: str | None = None
    """An action: whether --conclusion holds after every possible step of it from a code with --premise."""
    premise: str = ""
    """Conditions before the step, comma-separated: X3=5, X3!=5, a predicate, not a predicate."""
    conclusion: str = "same"
    """Conditions after the step, likewise; `same`: the code stays as it is."""
    codes: Literal["all", "met"] = "all"
    """Whether a property is to hold for all codes, or for those met in experience."""
    least: float = 0.001
    """For properties, values of a row less probable than this count as impossible; for --after, outcomes."""
    plan: str | None = None
    """Conditions of a goal: the shortest plan of most probable outcomes to it from --start."""
    trajectory: str | None = None
    """Conditions of a goal: the most probable way to it from --start, in at most --max-steps steps."""
    reach: str | None = None
    """Conditions of a goal: how soon it can hold from --start; empty for each predicate."""
    max_steps: int = 8
    """Longest plan, trajectory or way looked for."""
    after: tuple[str, ...] = ()
    """Actions: what must, can and cannot hold after them from --start."""
    explain: str | None = None
    """An action: the rows behind its most probable outcome from --start."""
    knows: tuple[str, ...] = ()
    """Predicates: what is known (K) and held possible (M) about them."""
    views: tuple[int, ...] = ()
    """Numbers of views that are held possible, for --knows."""
    shield: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Which actions --rules allow at --start with --person."""
    fallback: Literal["all", "stay", "error"] | None = None
    """What is allowed where the rules forbid every action; by default `stay` if there is such an action, else `all`."""
    constrain: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """What the impossible/4 of --rules removes from the table."""
    out: Path | None = None
    """A new folder for the model that --constrain leaves."""
    why: str | None = None
    """An agent of the comparison (dqn, search, pomdp, or a cell's full name): why it acts as it does at --start."""
    start: str = "0"
    """Where it starts: the number of a view (as in the fact view(I)), or a code such as 3,0,1,7,2,2,5,4."""
    person: str = "unseen"
    """Where the robot sees the person: side,ahead,heading relative to itself, or unseen."""
    vocabulary: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """List the predicates and the facts that programs can use."""
    program: Path | None = None
    """An ASP program to run over the facts of the model."""
    rules: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """A rule file (the option can be repeated): for programs, plans, shields and constraints."""
    time_limit: float = 10.0
    """Seconds after which a program is stopped."""
    models: int = 1
    """Most answer sets to show; 0 for all."""
    graph: Path | None = None
    """A file for a graph of what supports the answer."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the result as one JSON object on standard output."""


def run(options: Arguments) -> dict[str, Any]:
    """Answer one question."""
    from nesy.cli.commands.query_answers import QUESTIONS

    asked = [name for name in QUESTIONS if getattr(options, name) not in (None, False, ())]
    if len(asked) != 1:
        names = ", ".join("--" + name for name in QUESTIONS)
        found = f" (found {', '.join('--' + name for name in asked)})" if asked else ""
        raise UserError(f"ask one question: {names}{found}")
    run_folder = RunFolder.open(options.run)
    run_folder.require("extract")
    from nesy.asp import KnowledgeBase

    result = QUESTIONS[asked[0]](KnowledgeBase.from_run(run_folder.path), options)
    if options.graph is not None:
        from nesy.asp.finding import save_graph

        save_graph([(a, b, label) for a, b, label in result.get("support", ())], options.graph)
        result["graph"] = str(options.graph)
    return result


def show(result: dict[str, Any]) -> None:
    """Print the answer as text."""
    print(result["text"])
