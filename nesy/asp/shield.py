"""Shields: people's rules about actions as an action mask, grounded once and asked by assumptions.

A rule file says `forbidden(forward) :- now(wall_ahead).` or `preferred(left) :- at(3,5).`; the situation (code,
predicates of the view, person seen) is assumed for every decision, nothing is grounded again. Equal situations are
answered from memory. A shield that would leave no action says which rules conflict, and falls back as configured.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import clingo
import numpy as np
from clingo import ast

from nesy.asp.program.encoding import ENCODINGS
from nesy.asp.program.names import encode
from nesy.asp.program.solver import solve
from nesy.asp.program.sources import Programs, Source, read_sources
from nesy.errors import UserError

Fallback = Literal["all", "stay", "error"]


def usual_fallback(action_names: Sequence[str]) -> Fallback:
    """Where rules forbid everything: only `stay` if there is such an action, else all actions."""
    return "stay" if "stay" in action_names else "all"


@dataclass(frozen=True)
class Role:
    """Whose actions the rules are about, and what the rules call that one's situation."""

    code: str
    """Predicate of factor values: code(F,V)."""
    view: str
    """Predicate of what holds in the view: view(P)."""
    forbidden: str
    """The head that forbids an action."""
    preferred: str
    """The head that prefers an action; empty where none does."""
    encoding: str
    """File under encodings/."""


DERIVED = ("person_ahead", "person_visible")
"""Predicates of the robot's view that shield.lp derives."""
ROBOT = Role("at", "now", "forbidden", "preferred", "shield.lp")
PERSON = Role("person_code", "person_now", "person_forbidden", "", "person.lp")


@dataclass(frozen=True)
class Advice:
    """What the rules say in one situation."""

    allowed: tuple[bool, ...]
    """Per action, after the fallback."""
    preferred: tuple[bool, ...]
    """Per action."""
    because: dict[str, tuple[str, ...]]
    """For each forbidden action the places (file:line:column) of the rules that forbid it."""
    conflict: bool
    """Whether the rules forbid every action, so that the fallback decided."""


