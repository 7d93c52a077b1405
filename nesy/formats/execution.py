"""Plans of Fast Downward (the `check` extra) on our PDDL files, decoded and executed in a domain's environment."""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from domains.core import FORWARD, GOAL, Domain
from nesy.dbn.codebook import Codebook
from nesy.dbn.inference import most_probable_next
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from nesy.formats import pddl


def by_fast_downward(dbn: TwoSliceDBN, start: np.ndarray, goals: np.ndarray) -> list[int] | None:
    """A plan along most probable outcomes from a code to one of some codes; None if there is none.

    Raises:
        UserError: Fast Downward is not installed.
    """
    try:
        unified, reader = (importlib.import_module(f"unified_planning.{name}") for name in ("shortcuts", "io"))
        importlib.import_module("up_fast_downward")
    except ImportError:
        raise UserError("Fast Downward is not installed; it comes with: pip install 'nesy[check]'") from None
    unified.get_environment().credits_stream = None
    inside = {tuple(code) for code in pddl.reachable_codes(dbn, start, pddl.known_codes(dbn)).tolist()}
    wanted = np.array([goal for goal in goals.tolist() if tuple(goal) in inside])
    if not len(wanted):
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.pddl"
        pddl.write(dbn, path, start=start, goals=wanted, reachable=True)
        problem = reader.PDDLReader().parse_problem(str(path), str(path.with_name("m_problem.pddl")))
    with unified.OneshotPlanner(name="fast-downward") as planner:
        result = planner.solve(problem)
    if result.plan is None:
        return None
    names = [pddl.action_name(dbn, a) for a in range(dbn.num_actions)]
    return [names.index(step.action.name) for step in result.plan.actions if step.action.name in names]


@dataclass
class Executed:
    """What came of the episodes."""

    episodes: int = 0
    """How many."""
    reached: int = 0
    """In how many the goal was entered."""
    steps: int = 0
    """Steps taken, of all episodes."""
    surprises: int = 0
    """Steps after which the robot saw another view than planned."""
    calls: int = 0
    """Problems given to the planner."""
    unsolved: int = 0
    """Of them those without a plan."""
    wandering: int = 0
    """Random steps, taken where there was no plan."""
    plans: dict[tuple[int, ...], list[int] | None] = field(default_factory=dict)
    """Plans made so far, by the code they start from."""


def execute(
    domain: Domain,
    variant: str,
    dbn: TwoSliceDBN,
    codebook: Codebook,
    encode: Callable[[np.ndarray], np.ndarray],
    episodes: int,
    seed: int,
    longest: int = 60,
) -> Executed:
    """Drive to the goal of the crossing task by plans of Fast Downward, planning again on every surprise.

    The goals are the codes of all views with the goal straight ahead; a plan that has arrived ends with `forward`.
    Where the planner finds none (most probable outcomes never show the goal), a random step is taken.

    Args:
        domain: where.
        variant: of the domain.
        dbn: the model.
        codebook: its views.
        encode: views uint8 [n, v, v] to codes uint8 [n, N].
        episodes: how many, one after the other.
        seed: of maps and random steps.
        longest: steps after which an episode is given up.
    """
    side = codebook.views.shape[1]
    ahead = (side // 2, side - 2)
    goals = np.unique(codebook.codes[codebook.views[:, ahead[0], ahead[1]] == GOAL], axis=0).astype(np.int64)
    there = {tuple(code) for code in goals.tolist()}
    rng = np.random.default_rng(seed)
    environment = domain.make("crossing", 1, variant=variant, seed=seed)
    observation, _ = environment.reset(seed=seed)
    result = Executed()
    for _ in range(episodes):
        result.episodes += 1
        waiting: list[int] = []
        expected: tuple[int, ...] | None = None
        for _ in range(longest):
            code = encode(observation["view"])[0].astype(np.int64)
            place = tuple(code.tolist())
            if expected is not None and place != expected:
                result.surprises += 1
                waiting = []
            if place in there:
                action, expected = FORWARD, None
            else:
                waiting = waiting or _plan(result, dbn, code, goals)
                wanders = not waiting
                result.wandering += wanders
                action = int(rng.integers(3)) if wanders else waiting.pop(0)
                expected = None if wanders else tuple(most_probable_next(dbn, code[None], action, 1)[0][0].tolist())
            observation, reward, terminated, truncated, _ = environment.step(np.array([action]))
            result.steps += 1
            if terminated[0] or truncated[0]:
                result.reached += bool(terminated[0] and reward[0] > 0)
                break
        else:
            observation, _ = environment.reset(seed=seed + result.episodes)
    return result


def _plan(result: Executed, dbn: TwoSliceDBN, code: np.ndarray, goals: np.ndarray) -> list[int]:
    """The plan from a code, made once; empty where there is none."""
    place = tuple(code.tolist())
    if place not in result.plans:
        plan = by_fast_downward(dbn, code, goals)
        result.plans[place] = plan
        result.calls += 1
        result.unsolved += plan is None
    return list(result.plans[place] or ())
