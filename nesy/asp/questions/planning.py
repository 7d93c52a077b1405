"""Plans of most probable outcomes to a goal, and what must, can and cannot hold after a plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nesy.asp.program.conditions import Literal, of_factor, parse_literals
from nesy.asp.program.encoding import ENCODINGS, run_encoding
from nesy.asp.program.facts import Facts
from nesy.asp.program.names import encode
from nesy.asp.program.solver import solve
from nesy.asp.program.sources import Programs, Source, read_sources
from nesy.dbn.codebook import Codebook
from nesy.dbn.inference.exact import likely_next
from nesy.dbn.inference.plans import follow
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.rows import unique_rows
from nesy.errors import UserError

MAX_CODES = 20_000
MAX_OUTCOMES = 50_000
HOPE = 0.01
CUTS = (1e-6, 1e-5, 1e-4, 1e-3)
"""Outcomes that are left out are at most so probable: the first that leaves few enough others."""


@dataclass(frozen=True)
class Plan:
    """A plan, or that there is none."""

    actions: tuple[str, ...] | None
    """The actions; None if no plan was found."""
    codes: tuple[tuple[int, ...], ...]
    """The codes it leads through if every outcome is the most probable one."""
    path_probability: float
    """Probability of exactly these outcomes, from the model."""
    goal_probability: float
    """Probability that the goal holds at the end, whatever the outcomes on the way: exact but for `dropped`."""
    dropped: float
    """Probability of the outcomes left out as too improbable: the goal is at most so much more probable."""
    exhausted: bool
    """Without a plan: whether all plans up to the limit were searched (by most probable outcomes)."""


class PredicateTruth:
    """What holds in a code: the predicates of the views that have it."""

    def __init__(self, codebook: Codebook) -> None:
        self.codebook = codebook
        self.codes, index = codebook.distinct_codes()
        sizes = np.bincount(index, minlength=len(self.codes))[:, None]
        hits = np.zeros((len(self.codes), codebook.predicates.shape[1]), dtype=np.int64)
        np.add.at(hits, index, codebook.predicates.astype(np.int64))
        # views that share a code may disagree: then neither holds
        self.holds, self.fails = hits == sizes, hits == 0

    def knows(self, codes: np.ndarray) -> np.ndarray:
        """Which codes some view met has: bool [n]."""
        return self._places(codes) >= 0

    def of(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where predicates hold and fail: two bool [n, P]; both false for a code that no view met has."""
        found = self._places(codes)
        known = (found >= 0)[:, None]
        return self.holds[found] & known, self.fails[found] & known

    def _places(self, codes: np.ndarray) -> np.ndarray:
        """Index of each code among `self.codes`, -1 where it is none of them."""
        both = np.concatenate([self.codes, np.asarray(codes)])
        _, index, _ = unique_rows(both)
        place = np.full(int(index.max(initial=-1)) + 1, -1)
        place[index[: len(self.codes)]] = np.arange(len(self.codes))
        return np.asarray(place[index[len(self.codes) :]])


def satisfied(literals: Sequence[Literal], codes: np.ndarray, truth: PredicateTruth | None) -> np.ndarray:
    """Which codes satisfy all literals: bool [n]; a predicate that a code leaves open is not satisfied."""
    result = np.ones(len(codes), dtype=bool)
    holds, fails = truth.of(codes) if truth is not None else (None, None)
    for literal in literals:
        if literal.predicate and truth is not None and holds is not None and fails is not None:
            column = truth.codebook.predicate_names.index(literal.predicate)
            result &= (holds if literal.kind == "holds" else fails)[:, column]
        elif literal.factor >= 0:
            result &= of_factor(literal, codes)
    return result


