"""Plans of most probable outcomes to a goal, and what must, can and cannot hold after a plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nesy.asp.encoding import ENCODINGS, run_encoding
from nesy.asp.facts import LEAST, Facts, asp_name
from nesy.asp.solver import solve
from nesy.asp.sources import Source, read_sources
from nesy.asp.verification import Literal, parse_literals
from nesy.dbn.codebook import Codebook
from nesy.dbn.inference import likely_next
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.plans import follow, pruned
from nesy.dbn.rows import unique_rows
from nesy.errors import UserError

MAX_CODES = 20_000
MAX_OUTCOMES = 50_000
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
        if literal.predicate is not None and truth is not None and holds is not None and fails is not None:
            column = truth.codebook.predicate_names.index(literal.predicate)
            result &= (holds if literal.term.startswith("holds") else fails)[:, column]
        elif literal.factor is not None:
            value = int(literal.term.rstrip(")").rsplit(",", 1)[1])
            same = np.asarray(codes)[:, literal.factor] == value
            result &= same if literal.term.startswith("is(") else ~same
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
) -> Plan:
    """The shortest plan of most probable outcomes to a goal.

    Args:
        dbn: the model.
        codebook: what predicates mean; None if the goal names none.
        start: integers [N], the code to start from.
        goal: conditions as in nesy.asp.verification, for example `goal_visible, not wall_ahead`.
        max_steps: longest plan looked for.
        rules: the user's constraints on do(A,T), at(C,T), now(C,P), in rule files or as text.
        most_probable: of the shortest plans, the one whose outcomes are most probable (instead of any).
        time_limit: seconds for each length tried, where there are rules.

    Raises:
        UserError: a wrong condition or rule, or more than 20,000 codes are reachable.
    """
    literals = parse_literals(dbn, codebook, goal)
    if not literals:
        raise UserError("a plan needs a goal")
    truth = PredicateTruth(codebook) if codebook is not None and len(codebook) else None
    codes, successors, weights, distance = _reachable(dbn, start, max_steps, truth)
    good = satisfied(literals, codes, truth)
    sources = read_sources(list(rules))
    first = int(distance[good].min(initial=max_steps + 1))
    lengths = range(first, max_steps + 1)
    for horizon in lengths if sources or first <= max_steps else ():
        found = _solve(
            dbn, codes, successors, weights, distance, good, horizon, sources, most_probable, truth, time_limit
        )
        if found is not None:
            actions, path = found
            lost, goal_probability, exact = _goal_probability(dbn, start, actions, literals, truth)
            steps = zip(path, actions, strict=False)
            probability = math.prod(float(weights[c, a]) for c, a in steps)
            names = tuple(dbn.action_names[a] for a in actions)
            chain = tuple(tuple(int(v) for v in codes[c]) for c in path)
            return Plan(names, chain, probability, goal_probability, exact, lost, True)
    return Plan(None, (), 0.0, 0.0, True, 0.0, True)


def _reachable(
    dbn: TwoSliceDBN, start: np.ndarray, max_steps: int, truth: PredicateTruth | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Codes that most probable outcomes lead to within some steps.

    Where it is known which codes were met, the most probable outcome is the most probable of those, and a code
    that was not met is a dead end: its rows are guesses.

    Returns:
        uint8 [C, N] (the start first), successors int64 [C, A] (-1: not looked at), their probabilities, and the
        number of steps to each code.
    """
    codes = dbn._codes(start)[None].astype(np.uint8)
    distance = np.zeros(1, dtype=np.int64)
    successors = np.full((1, dbn.num_actions), -1, dtype=np.int64)
    weights = np.zeros((1, dbn.num_actions))
    edge = np.array([0])
    for step in range(1, max_steps + 1):
        if not len(edge):
            break
        outcomes = [_outcome(dbn, codes[edge], a, truth) for a in range(dbn.num_actions)]
        later = np.concatenate([code for code, _ in outcomes])
        first, index, _ = unique_rows(np.concatenate([codes, later]))
        # codes keep their numbers: `first` is the earliest occurrence only if it lies among them
        number = np.full(len(first), -1, dtype=np.int64)
        number[index[: len(codes)]] = np.arange(len(codes))
        new = np.flatnonzero(number < 0)
        number[new] = len(codes) + np.arange(len(new))
        example = np.zeros(len(first), dtype=np.int64)
        example[index[len(codes) :]] = np.arange(len(later))
        successors[edge] = number[index[len(codes) :]].reshape(dbn.num_actions, -1).T
        weights[edge] = np.stack([weight for _, weight in outcomes], axis=1)
        if not len(new):
            break
        added = later[example[new]]
        met = np.ones(len(new), dtype=bool) if truth is None else truth.knows(added)
        edge = len(codes) + np.flatnonzero(met)
        codes = np.concatenate([codes, added])
        if len(codes) > MAX_CODES:
            raise UserError(f"more than {MAX_CODES} codes can be reached in {step} steps; lower max_steps")
        distance = np.concatenate([distance, np.full(len(new), step)])
        successors = np.concatenate([successors, np.full((len(new), dbn.num_actions), -1)])
        weights = np.concatenate([weights, np.zeros((len(new), dbn.num_actions))])
    return codes, successors, weights, distance


def _outcome(
    dbn: TwoSliceDBN, codes: np.ndarray, action: int, truth: PredicateTruth | None
) -> tuple[np.ndarray, np.ndarray]:
    """The most probable next code, of those met where that is known and one of them is likely at all."""
    later, weights = likely_next(dbn, codes, action)
    choice = np.zeros(len(codes), dtype=np.int64)
    if truth is not None:
        choice = truth.knows(later.reshape(-1, later.shape[2])).reshape(weights.shape).argmax(axis=1)
    number = np.arange(len(codes))
    return later[number, choice], weights[number, choice]


def _solve(
    dbn: TwoSliceDBN,
    codes: np.ndarray,
    successors: np.ndarray,
    weights: np.ndarray,
    distance: np.ndarray,
    good: np.ndarray,
    horizon: int,
    sources: list[Source],
    most_probable: bool,
    truth: PredicateTruth | None,
    time_limit: float,
) -> tuple[list[int], list[int]] | None:
    facts = Facts(dbn, None)
    lines = [f"horizon({horizon}).", "start(0)."] + [f"goal({c})." for c in np.flatnonzero(good).tolist()]
    for c, a in zip(*(index.tolist() for index in np.nonzero(successors >= 0)), strict=True):
        if distance[c] < horizon:
            lines.append(f"succ({c},{facts.actions[a]},{successors[c, a]}).")
            if most_probable:
                cost = round(-1000 * math.log(max(float(weights[c, a]), 1e-12)))
                lines.append(f"cost({c},{facts.actions[a]},{cost}).")
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
    dropped: float
    """Values of a row below 0.001 were taken as impossible: the most that a row lost by that."""


def after(dbn: TwoSliceDBN, codebook: Codebook, start: np.ndarray, plan: Sequence[int]) -> Aftermath:
    """What must, can and cannot hold after a plan.

    Raises:
        UserError: more than 2 million codes are possible.
    """
    model, lost = pruned(dbn, LEAST)
    codes, weights = follow(model, start, plan)
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
    return Aftermath(tuple(must), tuple(cannot), can, len(codes), float(weights[~known].sum()), lost)
