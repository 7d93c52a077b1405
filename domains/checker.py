"""`check_domain`: what anyone who adds a domain runs on it.

It calls everything that collecting, training, extracting, comparing and reporting call, as they call it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from domains.core import (
    ACTION_NAMES,
    CELL_KINDS,
    MOST_MAPS,
    OUTCOMES,
    TASKS,
    Domain,
    DomainError,
    DomainSpec,
    completed,
)
from domains.defaults import OPTIONAL
from domains.play_checks import Played, check_array, check_refused, play, require

_Value = TypeVar("_Value")
_CONSTANT = re.compile(r"[a-z]\w*", re.ASCII)
MOST_ACTIONS = 64


@dataclass(frozen=True)
class DomainReport:
    """What was checked, and how much of each."""

    name: str
    steps: int
    episodes: int
    outcomes: dict[str, int]
    predicates: int
    left_out: tuple[str, ...]
    """What the domain leaves out of what it may leave out (`domains.defaults`)."""


def check_domain(domain: Any, num_envs: int = 8, steps: int = 300, seed: int = 0) -> DomainReport:
    """Play every task and variant of a domain at random and check what others rely on.

    Exact optima are not asked for: they may take long.

    Args:
        domain: the domain to check.
        num_envs: size of the batches played.
        steps: batched steps per task and variant.
        seed: of episodes and actions.

    Raises:
        DomainError: the first thing that is not as `domains.core` says, in one line.
    """
    spec = getattr(domain, "spec", None)
    if not isinstance(spec, DomainSpec):
        raise DomainError("a domain has a spec that is a DomainSpec")
    _check_spec(spec)
    for member in ("make", "predicates"):
        require(hasattr(domain, member), f"a domain has a member '{member}'")
    left_out = tuple(name for name in OPTIONAL if not callable(getattr(domain, name, None)))
    world = completed(domain)
    outcomes = dict.fromkeys(OUTCOMES[1:], 0)
    for variant in spec.variants:
        for task in spec.tasks:
            where = f"task '{task}', variant '{variant}'"
            first = attempt(where, play, world, task, variant, num_envs, steps, seed, where)
            again = attempt(where, play, world, task, variant, num_envs, min(steps, 50), seed, where)
            require(first.trace[: len(again.trace)] == again.trace, f"{where}: the same seed must give the same steps")
            for name in first.outcomes:
                outcomes[name] += 1
            _check_metrics(world, variant, first, where)
            _check_lists(world, task, variant, num_envs, seed, where)
        _check_explored(world, variant, num_envs, seed)
        _check_follower(world, variant, num_envs, seed)
    episodes = sum(outcomes.values())
    require(episodes > 0, f"no episode ended within {steps} random steps: pass more steps or lower max_steps")
    names = attempt("predicates", _check_predicates, world)
    _check_belief_metrics(world)
    _check_refusals(world)
    return DomainReport(spec.name, steps, episodes, outcomes, names, left_out)


def attempt(what: str, call: Callable[..., _Value], *arguments: Any, **keywords: Any) -> _Value:
    """What `call` returns; whatever it raises as one line about `what`."""
    try:
        return call(*arguments, **keywords)
    except DomainError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise DomainError(f"{what} failed ({reason})") from error


def _check_spec(spec: DomainSpec) -> None:
    require(bool(spec.name) and spec.name.isidentifier(), f"spec.name must be an identifier, got '{spec.name}'")
    for what, names in (
        ("variants", spec.variants),
        ("tasks", spec.tasks),
        ("action_names", spec.action_names),
        ("cell_kinds", spec.cell_kinds),
    ):
        require(isinstance(names, tuple) and len(names) > 0, f"spec.{what} must be a tuple of at least one name")
        require(all(isinstance(name, str) and name for name in names), f"spec.{what} must hold names, got {names}")
        require(len(set(names)) == len(names), f"spec.{what} names something twice: {', '.join(names)}")
    unknown = [task for task in spec.tasks if task not in TASKS]
    require(not unknown, f"spec.tasks must be of {', '.join(TASKS)} (without and with a person), got '{unknown[:1]}'")
    for variant, discount in spec.discounts.items():
        require(variant in spec.variants, f"spec.discounts names the unknown variant '{variant}'")
        require(0.0 <= discount < 1.0, f"spec.discounts: variant '{variant}' must have one in [0, 1), got {discount}")
    require(spec.outcomes == OUTCOMES, f"spec.outcomes must be those of domains.core: {', '.join(OUTCOMES[1:])}")
    count = len(spec.action_names)
    require(2 <= count <= MOST_ACTIONS, f"spec.action_names must name 2 to {MOST_ACTIONS} actions, got {count}")
    for name in spec.action_names:
        require(bool(_CONSTANT.fullmatch(name)), f"action '{name}' is no ASP constant: begin with a small letter")
    require(
        not spec.has_person or spec.action_names[:3] == ACTION_NAMES[:3],
        f"in a world with a person the first actions must be {', '.join(ACTION_NAMES[:3])}: the perspective shift "
        f"imagines walks of these; got {', '.join(spec.action_names[:3])}",
    )
    most = len(CELL_KINDS)
    require(spec.num_cell_kinds <= most, f"spec.cell_kinds: the world model takes {most} kinds of cells at most")
    width = spec.geometry.view_size
    require(width % 2 == 1 and 3 <= width <= 89, f"spec.geometry.view_size must be odd and in 3..89, got {width}")


def _check_metrics(world: Domain, variant: str, played: Played, where: str) -> None:
    """The metrics of the episodes played."""
    what = f"{where}: episode_metrics()"
    found = attempt(what, world.episode_metrics, played.steps, variant)
    for name in ("environment", "episode", "return"):
        require(name in found, f"{what} must give '{name}'")
    for name, values in found.items():
        require(
            np.shape(values) == (len(played.outcomes),),
            f"{what}: '{name}' must have an entry for each of the {len(played.outcomes)} finished episodes",
        )
        require(np.asarray(values).dtype.kind in "fiub", f"{what}: '{name}' must hold numbers")
    require(
        np.allclose(np.sort(found["return"]), np.sort(played.returns)),
        f"{what}: 'return' must be the sum of each episode's rewards",
    )


def _check_lists(world: Domain, task: str, variant: str, num_envs: int, seed: int, where: str) -> None:
    """Maps, views and transitions, where the domain lists them."""
    spec = world.spec
    width = spec.geometry.view_size

    def check_views(views: Any, count: int | None, what: str) -> None:
        check_array(views, np.uint8, (len(views) if count is None else count, width, width), what)
        require(len(views) > 0 and int(views.max()) < spec.num_cell_kinds, f"{what} has unknown cell kinds, or none")

    maps = listed(f"{where}: maps()", world.maps, variant)
    if maps is not None:
        grids, weights = maps
        what = f"{where}: maps()"
        require(np.ndim(grids) == 3 and len(grids) > 0, f"{what} must give maps [M, width, height], at least one")
        require(np.shape(weights) == (len(grids),), f"{what} must give one weight per map")
        total = float(np.sum(weights))
        require(bool(np.min(weights) >= 0) and abs(total - 1) < 1e-6, f"{what}: weights must add up to 1, not {total}")
        count = 2 * min(len(grids), num_envs)
        given = np.asarray(grids)[: count // 2]
        env = attempt(f"{where}: make(maps=..., cycle=True)", _begun, world, task, count, variant, seed, given)
        ids = env.map_ids()
        require(
            bool((ids[: count // 2] == ids[count // 2 :]).all()),
            f"{where}: with cycle, environments i and i + M of M maps must begin on the same map",
        )
        if len(grids) > MOST_MAPS:
            return  # nothing is listed map by map then
    views = listed(f"{where}: views()", world.views, variant, task)
    if views is not None:
        check_views(views, None, f"{where}: views()")
    steps = listed(f"{where}: transitions()", world.transitions, variant, task)
    if steps is not None:
        what = f"{where}: transitions()"
        require(len(steps) == 4, f"{what} must give four arrays: map, view, action, next view")
        place, before, action, after = steps
        for name, array in (("map", place), ("action", action)):
            require(np.shape(array) == (len(before),), f"{what}: {name} must have one entry per transition")
            require(np.asarray(array).dtype.kind in "iu", f"{what}: {name} must hold whole numbers")
        check_views(before, None, f"{what}: view")
        check_views(after, len(before), f"{what}: next view")
        top = len(spec.action_names)
        require(int(np.min(action)) >= 0 and int(np.max(action)) < top, f"{what}: actions must be in 0..{top - 1}")
        require(maps is None or int(np.max(place)) < len(maps[0]), f"{what}: map must be a number of maps()")


def listed(what: str, call: Callable[..., _Value], *arguments: Any) -> _Value | None:
    """What the domain lists; None where it says that it does not."""
    try:
        return attempt(what, call, *arguments)
    except DomainError as error:
        if error.__cause__ is not None:  # it failed, and did not refuse
            raise
        return None


def _begun(world: Domain, task: str, count: int, variant: str, seed: int, grids: np.ndarray | None = None) -> Any:
    env = world.make(task, count, variant=variant, seed=seed, maps=grids, cycle=grids is not None)
    env.reset()
    return env


def _check_explored(world: Domain, variant: str, num_envs: int, seed: int) -> None:
    """Whether `crossing` can be played on the maps of `following`: part of the experience is collected so."""
    if set(world.spec.tasks) != set(TASKS):
        return
    what = f"variant '{variant}': crossing on the maps that following is played on"
    grids = np.stack([state["grid"] for state in _begun(world, "following", num_envs, variant, seed).states()])
    attempt(what, _begun, world, "crossing", num_envs, variant, seed, grids)


def _check_follower(world: Domain, variant: str, num_envs: int, seed: int) -> None:
    """The follower of the last seen configuration, where there is one."""
    what = f"variant '{variant}': last_seen_follower()"
    if not world.spec.has_person:
        return
    follower: Any = listed(what, world.last_seen_follower, num_envs, variant)
    if follower is None:
        return
    env = _begun(world, "following", num_envs, variant, seed)
    observation, _ = env.reset(seed=seed)
    acted = None
    for _ in range(3):
        acted = np.asarray(attempt(what, lambda seen, before: follower.actions(seen, acted=before), observation, acted))
        require(acted.shape == (num_envs,), f"{what}.actions() must give one action per environment")
        observation, *_ = attempt(what, env.step, acted.astype(np.int64))


def _check_predicates(domain: Domain) -> int:
    predicates, spec = domain.predicates, domain.spec
    names = predicates.names
    require(len(set(names)) == len(names) > 0, "predicate names must be unique, and there must be some")
    bad = [name for name in names if not _CONSTANT.fullmatch(name)]
    require(not bad, f"predicate '{bad[0] if bad else ''}' is no ASP constant: begin with a small letter")
    missing = set(names) - set(predicates.meanings)
    require(not missing, f"predicates without a meaning: {sorted(missing)}")
    width = spec.geometry.view_size
    views = np.random.default_rng(0).integers(0, spec.num_cell_kinds, (7, width, width)).astype(np.uint8)
    truth = predicates.evaluate(views)
    check_array(truth, np.bool_, (7, len(names)), "predicates.evaluate()")
    alone = np.concatenate([predicates.evaluate(view[None]) for view in views])
    require(bool((alone == truth).all()), "predicates.evaluate() must treat every view by itself")
    return len(names)


def _check_belief_metrics(world: Domain) -> None:
    width = world.spec.geometry.view_size
    beliefs, views = np.full((5, 2, 3), 1 / 3, np.float32), np.zeros((5, width, width), np.uint8)
    arguments = (beliefs, np.zeros((5, 2), np.uint8), views, views.copy())
    found = attempt("belief_metrics()", world.belief_metrics, *arguments)
    for name, values in found.items():
        require(np.shape(values) == (5,), f"belief_metrics(): '{name}' must have an entry per belief")


def _check_refusals(world: Domain) -> None:
    """Whether bad input is refused with a DomainError."""
    spec = world.spec
    task, variant = spec.tasks[0], spec.variants[0]
    check_refused("an unknown task", world.make, "no-such-task", 1, variant)
    check_refused("an unknown variant", world.make, task, 1, "no-such-variant")
    for what, actions in (
        ("an action out of range", np.array([len(spec.action_names)])),
        ("a negative action", np.array([-1])),
        ("an action that is no whole number", np.array([0.5])),
        ("a wrong number of actions", np.zeros(2, np.int64)),
    ):
        check_refused(what, _begun(world, task, 1, variant, 0).step, actions)
