"""Questions to the symbolic model: times beside the limits that they are held against."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.cli.benches.measuring import Row, Settings
from nesy.errors import UserError

if TYPE_CHECKING:
    from nesy.asp import KnowledgeBase
    from nesy.dbn import TwoSliceDBN

NEEDS: tuple[str, ...] = ("extract",)
FACTORS, VALUES = 8, 8
PLAN, STARTS = 6, 20
"""Longest plan, and from how many codes one of that length is looked for."""


def measure(settings: Settings) -> list[Row]:
    """Median milliseconds per question, on random models of 8 factors with 8 values and on the run's own."""
    rows = []
    for parents, limit in ((1, 50.0), (2, 50.0), (3, 500.0), (4, 500.0)):
        dbn = correlated_model(parents, settings.seed)
        for conclusion, what in (("X7!=7", "proof"), ("same", "counterexample")):
            from nesy.asp.questions.verification import verify

            def ask(model: TwoSliceDBN = dbn, wanted: str = conclusion) -> Any:
                return verify(model, None, 0, "X0!=7", wanted)

            assert ask().holds == (what == "proof")
            name = f"one-step verification over all 8^8 codes, tables with {parents} parents, {what}"
            rows.append(_row(name, _median(ask, settings.seconds), limit))
    return rows + _of_the_run(settings)


def correlated_model(parents: int, seed: int) -> TwoSliceDBN:
    """A model in which X7' = 7 is impossible for a reason that no single table shows (with two parents and more).

    X5' and X6' have the parity of X4, whatever else they depend on; X7' can be 7 only where their parities differ.
    Other values are possible at random, in about half of each row.
    """
    from nesy.dbn import TwoSliceDBN

    rng = np.random.default_rng(seed)
    now, later, tables = [], [], []
    parity = np.arange(VALUES) % 2
    for i in range(FACTORS):
        last = parents > 1 and i == 7
        after = [5, 6] if last else []
        first = [4] if i in (5, 6) else []
        others = [p for p in range(FACTORS) if p not in first]
        before = first + rng.choice(others, parents - len(first) - len(after), replace=False).tolist()
        shape = (VALUES,) * parents + (VALUES,)
        possible = rng.random(shape) < 0.5
        possible[..., 0] = True
        if i in (5, 6):
            same = parity[:, None] == parity
            possible[..., 1] = True
            possible &= same.reshape((VALUES,) + (1,) * (parents - 1) + (VALUES,))
        if i == 7 and not last:
            possible[..., 7] = False
        if last:
            differ = parity[:, None] != parity
            possible[..., 7] = np.broadcast_to(differ, shape[:-1])
        weight = possible * rng.dirichlet(np.ones(VALUES), size=shape[:-1]).clip(0.02)
        tables.append((weight / weight.sum(axis=-1, keepdims=True)).reshape(-1, VALUES))
        now.append([int(p) for p in before])
        later.append(after)
    return TwoSliceDBN.from_tables([tables], [now], [later])


def _of_the_run(settings: Settings) -> list[Row]:
    from nesy.asp import KnowledgeBase

    base = KnowledgeBase.from_run(settings.run.path)
    book = base.book
    rng = np.random.default_rng(settings.seed)
    action = base.dbn.action_names[-2]
    start, goal, steps = _farthest(base, rng)
    particles = book.codes[rng.integers(len(book), size=1000)]
    names = [name for name in ("wall_ahead", "goal_visible") if name in book.predicate_names]
    # a code and its opposite: no plan leads to both
    nowhere = f"{goal}, {goal.split(',')[0].replace('=', '!=')}"
    questions: list[tuple[str, Callable[[], Any], float]] = [
        ("factors that an action influences", lambda: base.influenced(action), 20.0),
        (f"shortest plan to a code {steps} steps away", lambda: base.plan(start, goal, PLAN), 150.0),
        (f"that no plan of {PLAN} steps leads to a goal", lambda: base.plan(start, nowhere, PLAN), 150.0),
        ("knows and holds possible, 1000 particles", lambda: base.knows(particles, names), 20.0),
        ("one step of the run's own model, all codes", lambda: base.verify(action, names[0], "same"), 500.0),
    ]
    assert base.plan(start, goal, PLAN).rows[0]["actions"] is not None
    rows = [_row(what, _median(ask, settings.seconds), limit) for what, ask, limit in questions]
    return [*rows, _row("shield, per decision in a new situation", _shield(base, rng), 2.0)]


def _farthest(base: KnowledgeBase, rng: np.random.Generator) -> tuple[np.ndarray, str, int]:
    """A code to start from and one to reach by most probable outcomes, as many steps away as can be found, and these.

    At most `PLAN` steps, from a few codes met; the goal is written as a condition.
    """
    from nesy.dbn.inference.exact import most_probable_next

    found: tuple[int, np.ndarray, np.ndarray] | None = None
    for start in base.book.codes[rng.integers(len(base.book), size=STARTS)]:
        seen, level = {tuple(start.tolist())}, [start.astype(np.int64)]
        for steps in range(1, PLAN + 1):
            following = [
                code
                for action in range(base.dbn.num_actions)
                for code in most_probable_next(base.dbn, np.array(level), action)[0].astype(np.int64)
            ]
            level = [code for code in following if tuple(code.tolist()) not in seen]
            if not level:
                break
            seen |= {tuple(code.tolist()) for code in level}
            if found is None or steps > found[0]:
                found = (steps, start, level[0])
    if found is None:
        raise UserError("no action of this model changes any code: there is nothing to plan")
    steps, start, goal = found
    return start, ", ".join(f"{n}={v}" for n, v in zip(base.dbn.factor_names, goal.tolist(), strict=True)), steps


def _shield(base: KnowledgeBase, rng: np.random.Generator) -> float:
    """Median milliseconds of decisions in situations that were not met before."""
    action = base.dbn.action_names[-2]
    shield = base.shield(
        [f"forbidden({action}) :- now(wall_ahead). forbidden({action}) :- at(0,7), now(person_ahead)."]
    )
    spent = []
    for _ in range(300):
        code = rng.integers(base.dbn.num_values, size=base.dbn.num_factors).astype(np.uint8)
        truth = rng.random(len(shield.predicates)) < 0.5
        started = time.process_time()
        shield.advise(code, truth, int(rng.integers(101)))
        spent.append(time.process_time() - started)
    return 1000 * float(np.median(spent))


def _median(ask: Callable[[], Any], seconds: float) -> float:
    """Median milliseconds of a call, after one to warm up."""
    ask()
    spent: list[float] = []
    while sum(spent) < seconds or len(spent) < 3:
        started = time.process_time()
        ask()
        spent.append(time.process_time() - started)
    return 1000 * float(np.median(spent))


def _row(what: str, milliseconds: float, limit: float) -> Row:
    return Row(what, milliseconds, "ms", f"limit {limit:g} ms", limit / max(milliseconds, 1e-9))
