"""The knowledge base of a run: its 2DBN and codebook, questions ready to ask, and any program of the user's.

Loads neither the network nor the domain: what a question needs was written when the 2DBN was extracted.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.asp.finding import Edge, Finding, finding
from nesy.asp.program.solver import Answer, solve
from nesy.asp.program.sources import Programs, listed, read_sources
from nesy.asp.questions.meaning_questions import MeaningQuestions
from nesy.asp.questions.step_questions import StepQuestions
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

if TYPE_CHECKING:
    from nesy.asp.constraints import Removal
    from nesy.asp.shield import Advice, Shield


class KnowledgeBase(MeaningQuestions, StepQuestions):
    """Questions about one model."""

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

    # ---------------------------------------------------------------- beliefs
    def knows(self, particles: Any, predicates: Sequence[str]) -> Finding:
        """What does the holder of some particles (codes [n, N]) know, and hold possible?

        Raises:
            UserError: no particles, or no such predicate.
        """
        from nesy.asp.questions.belief import BeliefQuestions

        started = time.perf_counter()
        found = BeliefQuestions(self._truth()).ask(particles, predicates)
        lines, support = [], []
        for name, k in found.items():
            if k.knows or k.knows_not:
                lines.append(f"{name}: known to be {'true' if k.knows else 'false'}")
            else:
                lines.append(f"{name}: may be true, may be false")
            letters = [f"K {name}"] * k.knows + [f"K not {name}"] * k.knows_not
            letters += [f"M {name}"] * k.possible + [f"M not {name}"] * k.possible_not
            support += [(f"{len(particles)} particles", letter, "") for letter in letters]
        rows = [asdict(k) for k in found.values()]
        return finding("What is known, what is possible?", "\n".join(lines), rows, started, support)

    def person_knows(
        self,
        start: Sequence[int],
        configuration: int,
        predicates: Sequence[str],
        particles: int = 1000,
        seed: int = 0,
    ) -> Finding:
        """What does the robot know about what the person sees?

        The particles are those of the perspective-shifted belief (minds). "The robot knows that the person
        sees the goal" is `knows` for goal_visible: it holds in everything that the person may be seeing.

        Args:
            start: the robot's own code.
            configuration: where it sees the person (0: nowhere).
            predicates: names.
            particles: how many.
            seed: of the drawing.

        Raises:
            UserError: a wrong code or predicate.
        """
        from nesy.asp.questions.minds import persons_worlds

        started = time.perf_counter()
        worlds = persons_worlds(self.dbn, self.book, np.asarray(start), configuration, particles, seed)
        found = self.knows(worlds.particles, predicates)
        words = {"true": "the robot knows that the person sees it", "false": "the robot knows that the person does not"}
        lines = []
        for line in found.text.splitlines():
            name, _, state = line.partition(": ")
            known = state.removeprefix("known to be ")
            lines.append(f"{name}: {words.get(known, 'the person may see it or not')}")
        if not worlds.reachable:
            lines.append("  (where the person is cannot be imagined from here: nothing is known about what it sees)")
        distinct = len(np.unique(worlds.particles, axis=0))
        lines.append(f"  ({particles} particles of the shifted belief, {distinct} distinct views)")
        return finding("What does the person see?", "\n".join(lines), found.rows, started, found.support)

    # ---------------------------------------------------------------- people's rules
    def allowed(self, rules: Programs, code: Sequence[int], configuration: int = 0, **options: Any) -> Finding:
        """Which actions do people's rules allow in one situation, and which rules forbid the others?

        Args:
            rules: rule files or texts.
            code: the code; its predicates are those of the views met that have it.
            configuration: where the person is seen (0: nowhere).
            options: of the shield.

        Raises:
            UserError: a rule is wrong, or no view met has the code.
        """
        started = time.perf_counter()
        shield = self.shield(rules, **options)
        advice = self._advice(shield, np.asarray(code), configuration)
        lines = []
        support: list[Edge] = []
        for name, allowed, preferred in zip(self.dbn.action_names, advice.allowed, advice.preferred, strict=True):
            because = advice.because.get(name, ())
            word = "allowed" if allowed else "forbidden"
            lines.append(
                f"{name}: {word}{' and preferred' if allowed and preferred else ''}"
                + (f" (rules {', '.join(because)})" if because else "")
            )
            support += [(place, f"{word} {name}", "rule") for place in because]
        if advice.conflict:
            lines.append(f"  (the rules forbid every action: the fallback '{shield.fallback}' decides)")
        row = {
            "allowed": [n for n, yes in zip(self.dbn.action_names, advice.allowed, strict=True) if yes],
            "preferred": [n for n, yes in zip(self.dbn.action_names, advice.preferred, strict=True) if yes],
            "because": {name: list(places) for name, places in advice.because.items()},
            "conflict": advice.conflict,
        }
        return finding("Which actions are allowed?", "\n".join(lines), [row], started, support)

    def _advice(self, shield: Shield, code: np.ndarray, configuration: int) -> Advice:
        truth = self._truth()
        if not truth.knows(self.dbn._codes(code)[None])[0]:
            raise UserError(f"code {tuple(int(v) for v in code)}: no view met has it, so its predicates are not known")
        holds, _ = truth.of(code[None])
        columns = [self.book.predicate_names.index(name) for name in shield.predicates]
        return shield.advise(code, holds[0, columns], configuration)

    def shield(self, rules: Programs, **options: Any) -> Shield:
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
        self, rules: Programs, time_limit: float = 10.0, memory_mb: int = 2048
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
        rules: Programs = (),
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
        sources = read_sources([program, *listed(rules)])
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
