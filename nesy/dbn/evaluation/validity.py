"""Does the model hold in the real environment? Plans found in it are executed; its steps are looked for in the maps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from domains.core import ACTION_NAMES, MOST_MAPS, Domain, DomainError
from nesy.dbn.inference.exact import likely_next
from nesy.dbn.inference.kernels import packed, sample_codes
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.rows import code_type, unique_rows

Encode = Callable[[np.ndarray], np.ndarray]
"""Views uint8 [n, v, v] -> codes uint8 [n, N]."""


def likeliest_successors(dbn: TwoSliceDBN, known: np.ndarray) -> np.ndarray:
    """The most probable next code of every known code under every action, as an index: int64 [C, A]; -1 if unknown."""
    result = np.empty((len(known), dbn.num_actions), dtype=np.int64)
    for a in range(dbn.num_actions):
        later = likely_next(dbn, known, a)[0][:, 0]
        _, index, _ = unique_rows(np.concatenate([known, later]))
        place = np.full(int(index.max()) + 1, -1, dtype=np.int64)
        place[index[: len(known)]] = np.arange(len(known))
        result[:, a] = place[index[len(known) :]]
    return result


def commonest_successors(
    view_index: np.ndarray, actions: np.ndarray, next_index: np.ndarray, views: int, num_actions: int
) -> np.ndarray:
    """The commonest next view of every view under every action in experience: int64 [V, A]; -1 where never met."""
    key = (view_index * num_actions + actions) * views + next_index
    kinds, counts = np.unique(key, return_counts=True)
    context, target = kinds // views, kinds % views
    order = np.lexsort((target, -counts, context))
    first = np.unique(context[order], return_index=True)[1]
    result = np.full(views * num_actions, -1, dtype=np.int64)
    result[context[order][first]] = target[order][first]
    return result.reshape(views, num_actions)


def shortest_plan(successors: np.ndarray, start: int, goal: int) -> list[int] | None:
    """The actions of a shortest way along most probable outcomes; None once the search is exhausted."""
    came: dict[int, tuple[int, int]] = {start: (-1, -1)}
    front = [start]
    while front:
        later: list[int] = []
        for place in front:
            for action, following in enumerate(successors[place].tolist()):
                if following >= 0 and following not in came:
                    came[following] = (place, action)
                    later.append(following)
        if goal in came:
            plan: list[int] = []
            while goal != start:
                goal, action = came[goal]
                plan.append(action)
            return plan[::-1]
        front = later
    return None


def walks(
    domain: Domain, variant: str, seed: int, number: int, before: int, longest: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of views some random steps apart on the same map.

    Returns:
        the actions before the first view int64 [before, B], the first views, the second views uint8 [B, v, v], and
        which pairs count bool [B]: no episode ended meanwhile, and the views differ.
    """
    rng = np.random.default_rng(seed)
    environment = domain.make(domain.spec.model_task, number, variant=variant, seed=seed)
    observation, _ = environment.reset(seed=seed)
    actions = rng.choice(len(domain.spec.action_names), size=(before + longest, number), p=_restless(domain))
    length = rng.integers(1, longest + 1, size=number)
    going = np.ones(number, dtype=bool)
    first = second = observation["view"].copy()
    for step, action in enumerate(actions):
        if step == before:
            first = observation["view"].copy()
        observation, _, terminated, truncated, _ = environment.step(action)
        inside = step < before + length
        going &= ~(inside & (terminated | truncated))
        second = np.where(inside[:, None, None], observation["view"], second)
    return actions[:before], first, second, going & (first != second).any(axis=(1, 2))


def _restless(domain: Domain) -> np.ndarray:
    """Chances of the actions of a walk: forward as often as both turns together, so that it gets somewhere."""
    names = domain.spec.action_names
    if names == ACTION_NAMES:
        return np.array([0.25, 0.25, 0.5, 0.0])
    return np.full(len(names), 1.0 / len(names))