class Shield:
    """An action mask from rule files."""

    def __init__(
        self,
        rules: Programs,
        action_names: Sequence[str],
        num_factors: int,
        num_values: int,
        predicates: Sequence[str],
        view_size: int = 5,
        fallback: Fallback = "all",
        stay: str = "stay",
        time_limit: float = 10.0,
        memory_mb: int = 1024,
        role: Role = ROBOT,
    ) -> None:
        """Check the rules in a process of their own, then ground them once.

        Args:
            rules: rule files (`Path`) or texts (`str`).
            action_names: A names.
            num_factors: N.
            num_values: K.
            predicates: names of the view's predicates.
            view_size: width of the view.
            fallback: what is allowed where the rules forbid everything: `all` actions, only `stay`, or an `error`.
            stay: name of the action that `stay` means.
            time_limit: seconds that checking the rules may take.
            memory_mb: memory that checking the rules may take.
            role: whose actions: the robot's own, or those that the person is expected to take.

        Raises:
            UserError: a rule is wrong, or the rules do not ground within their limits.
        """
        self.role = role
        self.action_names = tuple(action_names)
        self._actions = tuple(encode(name) for name in action_names)
        if fallback not in ("all", "stay", "error"):
            raise UserError(f"no fallback '{fallback}'; the fallbacks are all, stay, error")
        if fallback == "stay" and stay not in self.action_names:
            raise UserError(f"the fallback 'stay' needs an action '{stay}'; the actions are {', '.join(action_names)}")
        self.fallback, self._stay = fallback, stay
        self.view_size = view_size
        self._sources, self._vocabulary = read_sources(rules), (*predicates, *DERIVED)
        self._size = (num_factors, num_values)
        words = " ".join(source.text for source in self._sources)
        # only what some rule mentions can matter
        self.predicates = tuple(name for name in predicates if encode(name) in words)
        self._uses_code = re.search(rf"\b{role.code}\s*\(", words) is not None
        programs = [*self._sources, self._encoding()]
        answer = solve(programs, self._situation_program(), (), time_limit=time_limit, memory_mb=memory_mb)
        self._check_words(answer.notes)
        self._ground()
        self._check_actions()

    def _check_words(self, notes: Sequence[str]) -> None:
        """A misspelt word would make a rule that never applies: what nothing defines is a mistake."""
        other = PERSON if self.role == ROBOT else ROBOT
        for note in notes:
            place, undefined, atom = note.partition(": info: atom does not occur in any rule head: ")
            name, _, argument = atom.partition("(")
            if not undefined or name in (other.view, other.code):
                continue
            known = f"nothing makes {atom} true; #defined {name}/{atom.count(',') + 1}. if that is meant"
            if name == self.role.view:
                close = difflib.get_close_matches(argument.rstrip(")"), [encode(p) for p in self._vocabulary], n=1)
                known = "no such predicate" + (f" (did you mean '{close[0]}'?)" if close else "")
            raise UserError(f"{place}: {atom}: {known}")
        words = " ".join(source.text for source in self._sources)
        heads = [head for role in (ROBOT, PERSON) for head in (role.forbidden, role.preferred) if head]
        if words.strip() and not re.search(rf"\b({'|'.join(heads)})\b", words):
            name = self._sources[0].name
            raise UserError(f"{name}: no rule has one of the heads {', '.join(heads)}; is one misspelt?")

    def _check_actions(self) -> None:
        """Whether what rules forbid or prefer are actions.

        Raises:
            UserError: one is not.
        """
        for head in filter(None, (self.role.forbidden, self.role.preferred)):
            for atom in self._control.symbolic_atoms.by_signature(head, 1):
                if str(atom.symbol.arguments[0]) not in self._actions:
                    raise UserError(
                        f"{self._sources[0].name}: {atom.symbol}: no such action; "
                        f"the actions are {', '.join(self._actions)}"
                    )

    @property
    def speaks(self) -> bool:
        """Whether some rule is about this role's actions at all."""
        words = " ".join(source.text for source in self._sources)
        return (
            re.search(rf"\b({'|'.join(filter(None, (self.role.forbidden, self.role.preferred)))})\b", words) is not None
        )

    def _encoding(self) -> Source:
        return Source(self.role.encoding, (ENCODINGS / self.role.encoding).read_text(encoding="utf-8"), own=True)

    def _ground(self) -> None:
        """Ground the rules in this process: they are known to be harmless by now."""
        labelled = [_labelled(source, self.role) for source in self._sources]
        self._control = clingo.Control(["--warn=none", "--models=1"])
        for text in (*labelled, self._encoding().text, self._situation_program()):
            self._control.add("base", [], text)
        self._control.ground([("base", [])])
        self._inputs = [
            (atom.literal, atom.symbol)
            for name, arity in ((self.role.code, 2), (self.role.view, 1), ("person", 3), ("unseen", 0))
            for atom in self._control.symbolic_atoms.by_signature(name, arity)
            if atom.is_external
        ]
        # externals are free while assumptions fix every one of them
        for literal, _ in self._inputs:
            self._control.assign_external(literal, None)
        self._memory: dict[tuple[object, ...], Advice] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Everything but what was grounded: another process grounds the rules anew."""
        return {name: value for name, value in vars(self).items() if name not in ("_control", "_inputs", "_memory")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._ground()

    def _situation_program(self) -> str:
        size = self.view_size
        num_factors, num_values = self._size
        lines = [f"viewer({size // 2},{size - 1})."]
        if self.role == ROBOT:
            lines.append("#external unseen.")
            lines.append(f"#external person(X,Y,H) : X = 0..{size - 1}, Y = 0..{size - 1}, H = 0..3.")
        lines += [f"#external {self.role.view}({encode(name)})." for name in self.predicates]
        lines += [f"action({name})." for name in self._actions]
        if self._uses_code:
            lines.append(f"#external {self.role.code}(F,V) : F = 0..{num_factors - 1}, V = 0..{num_values - 1}.")
        return "\n".join(lines)

    def advise(self, code: np.ndarray, truth: np.ndarray, configuration: int) -> Advice:
        """What the rules say in one situation.

        Args:
            code: integers [N].
            truth: bool [P']: the predicates of `self.predicates` in the view.
            configuration: where the person is seen: 0 unseen, else 1 + ((vx * size) + vy) * 4 + heading.

        Raises:
            UserError: the rules forbid every action and the fallback is `error`.
        """
        key = (bytes(np.asarray(code, dtype=np.int64)) if self._uses_code else b"", bytes(truth), int(configuration))
        if key not in self._memory:
            self._memory[key] = self._ask(code, truth, int(configuration))
        return self._memory[key]

    def mask(self, codes: np.ndarray, truth: np.ndarray, configurations: np.ndarray) -> np.ndarray:
        """Which actions are allowed in many situations.

        Args:
            codes: uint8 [B, N].
            truth: bool [B, P']: the predicates of `self.predicates` in the views.
            configurations: integers [B].

        Returns:
            bool [B, A], at least one true in every row.

        Raises:
            UserError: the shapes do not fit, or as `advise`.
        """
        if truth.shape != (len(codes), len(self.predicates)) or configurations.shape != (len(codes),):
            raise UserError(
                f"a shield with {len(self.predicates)} predicates needs truth [B, {len(self.predicates)}] and "
                f"configurations [B], found {list(truth.shape)} and {list(configurations.shape)}"
            )
        rows = [self.advise(c, t, int(x)).allowed for c, t, x in zip(codes, truth, configurations, strict=True)]
        return np.array(rows, dtype=bool).reshape(len(codes), len(self._actions))

    def constrain(self, probabilities: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """A distribution over actions without the forbidden ones: knowledge from people as a prior.

        With a shield over the person's actions (`PERSON`: "a person facing a wall does not walk forward"), this
        constrains the influence I(u | l), see planners.person_following.influence_rules.

        Args:
            probabilities: float [B, A], rows sum to 1.
            mask: bool [B, A], as from `mask`.

        Returns:
            float64 [B, A]: forbidden entries 0, rows renormalised; uniform over the allowed actions where the
            distribution held only forbidden ones possible.

        Raises:
            UserError: the shapes do not fit.
        """
        if probabilities.shape != mask.shape or mask.shape[1:] != (len(self._actions),):
            raise UserError(
                f"expected two arrays [B, {len(self._actions)}], found {list(probabilities.shape)} and "
                f"{list(mask.shape)}"
            )
        kept = np.where(mask, probabilities, 0.0)
        totals = kept.sum(axis=1, keepdims=True)
        uniform = mask / mask.sum(axis=1, keepdims=True)
        return np.where(totals > 0, kept / np.where(totals > 0, totals, 1.0), uniform)

    def _ask(self, code: np.ndarray, truth: np.ndarray, configuration: int) -> Advice:
        view, at = self.role.view, self.role.code
        true = {clingo.Function(view, [clingo.parse_term(encode(self.predicates[p]))]) for p in np.flatnonzero(truth)}
        if self._uses_code:
            true |= {clingo.Function(at, [clingo.Number(f), clingo.Number(int(v))]) for f, v in enumerate(code)}
        if configuration == 0:
            true.add(clingo.Function("unseen"))
        else:
            cell, heading = divmod(configuration - 1, 4)
            x, y = divmod(cell, self.view_size)
            true.add(clingo.Function("person", [clingo.Number(x), clingo.Number(y), clingo.Number(heading)]))
        assumptions = [literal if symbol in true else -literal for literal, symbol in self._inputs]
        shown: list[clingo.Symbol] = []
        result = self._control.solve(
            assumptions=assumptions, on_model=lambda model: shown.extend(model.symbols(shown=True))
        )
        if not result.satisfiable:
            raise UserError("the rules of the shield contradict each other in some situation (no model)")
        return self._advice(shown)

    def _advice(self, shown: Sequence[clingo.Symbol]) -> Advice:
        said: dict[str, set[str]] = {self.role.forbidden: set(), self.role.preferred: set()}
        places: dict[str, list[str]] = {}
        for symbol in shown:
            if symbol.name == "because":
                action, place = symbol.arguments
                places.setdefault(str(action), []).append(place.string)
            else:
                said[symbol.name].add(str(symbol.arguments[0]))
        forbidden = said[self.role.forbidden]
        allowed = tuple(action not in forbidden for action in self._actions)
        because = {
            name: tuple(sorted(places.get(action, ())))
            for name, action in zip(self.action_names, self._actions, strict=True)
            if action in forbidden
        }
        conflict = not any(allowed)
        if conflict:
            if self.fallback == "error":
                every = sorted({place for found in because.values() for place in found})
                raise UserError(f"the shield leaves no action; these rules conflict: {', '.join(every)}")
            allowed = tuple(self.fallback == "all" or name == self._stay for name in self.action_names)
        preferred = tuple(action in said[self.role.preferred] for action in self._actions)
        return Advice(allowed, preferred, because, conflict)


def _labelled(source: Source, role: Role) -> str:
    """The rules, and for each that forbids an action one that says where it stands."""
    lines: list[str] = []

    def add(statement: ast.AST) -> None:
        lines.append(str(statement))
        if statement.ast_type != ast.ASTType.Rule or statement.head.ast_type != ast.ASTType.Literal:
            return
        atom = statement.head.atom
        if atom.ast_type != ast.ASTType.SymbolicAtom or statement.head.sign != ast.Sign.NoSign:
            return
        term = atom.symbol
        if term.ast_type != ast.ASTType.Function or term.name != role.forbidden or len(term.arguments) != 1:
            return
        begin = statement.location.begin
        place = f"{source.name}:{begin.line}:{source.column(begin.line, begin.column)}"
        place = str(clingo.String(place.encode("utf-8", "backslashreplace").decode()))
        body = ", ".join(str(literal) for literal in statement.body)
        reason = f"because({term.arguments[0]},{place})"
        lines.append(f"{reason} :- {body}." if body else f"{reason}.")

    messages: list[str] = []
    try:
        ast.parse_string(source.text, add, logger=lambda code, message: messages.append(message))
    except RuntimeError as error:
        text = " ".join("; ".join(messages).replace("<string>", source.name).split())
        raise UserError(text or f"{source.name}: {error}") from None
    return "\n".join(lines)
