"""Whether plans made in the symbolic model work in the real environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.asp.questions.planning import find_plan
from nesy.dbn.rows import unique_rows
from nesy.errors import UserError

if TYPE_CHECKING:
    from domains.core import Domain
    from nesy.asp.knowledge import KnowledgeBase


def plan_validity(
    base: KnowledgeBase,
    domain: Domain,
    goal: str,
    episodes: int = 50,
    warm_up: int = 5,
    max_steps: int = 8,
    variant: str = "paper",
    seed: int = 0,
    **options: Any,
) -> dict[str, Any]:
    """Plan to a predicate from real views, execute the plans blindly, and look whether the predicate holds.

    The environment shows what a view hides, so even a perfect model cannot make every plan valid.

    Args:
        base: the model and its codebook.
        domain: the real domain; its crossing task is used, if it has one.
        goal: a predicate of the domain.
        episodes: how many plans.
        warm_up: random steps before a plan is made.
        max_steps: longest plan looked for.
        variant: of the domain.
        seed: of maps and steps.
        options: how plans are looked for (see nesy.asp.questions.planning.find_plan).

    Returns:
        `episodes`; `known`: the view was met in experience; of those `found`: there was a plan, `exhausted`: the
        search ended without one; of the plans found `valid`: the predicate held at the end; `mean_length`.

    Raises:
        UserError: no such predicate.
    """
    if base.codebook is None:
        raise UserError("this model has no codebook, so views cannot be turned into codes")
    book = base.codebook
    column = domain.predicates.names.index(goal) if goal in domain.predicates.names else -1
    book.predicate(goal)
    environment = domain.make(domain.spec.model_task, episodes, variant=variant, seed=seed)
    rng = np.random.default_rng(seed)
    observation, _ = environment.reset(seed=seed)
    turns = [base.dbn.action_names.index(name) for name in ("left", "right")]
    for _ in range(warm_up):
        observation = environment.step(rng.choice(turns, size=episodes))[0]
    views = np.array(observation["view"])
    both = np.concatenate([book.views, views]).reshape(len(book) + episodes, -1)
    _, index, _ = unique_rows(both)
    place = np.full(int(index.max()) + 1, -1)
    place[index[: len(book)]] = np.arange(len(book))
    of_view = place[index[len(book) :]]
    plans: dict[int, list[int]] = {}
    for b in np.flatnonzero(of_view >= 0).tolist():
        found = find_plan(base.dbn, book, book.codes[of_view[b]], goal, max_steps, **options)
        if found.actions is not None:
            plans[b] = [base.dbn.action_names.index(name) for name in found.actions]
    stay = base.dbn.action_names.index("stay")
    alive = np.ones(episodes, dtype=bool)
    for step in range(max((len(plan) for plan in plans.values()), default=0)):
        actions = [plans[b][step] if b in plans and step < len(plans[b]) else stay for b in range(episodes)]
        observation, _, terminated, truncated, _ = environment.step(np.array(actions))
        alive &= ~(terminated | truncated)
    truth = domain.predicates.evaluate(np.array(observation["view"]))[:, column]
    # an episode that ended on the way started anew: its view says nothing about the plan
    judged = [b for b in plans if alive[b]]
    known = int((of_view >= 0).sum())
    return {
        "goal": goal,
        "episodes": episodes,
        "known": known,
        "found": len(plans),
        "exhausted": known - len(plans),
        "judged": len(judged),
        "valid": int(sum(bool(truth[b]) for b in judged)),
        "mean_length": float(np.mean([len(plan) for plan in plans.values()])) if plans else 0.0,
    }