def plan_validity(
    domain: Domain, variant: str, seed: int, planners: dict[str, tuple[np.ndarray, Encode]], number: int = 300
) -> dict[str, Any]:
    """Plans from one view to another, found along most probable outcomes and executed on the real map.

    Args:
        domain: where.
        variant: of the domain.
        seed: of maps and walks.
        planners: by name, successors int64 [C, A] and what gives the index of a view among them (-1: unknown).
        number: pairs of views.

    Returns:
        `asked`, and per planner `found` (share of the pairs), `exhausted` (the search ended without a plan),
        `valid` (share of the plans found after which the goal's view is really seen), `length` (mean).
    """
    prefix, first, second, counted = walks(domain, variant, seed, number, before=6, longest=8)
    pairs = np.flatnonzero(counted)
    result: dict[str, Any] = {"asked": len(pairs)}
    for name, (successors, index_of) in planners.items():
        starts, goals = index_of(first), index_of(second)
        plans: dict[int, list[int]] = {}
        for b in pairs.tolist():
            if starts[b] >= 0 and goals[b] >= 0:
                plan = shortest_plan(successors, int(starts[b]), int(goals[b]))
                if plan is not None:
                    plans[b] = plan
        ends = _execute(domain, variant, seed, prefix, plans, len(first))
        valid = [bool((ends[b] == second[b]).all()) for b in plans]
        result[name] = {
            "found": len(plans) / max(1, len(pairs)),
            "exhausted": 1.0 - len(plans) / max(1, len(pairs)),
            "valid": float(np.mean(valid)) if valid else 0.0,
            "length": float(np.mean([len(plan) for plan in plans.values()])) if plans else 0.0,
        }
    return result


def _execute(
    domain: Domain, variant: str, seed: int, prefix: np.ndarray, plans: dict[int, list[int]], number: int
) -> dict[int, np.ndarray]:
    """The view at the end of every plan; an ending on the way leaves the last view of that episode."""
    environment = domain.make(domain.spec.model_task, number, variant=variant, seed=seed)
    observation, _ = environment.reset(seed=seed)
    for action in prefix:
        observation, *_ = environment.step(action)
    ends = {b: observation["view"][b].copy() for b in plans}
    going = dict.fromkeys(plans, True)
    for step in range(max((len(plan) for plan in plans.values()), default=0)):
        actions = np.zeros(number, dtype=np.int64)
        for b, plan in plans.items():
            actions[b] = plan[step] if step < len(plan) else 0
        _, _, terminated, truncated, infos = environment.step(actions)
        for b, plan in plans.items():
            if step < len(plan) and going[b]:
                ends[b] = infos["final_obs"]["view"][b].copy()
                going[b] = not (terminated[b] or truncated[b])
    return ends


def impossible_steps(
    dbn: TwoSliceDBN, domain: Domain, variant: str, encode: Encode, seed: int, samples: int = 20_000
) -> dict[str, float]:
    """How often the model does what no map can.

    Args:
        dbn: the model.
        domain: whose maps.
        variant: of the domain.
        encode: views to codes.
        seed: of the draws.
        samples: steps drawn from possible codes (all alike) under random actions.

    Returns:
        Shares of the steps drawn: `states` lead to a code that is the code of no view of any map, `transitions` are
        steps that no map allows; `likeliest`: of all possible codes and actions, those whose most probable next
        code is not possible after them. Empty where the maps are too many to be listed, or more than `MOST_MAPS`.
    """
    try:
        if len(domain.maps(variant)[0]) > MOST_MAPS:
            return {}
        _, views, actions, next_views = domain.transitions(variant, "following")
    except DomainError:
        return {}
    codes, next_codes = encode(views), encode(next_views)
    known = np.concatenate([codes, next_codes])
    known = _distinct(known)
    kind = code_type(max(dbn.num_values, dbn.num_actions))
    steps = _distinct(np.column_stack([codes, actions, next_codes]).astype(kind))
    rng = np.random.default_rng(seed)
    drawn = known[rng.integers(len(known), size=samples)]
    taken = rng.integers(dbn.num_actions, size=samples)
    later = sample_codes(packed(dbn), drawn, taken, rng.random(drawn.shape))
    contexts = _distinct(steps[:, : dbn.num_factors + 1])
    best = np.empty((len(contexts), dbn.num_factors), dtype=dbn.code_type)
    for a in range(dbn.num_actions):
        here = contexts[:, -1] == a
        best[here] = likely_next(dbn, contexts[here, :-1], a)[0][:, 0]
    return {
        "states": 1.0 - float(_among(later, known).mean()),
        "transitions": 1.0 - float(_among(np.column_stack([drawn, taken, later]), steps).mean()),
        "likeliest": 1.0 - float(_among(np.column_stack([contexts, best]), steps).mean()),
    }


def _distinct(rows: np.ndarray) -> np.ndarray:
    """The distinct rows, in lexicographic order; there are up to a hundred million rows."""
    return np.asarray(rows[unique_rows(rows)[0]])


def _among(rows: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Whether each row is one of the known ones: bool [n]."""
    _, index, _ = unique_rows(np.concatenate([known, rows]))
    there = np.zeros(int(index.max()) + 1, dtype=bool)
    there[index[: len(known)]] = True
    return np.asarray(there[index[len(known) :]])
