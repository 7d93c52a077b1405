"""The knowledge base of a run: its 2DBN and codebook, questions ready to ask, and any program of the user's.

Loads neither the network nor the domain: what a question needs was written when the 2DBN was extracted.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.asp.facts import Facts, asp_name
from nesy.asp.meaning import MOST_LINES, changes_of, meaning_of, values_that_imply
from nesy.asp.solver import Answer, solve
from nesy.asp.sources import read_sources
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

if TYPE_CHECKING:
    from nesy.asp.constraints import Removal
    from nesy.asp.explanation import Explanation
    from nesy.asp.planning import PredicateTruth
    from nesy.asp.shield import Shield


@dataclass(frozen=True)
class Finding:
    """The answer to a ready question."""

    question: str
    """The question in words."""
    text: str
    """The answer in words, for people."""
    rows: tuple[dict[str, Any], ...]
    """The answer as data."""
    seconds: float
    """Wall time."""

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {**asdict(self), "rows": list(self.rows)}


class KnowledgeBase:
    """Questions about one model."""

    def __init__(self, dbn: TwoSliceDBN, codebook: Codebook | None = None) -> None:
        """A knowledge base over a model, with the views met in experience where a codebook is given."""
        self.dbn, self.codebook = dbn, codebook
        self.facts = Facts(dbn, codebook)
        self._known_truth: PredicateTruth | None = None

    @classmethod
    def from_run(cls, path: Path | str) -> KnowledgeBase:
        """The knowledge base of a run folder.

        Raises:
            UserError: the folder is no run, lacks the step `extract`, or its files are damaged.
        """
        from nesy.run_folder import RunFolder

        run = RunFolder.open(path)
        run.require("extract")
        return cls.from_folder(run.dbn)

    @classmethod
    def from_folder(cls, path: Path | str) -> KnowledgeBase:
        """The knowledge base of a folder with a 2DBN and its codebook.

        Raises:
            UserError: the files are missing or damaged.
        """
        return cls(TwoSliceDBN.load(path), Codebook.load(path))

    # ---------------------------------------------------------------- ready questions
    def means(self, factor: int | str, value: int, least: float = 0.95) -> Finding:
        """What does factor F = V mean?

        Args:
            factor: number or name of the factor.
            value: the value.
            least: share of the views with the value in which a predicate must hold to be implied.

        Raises:
            UserError: no such factor or value.
        """
        started = time.perf_counter()
        f = self.factor(factor)
        if not 0 <= value < self.dbn.num_values:
            raise UserError(f"no value {value}; the values of a factor are 0 to {self.dbn.num_values - 1}")
        text, rows = meaning_of(self.facts, self._book(), f, value, least)
        return self._finding(f"What does {self.dbn.factor_names[f]} = {value} mean?", text, rows, started)

    def influenced(self, action: int | str) -> Finding:
        """Which factors does action A change, and through which parents?

        Raises:
            UserError: no such action.
        """
        started = time.perf_counter()
        a = self.action(action)
        text, rows = changes_of(self.facts, a)
        return self._finding(f"Which factors does '{self.dbn.action_names[a]}' change?", text, rows, started)

    def implies(self, predicate: str, least: float = 0.95) -> Finding:
        """Which values, alone or two together, mean that a predicate holds?

        Args:
            predicate: name of an observable predicate.
            least: share of the views with the value in which the predicate must hold.

        Raises:
            UserError: no such predicate.
        """
        started = time.perf_counter()
        text, rows = values_that_imply(self.facts, self._book(), predicate, least)
        return self._finding(f"Which values mean that {predicate} holds?", text, rows, started)

    # ---------------------------------------------------------------- steps, plans, beliefs
    def rules(self, predicate: str, held_out: float = 0.25) -> Finding:
        """Which rules over factor values say when a predicate holds?

        Raises:
            UserError: no such predicate.
        """
        from nesy.asp.rules import asp_rules, readable
        from nesy.asp.semantics import predicate_rules

        started = time.perf_counter()
        found = predicate_rules(self._book(), predicate, held_out, num_values=self.dbn.num_values)
        row = {
            "precision": found.precision,
            "recall": found.recall,
            "accuracy": found.accuracy,
            "rules": len(found.rules),
            "conditions": found.length,
            "asp": asp_rules(found, f"now({asp_name(predicate)})", "at"),
        }
        text = readable(found, self.dbn.factor_names)
        return self._finding(f"When does {predicate} hold?", text, [row], started)

    def verify(self, action: int | str, premise: str, conclusion: str, codes: str = "all") -> Finding:
        """Does `conclusion` hold after every possible step of an action from a code with `premise`?

        Conditions are written as in nesy.asp.verification.

        Args:
            action: number or name of the action.
            premise: conditions on the code before.
            conclusion: conditions on the code after, or `same`.
            codes: over `all` codes, or over those `met` in experience.

        Raises:
            UserError: a wrong action or condition.
        """
        from nesy.asp.verification import verify

        started = time.perf_counter()
        a = self.action(action)
        verdict = verify(self.dbn, self.codebook, a, premise, conclusion, codes)
        every = f"{self.dbn.num_values}^{self.dbn.num_factors} codes" if codes == "all" else "codes met"
        head = f"'{self.dbn.action_names[a]}' with [{premise or 'anything'}] leads to [{conclusion}]"
        if verdict.holds:
            text = f"Proved over all {every}: {head}."
        else:
            text = f"Not so: {head} is broken by the step\n  {verdict.code}\n  {verdict.next_code}"
        text += (
            f"\n  (values less probable than {verdict.least:g} count as impossible; at most {verdict.dropped:.2g} "
            "of a row is dropped by that)"
        )
        if not verdict.holds:
            text += "\n" + self.explain(verdict.code, a, verdict.next_code).text
        row = {
            "holds": verdict.holds,
            "code": list(verdict.code),
            "next_code": list(verdict.next_code),
            "dropped": verdict.dropped,
        }
        return self._finding(f"Is it so that {head}?", text, [row], started)

    def plan(self, start: Sequence[int], goal: str, max_steps: int = 12, **options: Any) -> Finding:
        """What is the shortest plan of most probable outcomes to a goal?

        Args:
            start: the code to start from.
            goal: conditions as in nesy.asp.verification.
            max_steps: longest plan looked for.
            options: see nesy.asp.planning.find_plan.

        Raises:
            UserError: a wrong code, condition or rule.
        """
        from nesy.asp.planning import find_plan

        started = time.perf_counter()
        truth = None if self.codebook is None or not len(self.codebook) else self._truth()
        found = find_plan(self.dbn, self.codebook, np.asarray(start), goal, max_steps, truth=truth, **options)
        row = asdict(found)
        if found.actions is None:
            text = f"No plan of at most {max_steps} steps of most probable outcomes leads to [{goal}]."
        else:
            text = (
                f"{len(found.actions)} steps lead to [{goal}]: {', '.join(found.actions) or 'nothing to do'}\n"
                f"  exactly these outcomes: probability {found.path_probability:.3g}; the goal holds at the end: "
                f"{found.goal_probability:.3g} "
                + f"(and at most {found.dropped:.2g} more: outcomes left out as improbable)"
            )
        return self._finding(f"How to reach [{goal}]?", text, [row], started)

    def after(self, start: Sequence[int], plan: Sequence[int | str]) -> Finding:
        """What must, can and cannot hold after a plan?

        Raises:
            UserError: a wrong code or action.
        """
        from nesy.asp.planning import after

        started = time.perf_counter()
        actions = [self.action(a) for a in plan]
        found = after(self.dbn, self._truth(), np.asarray(start), actions)
        likely = sorted(found.can.items(), key=lambda item: -item[1])[:MOST_LINES]
        text = (
            f"{found.codes} outcomes are possible "
            f"(those of at most {found.cut:g} are left out, together {found.dropped:.2g}).\n"
            f"  must hold: {', '.join(found.must) or 'nothing'}\n"
            f"  can hold: {', '.join(f'{name} ({p:.3f})' for name, p in likely) or 'nothing else'}\n"
            f"  cannot hold: {len(found.cannot)} predicates"
        )
        names = ", ".join(self.dbn.action_names[a] for a in actions)
        return self._finding(f"What holds after {names}?", text, [asdict(found)], started)

    def knows(self, particles: Any, predicates: Sequence[str]) -> Finding:
        """What does the holder of some particles (codes [n, N]) know, and hold possible?

        Raises:
            UserError: no particles, or no such predicate.
        """
        from nesy.asp.belief import BeliefQuestions

        started = time.perf_counter()
        found = BeliefQuestions(self._truth()).ask(particles, predicates)
        lines = []
        for name, k in found.items():
            if k.knows or k.knows_not:
                lines.append(f"{name}: known to be {'true' if k.knows else 'false'}")
            else:
                lines.append(f"{name}: may be true, may be false")
        rows = [asdict(k) for k in found.values()]
        return self._finding("What is known, what is possible?", "\n".join(lines), rows, started)

    def explain(self, code: Sequence[int], action: int | str, next_code: Sequence[int] | None = None) -> Explanation:
        """Why does an action lead from a code to the next (the most probable one by default)?

        The rows behind every factor, as `.text` and as `.graph()`.

        Raises:
            UserError: a wrong code or action.
        """
        from nesy.asp.explanation import explain_step

        later = None if next_code is None else np.asarray(next_code)
        return explain_step(self.dbn, np.asarray(code), self.action(action), later)

    def shield(self, rules: Sequence[str | Path], **options: Any) -> Shield:
        """An action mask from people's rules (see nesy.asp.shield.Shield, which also lists the options).

        Raises:
            UserError: a rule is wrong, or the rules do not ground within their limits.
        """
        from nesy.asp.shield import Shield

        book = self.codebook
        return Shield(
            rules,
            self.dbn.action_names,
            self.dbn.num_factors,
            self.dbn.num_values,
            () if book is None else book.predicate_names,
            view_size=5 if book is None or not len(book) else book.views.shape[1],
            **options,
        )

    def constrained(
        self, rules: Sequence[str | Path], time_limit: float = 10.0, memory_mb: int = 2048
    ) -> tuple[TwoSliceDBN, Removal]:
        """The model without the entries that rules call impossible, and what was removed.

        Args:
            rules: programs that derive impossible(A,F,X,V) for entries as in row(A,F,X,V,W).
            time_limit: seconds for grounding and solving.
            memory_mb: memory for grounding and solving.

        Raises:
            UserError: wrong rules, rules that contradict each other, or a row that would be left empty.
        """
        from nesy.asp.constraints import remove_entries

        show = "#show impossible/4. #defined impossible/4."
        answer = self.query(show, rules, time_limit=time_limit, memory_mb=memory_mb)
        if not answer.models:
            raise UserError("the rules contradict each other: they have no model")
        return remove_entries(self.dbn, answer.models[0])

    # ---------------------------------------------------------------- any program
    def query(
        self,
        program: str | Path,
        rules: Sequence[str | Path] = (),
        models: int = 1,
        time_limit: float = 10.0,
        memory_mb: int = 2048,
    ) -> Answer:
        """Solve any ASP program over the facts of the model (nesy.asp.VOCABULARY lists them).

        The program is text from a stranger: it runs in a process of its own, without script blocks and
        without files outside its folder, and is stopped at its limits.

        Args:
            program: program text, or the `Path` of a file.
            rules: further texts or `Path`s.
            models: how many models at most; 0 for all.
            time_limit: seconds for grounding and solving.
            memory_mb: memory for grounding and solving.

        Raises:
            UserError: the program is wrong, or does not ground within its limits.
        """
        sources = read_sources([program, *rules])
        mentioned = self.facts.mentioned(*(source.text for source in sources))
        uses_weights = bool({"row", "dropped"} & set(mentioned))
        return solve(
            sources,
            self.facts.text(mentioned),
            self.facts.names,
            models=models,
            time_limit=time_limit,
            memory_mb=memory_mb,
            dropped=self.facts.dropped() if uses_weights else 0.0,
        )

    # ---------------------------------------------------------------- names
    def factor(self, factor: int | str) -> int:
        """The number of a factor given by number or name.

        Raises:
            UserError: there is none such.
        """
        if isinstance(factor, str) and factor in self.dbn.factor_names:
            return self.dbn.factor_names.index(factor)
        if isinstance(factor, str) and re.fullmatch(r"\d+", factor):
            factor = int(factor)
        if isinstance(factor, int) and 0 <= factor < self.dbn.num_factors:
            return factor
        names = ", ".join(self.dbn.factor_names)
        raise UserError(f"no factor '{factor}'; the factors are 0 to {self.dbn.num_factors - 1} ({names})")

    def action(self, action: int | str) -> int:
        """The number of an action given by number or name.

        Raises:
            UserError: there is none such.
        """
        if isinstance(action, str) and action in self.dbn.action_names:
            return self.dbn.action_names.index(action)
        if isinstance(action, int) and 0 <= action < self.dbn.num_actions:
            return action
        raise UserError(f"no action '{action}'; the actions are {', '.join(self.dbn.action_names)}")

    def _book(self) -> Codebook:
        if self.codebook is None or not len(self.codebook):
            raise UserError("this model has no codebook: its values have no meaning in views")
        return self.codebook

    def _truth(self) -> PredicateTruth:
        """What holds in the codes of the codebook, worked out once."""
        from nesy.asp.planning import PredicateTruth

        if self._known_truth is None:
            self._known_truth = PredicateTruth(self._book())
        return self._known_truth

    def _finding(self, question: str, text: str, rows: Sequence[dict[str, Any]], started: float) -> Finding:
        return Finding(question, text, tuple(rows), round(time.perf_counter() - started, 4))
