"""Properties of one step, checked over all codes at once: a counterexample, or a proof that there is none.

A property is `premise -> conclusion` about an action: "when a wall is ahead, moving forward changes nothing". Its
conditions are those of conditions, and in the conclusion `same` (the code stays). A predicate is read off
the code by rules induced from the codebook (nesy.asp.semantics.predicates).

Some steps are tried first. If none of them breaks the property, every part of the conclusion is proved by itself:

- only factors that it depends on matter (ancestors within slice t+1, their parents in slice t);
- values that the premise rules out are cut from the tables, and then those of slice t+1 that no row allows;
- a factor already proved to stay is replaced by its value in slice t where others depend on it;
- what is left of the tables becomes decision diagrams (diagrams), that of the factor concluded about with
  two leaves, broken or not; clingo looks for a way to `broken` (transition.lp, verify.lp).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import clingo
import numpy as np

from nesy.asp.program.conditions import Literal, of_factor, parse_literals
from nesy.asp.program.encoding import ENCODINGS
from nesy.asp.program.facts import LEAST
from nesy.asp.program.names import encode
from nesy.asp.questions.diagrams import diagram, diagram_facts
from nesy.asp.questions.falsification import TRIES, Step, try_steps
from nesy.asp.semantics.predicates import predicate_rules
from nesy.asp.semantics.rules import RuleSet, asp_rules
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError


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
        premise: conditions on the code before, all of which hold.
        conclusion: conditions on the code after, all of which must hold then.
        codes: `all` K^N codes, or those `met` in experience.
        least: values of a row less probable than this are taken as impossible.

    Raises:
        UserError: a condition is wrong, or `least` leaves a row without any value.
    """
    if codes not in ("all", "met"):
        raise UserError(f"codes '{codes}': a property is checked over all codes or over those met")
    met = _codes_met(dbn, codebook)
    if codes == "met" and not len(met):
        raise UserError("this model has no codebook and no table of the codes met, so it is not known which were met")
    before = parse_literals(dbn, codebook, premise)
    after = parse_literals(dbn, codebook, conclusion, conclusion=True)
    if not after:
        raise UserError("a property needs a conclusion")
    rules = {
        literal.predicate: predicate_rules(codebook, literal.predicate, held_out=0.0, num_values=dbn.num_values)
        for literal in (*before, *after)
        if literal.predicate and codebook is not None
    }
    check = _Check(dbn, action, before, rules, least)
    check.start(met, only_met=codes == "met")
    step = check.counterexample(after)
    first, later = step or ((), ())
    return Verdict(step is None, first, later, check.dropped, least, codes, tuple(rules.values()))


def _codes_met(dbn: TwoSliceDBN, codebook: Codebook | None) -> np.ndarray:
    """The distinct codes met in experience, integers [C, N]: those of the views, or else those that the model keeps."""
    if codebook is not None and len(codebook):
        return codebook.distinct_codes()[0]
    codes = dbn.tables.get("codes", np.zeros((0, dbn.num_factors), np.uint8))
    return np.unique(codes, axis=0)


Variable = tuple[int, int]
"""(slice, factor)."""


