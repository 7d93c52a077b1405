"""Ready questions about steps: properties, plans, trajectories, outcomes, reachability, explanations."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.asp.finding import Edge, Finding, finding
from nesy.asp.program.facts import LEAST
from nesy.asp.program.names import encode
from nesy.asp.questions.subject import Subject
from nesy.asp.semantics.meaning import MOST_LINES

if TYPE_CHECKING:
    from nesy.asp.questions.explanation import Explanation
    from nesy.asp.questions.planning import Plan


class StepQuestions(Subject):
    """What actions lead to."""

    def verify(
        self, action: int | str, premise: str, conclusion: str, codes: str = "all", least: float = LEAST
    ) -> Finding:
        """Does `conclusion` hold after every possible step of an action from a code with `premise`?

        Conditions are written as in nesy.asp.program.conditions.

        Args:
            action: number or name of the action.
            premise: conditions on the code before.
            conclusion: conditions on the code after, or `same`.
            codes: over `all` codes, or over those `met` in experience.
            least: values of a row less probable than this are taken as impossible.

        Raises:
            UserError: a wrong action or condition.
        """
        from nesy.asp.questions.verification import verify
        from nesy.asp.semantics.rules import sentence

        started = time.perf_counter()
        a = self.action(action)
        verdict = verify(self.dbn, self.codebook, a, premise, conclusion, codes, least)
        every = f"{self.dbn.num_values}^{self.dbn.num_factors} codes" if codes == "all" else "codes met"
        head = f"'{self.dbn.action_names[a]}' with [{premise or 'anything'}] leads to [{conclusion}]"
        names = self.dbn.factor_names
        support: list[Edge] = [
            (sentence(rule, names), found.target, "rule") for found in verdict.rules for rule in found.rules
        ]
        if verdict.holds:
            text = f"Proved over all {every}: {head}."
            support += [
                (source, f"{names[i]}'", "table")
                for i in range(self.dbn.num_factors)
                for source in [names[p] + "'" * where for where, p in self.dbn.parents(a, i)]
            ]
        else:
            text = f"Not so: {head} is broken by the step\n  {verdict.code}\n  {verdict.next_code}"
        text += (
            f"\n  (values less probable than {verdict.least:g} count as impossible; at most {verdict.dropped:.2g} "
            "of a row is dropped by that)"
        )
        if not verdict.holds:
            explanation = self.explain(verdict.code, a, verdict.next_code)
            text += "\n" + explanation.text
            support += explanation.support
        row = {
            "holds": verdict.holds,
            "code": list(verdict.code),
            "next_code": list(verdict.next_code),
            "dropped": verdict.dropped,
        }
        return finding(f"Is it so that {head}?", text, [row], started, support)

    def plan(self, start: Sequence[int], goal: str, max_steps: int = 12, **options: Any) -> Finding:
        """What is the shortest plan of most probable outcomes to a goal?

        Args:
            start: the code to start from.
            goal: conditions as in nesy.asp.program.conditions.
            max_steps: longest plan looked for.
            options: see nesy.asp.questions.planning.find_plan.

        Raises:
            UserError: a wrong code, condition or rule.
        """
        from nesy.asp.questions.planning import find_plan

        started = time.perf_counter()
        truth = self._truth_if_known()
        found = find_plan(self.dbn, self.codebook, np.asarray(start), goal, max_steps, truth=truth, **options)
        if found.actions is None:
            text = f"No plan of at most {max_steps} steps of most probable outcomes leads to [{goal}]."
        else:
            text = (
                f"{len(found.actions)} steps lead to [{goal}]: {', '.join(found.actions) or 'nothing to do'}\n"
                f"  exactly these outcomes: probability {found.path_probability:.3g}; the goal holds at the end: "
                f"{found.goal_probability:.3g} "
                f"(and at most {found.dropped:.2g} more: outcomes left out as improbable)"
            )
        support = self._steps_of(found)
        return finding(f"How to reach [{goal}]?", text, [asdict(found)], started, support)

    def trajectory(self, start: Sequence[int], goal: str, max_steps: int = 8, **options: Any) -> Finding:
        """What is the most probable way to a goal, in any number of steps up to `max_steps`?

        Outcomes may be hoped for (see nesy.asp.questions.planning.find_plan).

        Raises:
            UserError: a wrong code, condition or rule.
        """
        hoping = {"most_probable": True, "optimistic": True, "any_length": True}
        return self.plan(start, goal, max_steps, **{**hoping, **options})

    def _steps_of(self, found: Plan) -> list[Edge]:
        """Each step of a plan, and the rows that decide what changes in it."""
        edges: list[Edge] = []
        for t, action in enumerate(found.actions or ()):
            explanation = self.explain(found.codes[t], action, found.codes[t + 1])
            here, there = (f"t={t + s}: {' '.join(map(str, found.codes[t + s]))}" for s in (0, 1))
            edges.append((here, there, f"{action} ({explanation.probability:.3g})"))
        return edges

    def after(self, start: Sequence[int], plan: Sequence[int | str], least: float = LEAST) -> Finding:
        """What must, can and cannot hold after a plan?

        Args:
            start: the code to start from.
            plan: numbers or names of the actions.
            least: outcomes less probable than this are left out; how much that is together is stated.

        Raises:
            UserError: a wrong code or action.
        """
        from nesy.asp.questions.aftermath import after
        from nesy.asp.semantics.predicates import ordered

        started = time.perf_counter()
        actions = [self.action(a) for a in plan]
        found = after(self.dbn, self._truth(), np.asarray(start), actions, least)
        likely = sorted(found.can.items(), key=lambda item: -item[1])[:MOST_LINES]
        # names of their own first: what cells cannot be is a long list
        excluded = ordered(found.cannot)
        more = f" and {len(excluded) - MOST_LINES} more" if len(excluded) > MOST_LINES else ""
        cannot = ", ".join(excluded[:MOST_LINES]) + more or "nothing"
        text = (
            f"{found.codes} outcomes are possible "
            f"(those less probable than {found.cut:g} are left out, together {found.dropped:.2g}).\n"
            f"  must hold: {', '.join(found.must) or 'nothing'}\n"
            f"  can hold: {', '.join(f'{name} ({p:.3f})' for name, p in likely) or 'nothing else'}\n"
            f"  cannot hold: {cannot}"
        )
        names = ", ".join(self.dbn.action_names[a] for a in actions)
        source = f"{' '.join(str(int(v)) for v in start)}; {names}"
        support = [(source, name, "must") for name in found.must]
        support += [(source, name, f"can, {p:.3f}") for name, p in likely]
        return finding(f"What holds after {names}?", text, [asdict(found)], started, support)

    def reachable(self, start: Sequence[int], goal: str = "", max_steps: int = 8) -> Finding:
        """How soon can a goal hold, if outcomes are as hoped for? Without a goal: each predicate.

        Raises:
            UserError: a wrong code or condition.
        """
        from nesy.asp.questions.reachability import reach

        started = time.perf_counter()
        goals = [goal] if goal else [encode(name) for name in self.book.predicate_names]
        found = reach(self.dbn, self.codebook, self._truth_if_known(), np.asarray(start), goals, max_steps)
        lines, support = [], []
        for one in sorted(found.found, key=lambda r: (r.steps is None, r.steps or 0)):
            if one.steps is None:
                never = "in any number of" if found.exhausted else f"in {max_steps}"
                lines.append(f"[{one.goal}] cannot be reached {never} steps")
            else:
                how = f": {', '.join(one.actions)}" if one.actions else ""
                lines.append(f"[{one.goal}] can hold after {one.steps} steps{how}")
                support.append((", ".join(one.actions) or "nothing to do", one.goal, f"{one.steps} steps"))
        lines.append(
            f"  ({found.codes} codes can be reached; outcomes less probable than {found.least:g} are not hoped for, "
            "but for the most probable one of each action)"
        )
        rows = [asdict(one) for one in found.found]
        question = f"Can [{goal}] be reached?" if goal else "What can be reached?"
        return finding(question, "\n".join(lines), rows, started, support)

    def explain(self, code: Sequence[int], action: int | str, next_code: Sequence[int] | None = None) -> Explanation:
        """Why does an action lead from a code to the next (the most probable one by default)?

        The rows behind every factor, as `.text` and as `.graph()`.

        Raises:
            UserError: a wrong code or action.
        """
        from nesy.asp.questions.explanation import explain_step

        later = None if next_code is None else np.asarray(next_code)
        return explain_step(self.dbn, np.asarray(code), self.action(action), later)
