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

import clingo
import numpy as np

from nesy.asp.facts import Facts, asp_name
from nesy.asp.solver import Answer, solve
from nesy.asp.sources import read_sources
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

if TYPE_CHECKING:
    from nesy.asp.shield import Shield

MOST_LINES = 8
ENCODINGS = Path(__file__).with_name("encodings")


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
        book = self._book()
        facts = self.facts.text(("predicate",)) + "\n".join(self.facts.cooccurs(factors=(f,)))
        totals = "".join(
            f"seen_of({name},{count},{len(book)})."
            for name, count in zip(self.facts.predicates, book.predicates.sum(axis=0).tolist(), strict=True)
        )
        atoms = run_encoding(("meaning",), f"asked({f},{value}). least({_percent(least)}). {totals} {facts}")
        rows: list[dict[str, Any]] = [
            {
                "relation": atom.name,
                "predicate": self._predicate_name(atom.arguments[0].name),
                "views": atom.arguments[1].number,
                "of": atom.arguments[2].number,
                "of_all_views": self._share(atom.arguments[0].name),
            }
            for atom in atoms
            if atom.arguments
        ]
        order = {"means": 0, "excludes": 1, "mixed": 2}
        rows.sort(key=lambda r: (order[r["relation"]], -abs(r["views"] / r["of"] - r["of_all_views"]), r["predicate"]))
        name = f"{self.dbn.factor_names[f]} = {value}"
        return self._finding(f"What does {name} mean?", self._meaning_text(name, rows), rows, started)

    def influenced(self, action: int | str) -> Finding:
        """Which factors does action A change, and through which parents?

        Raises:
            UserError: no such action.
        """
        started = time.perf_counter()
        a = self.action(action)
        facts = self.facts.text(("taken", "changed", "parent"))
        atoms = run_encoding(("influence",), f"asked({self.facts.actions[a]}). {facts}")
        parents: dict[int, list[str]] = {i: [] for i in range(self.dbn.num_factors)}
        changes = dict.fromkeys(range(self.dbn.num_factors), (0, 0))
        for atom in atoms:
            numbers = [argument.number for argument in atom.arguments[1:]]
            if atom.name == "through":
                parents[numbers[0]].append(self.dbn.factor_names[numbers[1]] + ("'" if numbers[2] else ""))
            elif atom.name == "changes":
                changes[numbers[0]] = (numbers[1], numbers[2])
        rows: list[dict[str, Any]] = [
            {
                "factor": self.dbn.factor_names[i],
                "changed": changes[i][0],
                "of": changes[i][1],
                "parents": sorted(parents[i]),
            }
            for i in sorted(changes, key=lambda i: (-changes[i][0], i))
        ]
        name = self.dbn.action_names[a]
        moved = [r for r in rows if r["changed"]]
        lines = [f"'{name}' changes {len(moved)} of {len(rows)} factors:"]
        lines += [
            f"  {r['factor']}  in {_percentage(r['changed'], r['of'])} of {r['of']} transitions, "
            f"decided by {', '.join(r['parents']) or 'nothing'}"
            for r in moved
        ]
        kept = [r["factor"] for r in rows if not r["changed"]]
        if kept:
            lines.append(f"  never changed: {', '.join(kept)}")
        return self._finding(f"Which factors does '{name}' change?", "\n".join(lines), rows, started)

    def implies(self, predicate: str, least: float = 0.95) -> Finding:
        """Which values, alone or two together, mean that a predicate holds?

        Args:
            predicate: name of an observable predicate.
            least: share of the views with the value in which the predicate must hold.

        Raises:
            UserError: no such predicate.
        """
        started = time.perf_counter()
        book = self._book()
        truth = book.predicate(predicate)
        name = asp_name(predicate)
        facts = "\n".join([*self.facts.cooccurs(predicates=(name,)), *self.facts.together(predicates=(name,))])
        atoms = run_encoding(("implies",), f"asked({name}). least({_percent(least)}). {facts}")
        rows = []
        for atom in atoms:
            numbers = [argument.number for argument in atom.arguments]
            values = list(zip(numbers[:-2:2], numbers[1:-2:2], strict=True))
            covered = _having(book, values) & truth
            rows.append(
                {
                    "values": [{"factor": self.dbn.factor_names[f], "value": v} for f, v in values],
                    "views": numbers[-2],
                    "of": numbers[-1],
                    "covers": round(float(covered.sum() / max(1, truth.sum())), 4),
                    "_covered": covered,
                }
            )
        rows.sort(key=lambda r: (len(r["values"]), -r["covers"], str(r["values"])))
        chosen, rows = _greedy_cover(rows)
        text = self._implies_text(predicate, chosen, len(rows), int(truth.sum()), len(book))
        return self._finding(f"Which values mean that {predicate} holds?", text, rows, started)

    # ---------------------------------------------------------------- steps, plans, beliefs
    def rules(self, predicate: str, held_out: float = 0.25) -> Finding:
        """Which rules over factor values say when a predicate holds?

        Raises:
            UserError: no such predicate.
        """
        from nesy.asp.semantics import asp_rules, predicate_rules, readable

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
        found = find_plan(self.dbn, self.codebook, np.asarray(start), goal, max_steps, **options)
        row = asdict(found)
        if found.actions is None:
            text = f"No plan of at most {max_steps} steps of most probable outcomes leads to [{goal}]."
        else:
            text = (
                f"{len(found.actions)} steps lead to [{goal}]: {', '.join(found.actions) or 'nothing to do'}\n"
                f"  exactly these outcomes: probability {found.path_probability:.3g}; the goal holds at the end: "
                f"{found.goal_probability:.3g} "
                + (f"(a row lost at most {found.dropped:.2g})" if found.exact else "(from 20,000 rollouts)")
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
        found = after(self.dbn, self._book(), np.asarray(start), actions)
        likely = sorted(found.can.items(), key=lambda item: -item[1])[:MOST_LINES]
        text = (
            f"{found.codes} outcomes are possible (a row lost at most {found.dropped:.2g}).\n"
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
        from nesy.asp.planning import PredicateTruth

        started = time.perf_counter()
        found = BeliefQuestions(PredicateTruth(self._book())).ask(particles, predicates)
        lines = []
        for name, k in found.items():
            if k.knows or k.knows_not:
                lines.append(f"{name}: known to be {'true' if k.knows else 'false'}")
            else:
                lines.append(f"{name}: may be true, may be false")
        rows = [asdict(k) for k in found.values()]
        return self._finding("What is known, what is possible?", "\n".join(lines), rows, started)

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

    def _predicate_name(self, constant: str) -> str:
        return self._book().predicate_names[self.facts.predicates.index(constant)]

    def _share(self, constant: str) -> float:
        return round(float(self._book().predicates[:, self.facts.predicates.index(constant)].mean()), 4)

    def _finding(self, question: str, text: str, rows: Sequence[dict[str, Any]], started: float) -> Finding:
        return Finding(question, text, tuple(rows), round(time.perf_counter() - started, 4))

    def _meaning_text(self, name: str, rows: Sequence[dict[str, Any]]) -> str:
        if not rows:
            return f"{name}: no view met in experience has this value."
        lines = [f"{name} ({rows[0]['of']} of {len(self._book())} distinct views):"]
        words = {"means": "holds", "excludes": "does not hold"}
        for relation in words:
            chosen = [row for row in rows if row["relation"] == relation]
            for row in chosen[:MOST_LINES]:
                share = _percentage(row["views"], row["of"])
                lines.append(
                    f"  {row['predicate']} {words[relation]}: true in {share} of them, "
                    f"in {100 * row['of_all_views']:.1f} % of all views"
                )
            if len(chosen) > MOST_LINES:
                lines.append(f"  ... and {len(chosen) - MOST_LINES} predicates more that {words[relation]}")
        mixed = [r for r in rows if r["relation"] == "mixed"][:3]
        if len(lines) == 1:
            lines.append("  no predicate is decided by this value alone; the nearest:")
            lines += [
                f"  {r['predicate']}: true in {_percentage(r['views'], r['of'])} of them, "
                f"in {100 * r['of_all_views']:.1f} % of all views"
                for r in mixed
            ]
        return "\n".join(lines)

    def _implies_text(
        self, predicate: str, chosen: Sequence[dict[str, Any]], total: int, positive: int, views: int
    ) -> str:
        head = f"{predicate} holds in {positive} of {views} distinct views."
        if not chosen:
            return f"{head}\n  No value and no pair of values implies it."
        lines = [head, f"  {total} values or pairs imply it; these cover what can be covered:"]
        for row in chosen:
            values = " and ".join(f"{v['factor']} = {v['value']}" for v in row["values"])
            lines.append(
                f"  {values}: true in {row['views']} of {row['of']} views, covers {100 * row['covers']:.1f} % "
                f"of the views with {predicate} (so far {100 * row['covered_so_far']:.1f} %)"
            )
        return "\n".join(lines)


def run_encoding(names: Sequence[str], facts: str, optimise: bool = False) -> list[clingo.Symbol]:
    """The shown atoms of our own encodings on some facts; they are known to end, so no limits are needed.

    Args:
        names: the encodings.
        facts: program text.
        optimise: whether to look for the best model; otherwise the first will do.
    """
    options = ["--opt-mode=opt", "--models=0"] if optimise else ["--opt-mode=ignore", "--models=1"]
    control = clingo.Control(["--warn=none", *options])
    for name in names:
        control.load(str(ENCODINGS / f"{name}.lp"))
    control.add("base", [], facts)
    control.ground([("base", [])])
    atoms: list[clingo.Symbol] = []
    with control.solve(yield_=True) as handle:
        for model in handle:
            atoms = list(model.symbols(shown=True))
    return sorted(atoms)


def _having(book: Codebook, values: Sequence[tuple[int, int]]) -> Any:
    """Which views have all the values (factor, value): bool [V]."""
    chosen = book.counts >= 0
    for factor, value in values:
        chosen = chosen & (book.codes[:, factor] == value)
    return chosen


def _greedy_cover(rows: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """A small choice of rows that together cover all that any row covers; and the rows as plain data."""
    masks = [row.pop("_covered") for row in rows]
    if not rows:
        return [], []
    covered = masks[0] & False
    total = max(1.0, *(mask.sum() / max(row["covers"], 1e-9) for mask, row in zip(masks, rows, strict=True)))
    chosen: list[dict[str, Any]] = []
    while True:
        gains = [int((mask & ~covered).sum()) for mask in masks]
        best = max(range(len(rows)), key=lambda j: (gains[j], -len(rows[j]["values"]), -j))
        if not gains[best]:
            return chosen, rows
        covered = covered | masks[best]
        rows[best]["covered_so_far"] = round(float(covered.sum() / total), 4)
        chosen.append(rows[best])


def _percent(share: float) -> int:
    if not 0.5 < share <= 1:
        raise UserError(f"the least share must lie between 0.5 and 1, found {share}")
    return round(100 * share)


def _percentage(part: int, whole: int) -> str:
    return f"{100 * part / max(1, whole):.1f} %"
