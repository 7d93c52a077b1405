"""Plans of most probable outcomes to a goal, and what must, can and cannot hold after a plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nesy.asp.conditions import Literal, of_factor, parse_literals
from nesy.asp.encoding import ENCODINGS, run_encoding
from nesy.asp.facts import LEAST, Facts, asp_name
from nesy.asp.solver import solve
from nesy.asp.sources import Source, read_sources
from nesy.dbn.codebook import Codebook
from nesy.dbn.inference import likely_next
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.plans import follow, pruned
from nesy.dbn.rows import unique_rows
from nesy.errors import UserError

MAX_CODES = 20_000
MAX_OUTCOMES = 50_000
HOPE = 0.01
SAMPLES = 20_000


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
    """Probability that the goal holds at the end, whatever the outcomes on the way."""
    exact: bool
    """Whether `goal_probability` is computed; otherwise it is the share of 20,000 sampled rollouts."""
    dropped: float
    """Values of a row below 0.001 were left out for an exact `goal_probability`: the most a row lost."""
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
        both = np.concatenate([self.codes, np.asarray(codes, dtype=np.uint8)])
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
    rules: Sequence[str | Path] = (),
    most_probable: bool = False,
    time_limit: float = 10.0,
    optimistic: bool = False,
) -> Plan:
    """The shortest plan of most probable outcomes to a goal.

    With `optimistic`, an action may have any outcome that is at least 0.01 probable (among the 16 most probable):
    together with `most_probable` that is the most probable trajectory to the goal of the least length.

    Args:
        dbn: the model.
        codebook: what predicates mean; None if the goal names none.
        start: integers [N], the code to start from.
        goal: conditions as in nesy.asp.verification, for example `goal_visible, not wall_ahead`.
        max_steps: longest plan looked for.
        rules: the user's constraints on do(A,T), at(C,T), now(C,P), in rule files or as text.
        most_probable: of the shortest plans, the one whose outcomes are most probable (instead of any).
        time_limit: seconds for each length tried, where there are rules.
        optimistic: whether outcomes other than the most probable one may be hoped for.

    Raises:
        UserError: a wrong condition or rule, or more than 20,000 codes are reachable.
    """
    literals = parse_literals(dbn, codebook, goal)
    if not literals:
        raise UserError("a plan needs a goal")
    truth = PredicateTruth(codebook) if codebook is not None and len(codebook) else None
    codes, moves, distance = _reachable(dbn, start, max_steps, truth, optimistic)
    good = satisfied(literals, codes, truth)
    left = _steps_left(moves, good, max_steps)
    sources = read_sources(list(rules))
    first = int(distance[good].min(initial=max_steps + 1))
    lengths = range(first, max_steps + 1)
    for horizon in lengths if sources or first <= max_steps else ():
        useful = [m for m in moves if distance[m.source] + 1 + left[m.target] <= horizon]
        found = _solve(dbn, codes, useful, good, horizon, sources, most_probable, truth, time_limit)
        if found is not None:
            actions, path = found
            lost, goal_probability, exact = _goal_probability(dbn, start, actions, literals, truth)
            chance = {(m.source, m.action, m.target): m.probability for m in moves}
            steps = zip(path, actions, path[1:], strict=False)
            probability = math.prod(chance[step] for step in steps)
            names = tuple(dbn.action_names[a] for a in actions)
            chain = tuple(tuple(int(v) for v in codes[c]) for c in path)
            return Plan(names, chain, probability, goal_probability, exact, lost, True)
    return Plan(None, (), 0.0, 0.0, True, 0.0, True)


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


def _reachable(
    dbn: TwoSliceDBN, start: np.ndarray, max_steps: int, truth: PredicateTruth | None, optimistic: bool
) -> tuple[np.ndarray, list[_Move], np.ndarray]:
    """Codes and moves that most probable (or hoped for) outcomes lead to within some steps.

    Where it is known which codes were met, the most probable outcome is the most probable of those, and a code
    that was not met is a dead end: its rows are guesses.

    Returns:
        uint8 [C, N] (the start first), the moves, and the number of steps to each code.
    """
    codes = dbn._codes(start)[None].astype(np.uint8)
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


def _solve(
    dbn: TwoSliceDBN,
    codes: np.ndarray,
    moves: Sequence[_Move],
    good: np.ndarray,
    horizon: int,
    sources: list[Source],
    most_probable: bool,
    truth: PredicateTruth | None,
    time_limit: float,
) -> tuple[list[int], list[int]] | None:
    facts = Facts(dbn, None)
    lines = [f"horizon({horizon}).", "start(0)."] + [f"goal({c})." for c in np.flatnonzero(good).tolist()]
    for m in moves:
        lines.append(f"succ({m.source},{facts.actions[m.action]},{m.target}).")
        if most_probable:
            cost = round(-1000 * math.log(max(m.probability, 1e-12)))
            lines.append(f"cost({m.source},{facts.actions[m.action]},{m.target},{cost}).")
    if sources and truth is not None:
        holds, _ = truth.of(codes)
        names = [asp_name(name) for name in truth.codebook.predicate_names]
        used = [p for p, name in enumerate(names) if any(name in source.text for source in sources)]
        lines += [f"now({c},{names[p]})." for p in used for c in np.flatnonzero(holds[:, p]).tolist()]
    text = "\n".join(lines)
    if sources:
        encoding = Source("plan.lp", (ENCODINGS / "plan.lp").read_text(encoding="utf-8"))
        answer = solve([*sources, encoding], text, (), time_limit=time_limit)
        atoms = [] if not answer.models else [_parse(atom) for atom in answer.models[-1]]
    else:
        atoms = [
            (atom.name, str(atom.arguments[0]), atom.arguments[1].number)
            for atom in run_encoding(("plan",), text, optimise=most_probable)
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
) -> tuple[float, float, bool]:
    """The mass dropped, the probability of the goal after a plan, and whether that is exact."""
    model, lost = pruned(dbn, LEAST)
    try:
        codes, weights = follow(model, start, plan, most=MAX_OUTCOMES)
    except UserError:
        rng = np.random.default_rng(0)
        drawn = np.tile(dbn._codes(start), (SAMPLES, 1))
        for action in plan:
            drawn = dbn.sample(drawn, action, rng)
        return 0.0, float(satisfied(literals, drawn, truth).mean()), False
    return lost, float(weights[satisfied(literals, codes, truth)].sum()), True


@dataclass(frozen=True)
class Aftermath:
    """What holds after a plan."""

    must: tuple[str, ...]
    """Predicates that hold in every possible outcome."""
    cannot: tuple[str, ...]
    """Predicates that hold in none."""
    can: dict[str, float]
    """The others, with their probability (outcomes whose code leaves a predicate open do not count for it)."""
    codes: int
    """Number of possible outcomes."""
    unknown: float
    """Probability of outcomes that are no code met in experience: nothing is known about their predicates."""
    least: float
    """Values of a row less probable than this were taken as impossible."""
    dropped: float
    """The most that a row lost by that."""


def after(dbn: TwoSliceDBN, codebook: Codebook, start: np.ndarray, plan: Sequence[int]) -> Aftermath:
    """What must, can and cannot hold after a plan.

    Values less probable than 0.001 are taken as impossible; where that leaves too many outcomes, those less probable
    than 0.01, or than 0.05. The result says which, and how much a row lost by it.

    Raises:
        UserError: more than 50,000 outcomes are possible even so.
    """
    for least in (LEAST, 10 * LEAST, 50 * LEAST):
        model, lost = pruned(dbn, least)
        try:
            codes, weights = follow(model, start, plan, most=MAX_OUTCOMES)
        except UserError:
            if least == 50 * LEAST:
                raise
        else:
            break
    holds, fails = PredicateTruth(codebook).of(codes)
    known = (holds | fails).any(axis=1)
    probability = weights @ holds
    must, cannot, can = [], [], {}
    for p, name in enumerate(codebook.predicate_names):
        if holds[:, p].all():
            must.append(name)
        elif fails[:, p].all():
            cannot.append(name)
        else:
            can[name] = float(probability[p])
    return Aftermath(tuple(must), tuple(cannot), can, len(codes), float(weights[~known].sum()), least, lost)