def find_plan(
    dbn: TwoSliceDBN,
    codebook: Codebook | None,
    start: np.ndarray,
    goal: str,
    max_steps: int = 12,
    rules: Programs = (),
    most_probable: bool = False,
    time_limit: float = 10.0,
    optimistic: bool = False,
    any_length: bool = False,
    truth: PredicateTruth | None = None,
) -> Plan:
    """The shortest plan of most probable outcomes to a goal.

    With `optimistic`, an action may have any outcome that is at least 0.01 probable (among the 16 most probable):
    together with `most_probable` that is the most probable trajectory to the goal of the least length, and with
    `any_length` besides the most probable one of at most `max_steps` steps.

    Args:
        dbn: the model.
        codebook: what predicates mean; None if the goal names none.
        start: integers [N], the code to start from.
        goal: conditions as in nesy.asp.questions.verification, for example `goal_visible, not wall_ahead`.
        max_steps: longest plan looked for.
        rules: the user's constraints on do(A,T), at(C,T), now(C,P), in rule files or as text.
        most_probable: of the shortest plans, the one whose outcomes are most probable (instead of any).
        time_limit: seconds for each length tried, where there are rules.
        optimistic: whether outcomes other than the most probable one may be hoped for.
        any_length: with `most_probable`, longer plans count too if their outcomes are more probable.
        truth: what holds in the codebook's codes, if that is worked out already.

    Raises:
        UserError: a wrong condition or rule, or more than 20,000 codes are reachable.
    """
    literals = parse_literals(dbn, codebook, goal)
    if not literals:
        raise UserError("a plan needs a goal")
    if truth is None and codebook is not None and len(codebook):
        truth = PredicateTruth(codebook)
    codes, moves, distance = reachable(dbn, start, max_steps, truth, optimistic)
    good = satisfied(literals, codes, truth)
    left = _steps_left(moves, good, max_steps)
    sources = read_sources(rules)
    first = int(distance[good].min(initial=max_steps + 1))
    best: tuple[float, list[int], list[int]] | None = None
    for horizon in range(first, max_steps + 1):
        useful = [m for m in moves if distance[m.source] + 1 + left[m.target] <= horizon]
        layers = _Layers(len(codes), useful, good, horizon, most_probable)
        if best is not None and layers.bound <= best[0]:
            continue
        found = _solve(dbn, codes, layers, sources, truth, time_limit)
        if found is None:
            continue
        chance = {(m.source, m.action, m.target): m.probability for m in useful}
        probability = math.prod(chance[step] for step in zip(found[1], found[0], found[1][1:], strict=False))
        if best is None or probability > best[0]:
            best = (probability, *found)
        if not any_length:
            break
    if best is None:
        return Plan(None, (), 0.0, 0.0, 0.0, True)
    probability, actions, path = best
    goal_probability, lost = _goal_probability(dbn, start, actions, literals, truth)
    names = tuple(dbn.action_names[a] for a in actions)
    return Plan(names, tuple(tuple(int(v) for v in codes[c]) for c in path), probability, goal_probability, lost, True)


@dataclass(frozen=True)
class _Move:
    """A step between two codes, by their numbers."""

    source: int
    action: int
    target: int
    probability: float


def _steps_left(moves: Sequence[_Move], good: np.ndarray, max_steps: int) -> np.ndarray:
    """Fewest steps from each code to a good one; max_steps + 1 where there is no way."""
    left = np.where(good, 0, max_steps + 1)
    sources = np.array([m.source for m in moves], dtype=np.int64)
    targets = np.array([m.target for m in moves], dtype=np.int64)
    for _ in range(max_steps if len(moves) else 0):
        before = left.copy()
        np.minimum.at(left, sources, before[targets] + 1)
        if (left == before).all():
            break
    return left


def reachable(
    dbn: TwoSliceDBN, start: np.ndarray, max_steps: int, truth: PredicateTruth | None, optimistic: bool
) -> tuple[np.ndarray, list[_Move], np.ndarray]:
    """Codes and moves that most probable (or hoped for) outcomes lead to within some steps.

    Where it is known which codes were met, the most probable outcome is the most probable of those, and a code
    that was not met is a dead end: its rows are guesses.

    Returns:
        uint8 [C, N] (the start first), the moves, and the number of steps to each code.
    """
    codes = dbn._codes(start)[None].astype(dbn.code_type)
    number = {bytes(codes[0]): 0}
    distance, moves = [0], []
    edge = [0]
    for step in range(1, max_steps + 1):
        if not edge:
            break
        new: list[np.ndarray] = []
        for a in range(dbn.num_actions):
            for source, later, weight in _outcomes(dbn, codes[edge], a, truth, optimistic):
                key = bytes(later)
                if key not in number:
                    number[key] = len(codes) + len(new)
                    new.append(later)
                moves.append(_Move(edge[source], a, number[key], float(weight)))
        if not new:
            break
        added = np.stack(new)
        met = np.ones(len(new), dtype=bool) if truth is None else truth.knows(added)
        edge = (len(codes) + np.flatnonzero(met)).tolist()
        codes = np.concatenate([codes, added])
        distance += [step] * len(new)
        if len(codes) > MAX_CODES:
            raise UserError(f"more than {MAX_CODES} codes can be reached in {step} steps; lower max_steps")
    return codes, moves, np.array(distance)


def _outcomes(
    dbn: TwoSliceDBN, codes: np.ndarray, action: int, truth: PredicateTruth | None, optimistic: bool
) -> list[tuple[int, np.ndarray, float]]:
    """(index of the code, next code, probability) of the outcomes that count."""
    later, weights = likely_next(dbn, codes, action)
    known = np.ones(weights.shape, dtype=bool)
    if truth is not None:
        known = truth.knows(later.reshape(-1, later.shape[2])).reshape(weights.shape)
    # the most probable one that was met, or the most probable at all
    chosen = np.zeros(weights.shape, dtype=bool)
    chosen[np.arange(len(codes)), known.argmax(axis=1)] = True
    if optimistic:
        chosen |= known & (weights >= HOPE)
    return [(int(b), later[b, w], float(weights[b, w])) for b, w in zip(*np.nonzero(chosen), strict=True)]