@dataclass
class _Check:
    """The state of one check."""

    dbn: TwoSliceDBN
    action: int
    before: list[Literal]
    rules: dict[str, RuleSet]
    least: float
    dropped: float = 0.0
    """Largest mass lost by a row so far."""
    known: np.ndarray | None = None
    """uint8 [C, N]: the codes that satisfy the premise, where not all codes are meant."""
    samples: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.uint8))
    """uint8 [S, N]: some codes that satisfy the premise."""
    values: dict[Variable, np.ndarray] = field(default_factory=dict)
    """The values that each variable can have under the premise."""
    stays: set[int] = field(default_factory=set)
    """Factors proved to keep their value under the premise."""

    def start(self, met: np.ndarray, only_met: bool) -> None:
        """Find out what the premise leaves possible; `met` uint8 [C, N] are the codes met in experience."""
        dbn = self.dbn
        can = self._possible_values()
        rng = np.random.default_rng(0)
        drawn = np.stack([rng.choice(np.flatnonzero(row), TRIES) if row.any() else np.zeros(TRIES, int) for row in can])
        met = met[self._satisfies(met)]
        if only_met:
            self.known, self.samples = met, met
            can &= np.stack([np.bincount(column, minlength=dbn.num_values) > 0 for column in met.T])
        else:
            drawn = drawn.T.astype(dbn.code_type)
            self.samples = np.concatenate([met, drawn[self._satisfies(drawn)]])
        self.values = {(0, f): np.flatnonzero(can[f]) for f in range(dbn.num_factors)}

    def counterexample(self, after: Sequence[Literal]) -> Step | None:
        """A step from a code with the premise that breaks one of the literals, or None if there is none."""
        if any(not len(values) for values in self.values.values()):
            return None
        step = try_steps(
            self.dbn,
            self.action,
            self.samples,
            after,
            lambda name, codes: self.rules[name].applies(codes),
            self.least,
            np.random.default_rng(1),
        )
        if step is not None:
            self._count_dropped(after)
            return step
        for literal in after:
            if literal.kind == "same":
                step = self._first_change()
            else:
                factors = [literal.factor] if literal.factor >= 0 else self._mentioned([literal])
                step = self._search(factors, literal)
            if step is not None:
                return step
        return None

    def _first_change(self) -> Step | None:
        for factor in self.dbn.order:
            step = self._search([factor], Literal("same", factor=factor))
            if step is not None:
                return step
            self.stays.add(factor)
        return None

    # ---------------------------------------------------------------- the premise
    def _possible_values(self) -> np.ndarray:
        """The values of slice t that each condition by itself leaves possible, bool [N, K]."""
        can = np.ones((self.dbn.num_factors, self.dbn.num_values), dtype=bool)
        every = np.arange(self.dbn.num_values)
        for literal in self.before:
            if literal.kind in ("is", "isnt"):
                can[literal.factor] &= (every == literal.value) == (literal.kind == "is")
                continue
            rules = self.rules[literal.predicate].rules
            if literal.kind == "holds":
                some = np.zeros_like(can)
                for rule in rules:
                    here = np.ones_like(can)
                    for factor, allowed in rule.conditions:
                        here[factor] = np.isin(every, allowed)
                    some |= here
                can &= some
            else:
                for rule in rules:
                    if len(rule.conditions) == 1:
                        factor, allowed = rule.conditions[0]
                        can[factor] &= ~np.isin(every, allowed)
        return can

    def _satisfies(self, codes: np.ndarray) -> np.ndarray:
        """Which codes satisfy the premise: bool [n]."""
        result = np.ones(len(codes), dtype=bool)
        for literal in self.before:
            if literal.predicate:
                result &= self.rules[literal.predicate].applies(codes) == (literal.kind == "holds")
            else:
                result &= of_factor(literal, codes)
        return result

    # ---------------------------------------------------------------- one part of the conclusion
    def _search(self, factors: Sequence[int], literal: Literal) -> Step | None:
        """A step that breaks one literal about some factors of slice t+1."""
        single = literal.factor >= 0
        needed = self._needed(factors)
        facts: list[str] = []
        nodes = 0
        open_premise = [condition for condition in self.before if not self._captured(condition)]
        used = set(self._mentioned(open_premise))
        for i in needed:
            axes, allowed = self._table(i)
            self.values[1, i] = np.flatnonzero(allowed.reshape(-1, self.dbn.num_values).any(axis=0))
            if single and i == literal.factor:
                axes, labels = self._broken(axes, allowed, literal)
                if labels.max(initial=0) <= 0:
                    return None
            else:
                labels = self._leaves(allowed)
            relevant = self._occurring(axes, labels)
            found = diagram(np.where(relevant, labels, -1))
            facts.append(f"root({nodes + found.root}).")
            if single and i == literal.factor:
                facts.append(f"bad({nodes + 1}).")
                without = frozenset({0})
            else:
                without = frozenset()
                facts += self._leaf_facts(i, nodes, allowed, labels)
            facts += diagram_facts(found, nodes, axes, [self.values[axis] for axis in axes], without)
            nodes += found.leaves + len(found.axes)
            used |= {f for where, f in axes if where == 0}
        facts += [f"can({f},{v})." for f in sorted(used) for v in self.values[0, f].tolist()]
        facts += self._condition_facts(open_premise, [] if single else [literal])
        if self.known is not None:
            columns = sorted(used)
            first = np.unique(self.known[:, columns], axis=0, return_index=True)[1] if columns else np.array([0])
            facts += [f"code({c},{f},{self.known[c, f]})." for c in first.tolist() for f in columns]
        step = self._solve("\n".join(facts), bool(used))
        return None if step is None else self._completed(*step, literal)

    def _needed(self, factors: Sequence[int]) -> list[int]:
        """The factors of slice t+1 that some depend on, in the order in which they are decided."""
        found, waiting = set(factors), list(factors)
        while waiting:
            for p in self.dbn.parents_next[self.action][waiting.pop()]:
                if p not in found and p not in self.stays:
                    found.add(p)
                    waiting.append(p)
        return [i for i in self.dbn.order if i in found]

    def _table(self, i: int) -> tuple[list[Variable], np.ndarray]:
        """What the rows of a table allow, over the values that its parents can have: bool [s1, ..., sm, K]."""
        axes = [(0 if p in self.stays else where, p) for where, p in self.dbn.parents(self.action, i)]
        every = np.arange(self.dbn.num_values)
        table = self.dbn.tensor(self.action, i)[np.ix_(*(self.values[axis] for axis in axes), every)]
        for axis in dict.fromkeys(axes):
            while axes.count(axis) > 1:
                one, two = [j for j, other in enumerate(axes) if other == axis][:2]
                table = np.moveaxis(np.diagonal(table, axis1=one, axis2=two), -1, one)
                del axes[two]
        allowed = np.greater_equal(table, max(self.least, np.finfo(float).tiny))
        mattering = self._occurring(axes, allowed[..., 0])
        if not allowed.any(axis=-1)[mattering].all():
            raise UserError(f"no value of some row is at least {self.least} probable; choose less")
        lost = np.where(allowed, 0.0, table).sum(axis=-1)
        self.dropped = max(self.dropped, float(lost[mattering].max(initial=0.0)))
        return axes, allowed & np.expand_dims(mattering, -1)

    def _occurring(self, axes: Sequence[Variable], labels: np.ndarray) -> np.ndarray:
        """Which entries of a table over `axes` the known codes can lead to: bool, the shape of `labels`."""
        if self.known is None:
            return np.ones(labels.shape, dtype=bool)
        now = [j for j, (where, _) in enumerate(axes) if where == 0]
        mask = np.zeros(tuple(labels.shape[j] for j in now), dtype=bool)
        mask[tuple(np.searchsorted(self.values[axes[j]], self.known[:, axes[j][1]]) for j in now)] = True
        shape = [labels.shape[j] if j in now else 1 for j in range(labels.ndim)]
        return np.broadcast_to(mask.reshape(shape), labels.shape)

    def _broken(self, axes: list[Variable], allowed: np.ndarray, literal: Literal) -> tuple[list[Variable], np.ndarray]:
        """1 where a row allows a value with which the literal about its factor is false, else 0."""
        if literal.kind == "isnt":
            return axes, np.asarray(allowed[..., literal.value], dtype=np.int64)
        if literal.kind == "is":
            return axes, np.asarray(np.delete(allowed, literal.value, axis=-1).any(axis=-1), dtype=np.int64)
        own = (0, literal.factor)
        other = np.stack([np.delete(allowed, v, axis=-1).any(axis=-1) for v in self.values[own].tolist()], axis=-1)
        if own not in axes:
            return [*axes, own], other.astype(np.int64)
        place = axes.index(own)
        return axes, np.moveaxis(np.diagonal(other, axis1=place, axis2=-1), -1, place).astype(np.int64)

    def _leaves(self, allowed: np.ndarray) -> np.ndarray:
        """A number for each distinct set of allowed values."""
        rows = allowed.reshape(-1, allowed.shape[-1])
        keys = np.packbits(rows, axis=1).astype(np.int64)
        _, index = np.unique(keys @ 256 ** np.arange(keys.shape[1])[::-1], return_inverse=True)
        return np.asarray(index, dtype=np.int64).reshape(allowed.shape[:-1])

    def _leaf_facts(self, i: int, first: int, allowed: np.ndarray, labels: np.ndarray) -> list[str]:
        rows = allowed.reshape(-1, allowed.shape[-1])
        _, where = np.unique(labels.reshape(-1), return_index=True)
        lines = []
        for leaf, row in enumerate(where.tolist()):
            values = ";".join(map(str, np.flatnonzero(rows[row]).tolist()))
            lines.append(f"leaf({first + leaf},{i})." + (f" may({first + leaf},({values}))." if values else ""))
        return lines

    def _captured(self, condition: Literal) -> bool:
        """Whether a condition of the premise says no more than which values each factor can have."""
        if self.known is not None or not condition.predicate:
            return True
        rules = self.rules[condition.predicate].rules
        if condition.kind == "holds":
            return len(rules) <= 1
        return all(len(rule.conditions) == 1 for rule in rules)

    def _mentioned(self, literals: Sequence[Literal]) -> list[int]:
        found = {literal.factor for literal in literals if literal.factor >= 0}
        for literal in literals:
            if literal.predicate:
                found |= {f for rule in self.rules[literal.predicate].rules for f, _ in rule.conditions}
        return sorted(found)

    def _condition_facts(self, premise: Sequence[Literal], conclusion: Sequence[Literal]) -> list[str]:
        lines = []
        for kind, where, atom, literals in (("premise", 0, "at", premise), ("conclusion", 1, "next", conclusion)):
            lines += [f"{kind}({_term(literal)})." for literal in literals]
            for name in dict.fromkeys(literal.predicate for literal in literals):
                lines.append(asp_rules(self.rules[name], f"means({encode(name)},{where})", atom))
        return lines

    def _count_dropped(self, after: Sequence[Literal]) -> None:
        """What rows lost in the tables that the conclusion depends on."""
        every = any(literal.kind == "same" for literal in after)
        for i in self._needed(range(self.dbn.num_factors) if every else self._mentioned(after)):
            table = self.dbn.cpt(self.action, i)
            self.dropped = max(self.dropped, float(np.where(table < self.least, table, 0.0).sum(axis=1).max()))

    def _solve(self, facts: str, any_used: bool) -> Step | None:
        control = clingo.Control(["--warn=none"])
        control.load(str(ENCODINGS / "transition.lp"))
        control.load(str(ENCODINGS / "verify.lp"))
        control.add("base", [], facts)
        control.ground([("base", [])])
        found: list[Step] = []

        def remember(model: clingo.Model) -> None:
            # factors that do not matter may have any value
            now = [int(self.values[0, f][0]) for f in range(self.dbn.num_factors)]
            if self.known is not None and not any_used:
                now = self.known[0].tolist()
            later = [-1] * self.dbn.num_factors
            for atom in model.symbols(shown=True):
                numbers = [argument.number for argument in atom.arguments]
                if atom.name == "from" and self.known is not None:
                    now = self.known[numbers[0]].tolist()
                elif atom.name == "at" and self.known is None:
                    now[numbers[0]] = numbers[1]
                elif atom.name == "next":
                    later[numbers[0]] = numbers[1]
            found.append((tuple(now), tuple(now[f] if f in self.stays else v for f, v in enumerate(later))))

        control.solve(on_model=remember)
        return found[0] if found else None

    def _completed(self, now: tuple[int, ...], later: tuple[int, ...], literal: Literal) -> Step:
        """The step with values for the factors of slice t+1 that are still open (-1).

        The factor concluded about takes its most probable value that breaks the conclusion, the others their most
        probable one.
        """
        first, found = np.array(now), np.array(later)
        for i in self.dbn.order:
            if found[i] >= 0:
                continue
            row = self.dbn.cpt(self.action, i)[int(self.dbn.rows(self.action, i, first, found))].copy()
            if i == literal.factor:
                value = first[i] if literal.kind == "same" else literal.value
                row[np.arange(len(row)) != value if literal.kind == "isnt" else value] = -1.0
            found[i] = row.argmax()
        return now, tuple(int(v) for v in found)


def _term(literal: Literal) -> str:
    if literal.predicate:
        return f"{literal.kind}({encode(literal.predicate)})"
    return f"{literal.kind}({literal.factor},{literal.value})"
