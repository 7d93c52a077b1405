"""Plans of Fast Downward (the `check` extra) on our PDDL files, decoded and executed in a domain's environment."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from domains.core import FORWARD, GOAL, Domain
from nesy.dbn.codebook import Codebook
from nesy.dbn.inference.exact import likely_next
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from nesy.formats import pddl

OPTIONS = (
    *("--translate-options", "--invariant-generation-max-time", "0"),
    *("--search-options", "--search", "astar(blind())"),
)
"""The reachable part has as many states as it has codes: it needs no invariants and no heuristic."""

WANDER = (0.2, 0.2, 0.6)
"""Chances of left, right and forward in a random step."""


def by_fast_downward(
    dbn: TwoSliceDBN, start: np.ndarray, goals: np.ndarray, outcomes: int = 1
) -> list[tuple[int, tuple[int, ...]]] | None:
    """A plan from a code to one of some codes; None if there is none.

    Args:
        dbn: the model.
        start: integers [N].
        goals: integers [G, N].
        outcomes: of a step that the planner may choose among (see nesy.formats.pddl); 1: the most probable one.

    Returns:
        The actions, each with the code that is to follow.

    Raises:
        UserError: Fast Downward is not installed.
    """
    driver = _driver()
    codes = pddl.reachable_codes(dbn, start, pddl.known_codes(dbn), outcomes, goals)
    inside = {tuple(code) for code in codes.tolist()}
    wanted = np.array([goal for goal in goals.tolist() if tuple(goal) in inside])
    if not len(wanted):
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.pddl"
        pddl.write(dbn, path, start=start, goals=wanted, reachable=True, outcomes=outcomes)
        subprocess.run(
            [sys.executable, str(driver), "--plan-file", "plan.txt", "m.pddl", "m_problem.pddl", *OPTIONS],
            cwd=folder,
            check=True,
            capture_output=True,
        )
        steps = (Path(folder) / "plan.txt").read_text().splitlines()
    plan = []
    for step in steps:
        action = pddl.action_of(dbn, step) if step.startswith("(") else None
        if action is not None:
            number, rank = (int(part) for part in (step.strip("() ").split("-")[1:] + ["0"])[:2])
            plan.append((action, tuple(likely_next(dbn, codes[number][None], action)[0][0, rank].tolist())))
    return plan


def _driver() -> Path:
    spec = importlib.util.find_spec("up_fast_downward")
    if spec is None or not spec.submodule_search_locations:
        raise UserError("Fast Downward is not installed; it comes with: pip install 'nesy[check]'")
    return Path(spec.submodule_search_locations[0]) / "downward" / "fast-downward.py"


Plan = list[tuple[int, tuple[int, ...]]]
"""Actions, each with the code that is to follow."""


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
    """Random steps, taken where there was no plan or the plan had been wrong before."""
    plans: dict[tuple[int, ...], Plan | None] = field(default_factory=dict)
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
    outcomes: int = 2,
    in_sight: bool = False,
) -> Executed:
    """Drive to the goal of the crossing task by plans of Fast Downward, planning again on every surprise.

    The goals are the codes of all views with the goal straight ahead; a plan that has arrived ends with `forward`.
    Where the planner finds no plan, or has been wrong at the same code in this episode, a random step is taken: the
    same plan would run in the same circle, since a code does not tell places apart that look alike.

    Args:
        domain: where.
        variant: of the domain.
        dbn: the model.
        codebook: its views.
        encode: views uint8 [n, v, v] to codes uint8 [n, N].
        episodes: how many, one after the other.
        seed: of maps and random steps.
        longest: steps after which an episode is given up.
        outcomes: of a step that the planner may choose among; with 1, the most probable ones, it mostly finds no
            plan from the start, since these never show the goal.
        in_sight: let the task's expert drive until the goal is in view, and plan from there.
    """
    side = codebook.views.shape[1]
    ahead = (side // 2, side - 2)
    goals = np.unique(codebook.codes[codebook.views[:, ahead[0], ahead[1]] == GOAL], axis=0).astype(np.int64)
    there = {tuple(code) for code in goals.tolist()}
    rng = np.random.default_rng(seed)
    environment = domain.make(domain.spec.model_task, 1, variant=variant, seed=seed)
    observation, _ = environment.reset(seed=seed)
    result = Executed()
    for _ in range(episodes):
        result.episodes += 1
        waiting: Plan = []
        wrong: set[tuple[int, ...]] = set()
        before: tuple[int, ...] = ()
        expected: tuple[int, ...] | None = None
        led = in_sight
        for _ in range(longest):
            code = encode(observation["view"])[0].astype(np.int64)
            place = tuple(code.tolist())
            if expected is not None and place != expected:
                result.surprises += 1
                wrong.add(before)
                waiting = []
            led = led and GOAL not in observation["view"][0]
            if led:
                action, expected = int(environment.expert_actions("goal")[0]), None
            elif place in there:
                action, expected = FORWARD, None
            else:
                if not waiting and place not in wrong:
                    waiting = _plan(result, dbn, code, goals, outcomes)
                result.wandering += not waiting
                action, expected = waiting.pop(0) if waiting else (int(rng.choice(3, p=WANDER)), None)
            before = place
            observation, reward, terminated, truncated, _ = environment.step(np.array([action]))
            result.steps += 1
            if terminated[0] or truncated[0]:
                result.reached += bool(terminated[0] and reward[0] > 0)
                break
        else:
            observation, _ = environment.reset(seed=seed + result.episodes)
    return result


def _plan(result: Executed, dbn: TwoSliceDBN, code: np.ndarray, goals: np.ndarray, outcomes: int) -> Plan:
    """The plan from a code, made once; empty where there is none."""
    place = tuple(code.tolist())
    if place not in result.plans:
        plan = by_fast_downward(dbn, code, goals, outcomes)
        result.plans[place] = plan
        # what remains of a plan is the plan from the codes on its way
        for step, (_, there) in enumerate(plan or []):
            result.plans[there] = (plan or [])[step + 1 :]
        result.calls += 1
        result.unsolved += plan is None
    return list(result.plans.get(place) or ())