class _Layers:
    """The moves of each step of a plan of some length, with reduced costs.

    The reduced cost of a move is its cost -1000 log p, plus the least cost from there to the goal, less the least
    cost from where it starts: 0 along a most probable plan, and nowhere negative.
    """

    def __init__(self, codes: int, moves: Sequence[_Move], good: np.ndarray, horizon: int, weighted: bool) -> None:
        self.horizon = horizon
        self.source, self.action, self.target = (
            np.array([getattr(m, name) for m in moves], dtype=np.int64) for name in ("source", "action", "target")
        )
        chance = np.array([m.probability for m in moves])
        cost = -1000 * np.log(np.maximum(chance, 1e-12)) if weighted else np.zeros(len(moves))
        rest = np.where(good, 0.0, np.inf)
        steps = []
        for _ in range(horizon):
            whole = cost + rest[self.target]
            rest = np.full(codes, np.inf)
            np.minimum.at(rest, self.source, whole)
            steps.append((whole, rest))
        self.bound = math.exp(-float(rest[0]) / 1000) if len(rest) else 0.0
        """No plan of this length has outcomes more probable than this."""
        here = np.zeros(codes, dtype=bool)
        here[0] = True
        self.moves: list[tuple[np.ndarray, np.ndarray]] = []
        """For each step the numbers of its moves, and their reduced costs."""
        for whole, start in reversed(steps):
            chosen = np.flatnonzero(here[self.source] & np.isfinite(whole))
            self.moves.append((chosen, whole[chosen] - start[self.source[chosen]]))
            here = np.zeros(codes, dtype=bool)
            here[self.target[chosen]] = True

    def facts(self, actions: Sequence[str], cheapest: bool) -> list[str]:
        """Facts succ/4 and cost/5; only the moves without reduced cost if `cheapest`."""
        lines = []
        for step, (chosen, costs) in enumerate(self.moves):
            for m, cost in zip(chosen.tolist(), costs.tolist(), strict=True):
                if cheapest and cost > 1e-6:
                    continue
                move = f"{self.source[m]},{actions[self.action[m]]},{self.target[m]},{step}"
                lines.append(f"succ({move})." + (f" cost({move},{round(cost)})." if round(cost) else ""))
        return lines


def _solve(
    dbn: TwoSliceDBN,
    codes: np.ndarray,
    layers: _Layers,
    sources: list[Source],
    truth: PredicateTruth | None,
    time_limit: float,
) -> tuple[list[int], list[int]] | None:
    facts = Facts(dbn, None)
    horizon = layers.horizon
    # without rules any plan along moves without reduced cost is best
    lines = [f"horizon({horizon}).", "start(0).", *layers.facts(facts.actions, cheapest=not sources)]
    if sources and truth is not None:
        holds, _ = truth.of(codes)
        names = [encode(name) for name in truth.codebook.predicate_names]
        used = [p for p, name in enumerate(names) if any(name in source.text for source in sources)]
        lines += [f"now({c},{names[p]})." for p in used for c in np.flatnonzero(holds[:, p]).tolist()]
    text = "\n".join(lines)
    if sources:
        encoding = Source("plan.lp", (ENCODINGS / "plan.lp").read_text(encoding="utf-8"), own=True)
        answer = solve([*sources, encoding], text, (), time_limit=time_limit, core_guided=True)
        atoms = (
            [] if not answer.models else [_parse(atom) for atom in answer.models[-1] if atom.startswith(("do(", "at("))]
        )
    else:
        atoms = [
            (atom.name, str(atom.arguments[0]), atom.arguments[1].number) for atom in run_encoding(("plan",), text)
        ]
    if not atoms:
        return None
    steps = {t: facts.actions.index(a) for name, a, t in atoms if name == "do"}
    path = {t: int(c) for name, c, t in atoms if name == "at"}
    return [steps[t] for t in range(horizon)], [path[t] for t in range(horizon + 1)]


def _parse(atom: str) -> tuple[str, str, int]:
    name, arguments = atom.rstrip(")").split("(", 1)
    first, step = arguments.rsplit(",", 1)
    return name, first, int(step)


def _goal_probability(
    dbn: TwoSliceDBN, start: np.ndarray, plan: list[int], literals: list[Literal], truth: PredicateTruth | None
) -> tuple[float, float]:
    """The probability of the goal after a plan (at least), and the mass of the outcomes left out."""
    about_factors = all(literal.factor >= 0 for literal in literals)
    factors = sorted({literal.factor for literal in literals}) if about_factors else None
    codes, weights, _ = outcomes_of(dbn, start, plan, factors)
    return float(weights[satisfied(literals, codes, truth)].sum()), max(0.0, 1.0 - float(weights.sum()))


def outcomes_of(
    dbn: TwoSliceDBN, start: np.ndarray, plan: Sequence[int], factors: Sequence[int] | None = None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Codes that a plan leads to, their exact probabilities, and up to which probability branches were cut.

    Raises:
        UserError: there are too many even of the probable ones.
    """
    for drop in CUTS:
        try:
            return (*follow(dbn, start, plan, factors, most=MAX_OUTCOMES, drop=drop), drop)
        except UserError:
            if drop == CUTS[-1]:
                raise
    raise AssertionError
