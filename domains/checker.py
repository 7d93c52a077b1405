"""`check_domain`: what anyone who adds a domain runs on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from domains.core import OUTCOMES, BatchedEnvironment, Domain, DomainError

_INFOS = ("outcome", "outcome_code", "distance", "visible", "person_action", "person_waited", "_final_obs")
_FINALS = ("final_person_view", "final_relative_pose", "final_counters")


@dataclass(frozen=True)
class DomainReport:
    """What was checked, and how much of each."""

    name: str
    steps: int
    episodes: int
    outcomes: dict[str, int]
    predicates: int


def check_domain(domain: Domain, num_envs: int = 8, steps: int = 300, seed: int = 0) -> DomainReport:
    """Play every task and variant of a domain at random and check what others rely on.

    Args:
        domain: the domain to check.
        num_envs: size of the batches played.
        steps: batched steps per task and variant.
        seed: of episodes and actions.

    Raises:
        DomainError: the first thing that is not as `domains.core` says, in one line.
    """
    spec = domain.spec
    _require(bool(spec.name) and spec.name.isidentifier(), f"spec.name must be an identifier, got '{spec.name}'")
    _require(len(spec.variants) > 0, "spec.variants must name at least one variant")
    _require(len(spec.tasks) > 0, "spec.tasks must name at least one task")
    for variant, discount in spec.discounts.items():
        _require(variant in spec.variants, f"spec.discounts names the unknown variant '{variant}'")
        _require(0.0 <= discount < 1.0, f"spec.discounts: variant '{variant}' must have one in [0, 1), got {discount}")
    episodes, outcomes = 0, dict.fromkeys(OUTCOMES[1:], 0)
    for task in spec.tasks:
        for variant in spec.variants:
            where = f"task '{task}', variant '{variant}'"
            first = _play(domain, task, variant, num_envs, steps, seed, where)
            second = _play(domain, task, variant, num_envs, min(steps, 50), seed, where)
            _require(first[: len(second)] == second, f"{where}: the same seed must give the same steps")
            for step in first:
                for outcome in step[-1]:
                    if outcome:
                        episodes += 1
                        outcomes[outcome] += 1
    _require(episodes > 0, f"no episode ended within {steps} random steps: pass more steps or lower max_steps")
    names = _check_predicates(domain)
    _check_refusals(domain)
    return DomainReport(spec.name, steps, episodes, outcomes, names)


def _play(
    domain: Domain, task: str, variant: str, num_envs: int, steps: int, seed: int, where: str
) -> list[tuple[Any, ...]]:
    env = domain.make(task, num_envs, variant, seed=seed)
    _require(isinstance(env, BatchedEnvironment), f"{where}: make() must return a BatchedEnvironment")
    observation, _ = env.reset(seed=seed)
    _check_state(env, domain, observation, where)
    rng = np.random.default_rng(seed)
    trace = []
    for _ in range(steps):
        actions = rng.integers(0, len(domain.spec.action_names), num_envs)
        observation, reward, terminated, truncated, infos = env.step(actions)
        _check_state(env, domain, observation, where)
        _check_step(env, domain, observation, reward, terminated, truncated, infos, where)
        trace.append(
            (
                observation["view"].tobytes(),
                observation["configuration"].tolist(),
                reward.tolist(),
                infos["outcome"].tolist(),
            )
        )
    return trace


def _check_state(env: BatchedEnvironment, domain: Domain, observation: dict[str, Any], where: str) -> None:
    count, geometry = env.num_envs, domain.spec.geometry
    width = geometry.view_size
    _require(set(observation) == {"view", "configuration"}, f"{where}: an observation has view and configuration")
    view, configuration = observation["view"], observation["configuration"]
    _array(view, np.uint8, (count, width, width), f"{where}: view")
    _require(int(view.max()) < domain.spec.num_cell_kinds, f"{where}: view has unknown cell kinds")
    _array(configuration, np.int64, (count,), f"{where}: configuration")
    _require(
        bool(((configuration >= 0) & (configuration < geometry.num_configurations)).all()),
        f"{where}: configuration must be in 0..{geometry.num_configurations - 1}",
    )
    _array(env.person_views(), np.uint8, (count, width, width), f"{where}: person_views()")
    _array(env.relative_poses(), np.int16, (count, 3), f"{where}: relative_poses()")
    _array(env.person_actions(), np.int8, (count,), f"{where}: person_actions()")
    _array(env.person_minds(), np.int16, (count, 2, 2), f"{where}: person_minds()")
    _array(env.counters(), np.int16, (count, 2), f"{where}: counters()")
    _array(env.map_ids(), np.int64, (count,), f"{where}: map_ids()")
    seen = configuration > 0
    agrees = geometry.relative(configuration)[seen] == env.relative_poses()[seen]
    _require(bool(np.asarray(agrees).all()), f"{where}: a seen person's configuration must agree with relative_poses()")
    actions = env.expert_actions("goal")
    _require(actions.shape == (count,), f"{where}: expert_actions('goal') must have shape ({count},)")
    _require(
        bool(((actions >= 0) & (actions < len(domain.spec.action_names))).all()),
        f"{where}: an expert's action is out of range",
    )


def _check_step(
    env: BatchedEnvironment,
    domain: Domain,
    observation: dict[str, Any],
    reward: Any,
    terminated: Any,
    truncated: Any,
    infos: dict[str, Any],
    where: str,
) -> None:
    count = env.num_envs
    _array(reward, np.float64, (count,), f"{where}: reward")
    _array(terminated, np.bool_, (count,), f"{where}: terminated")
    _array(truncated, np.bool_, (count,), f"{where}: truncated")
    _require(bool(np.isfinite(reward).all()), f"{where}: rewards must be finite")
    for name in (*_INFOS, *_FINALS):
        _require(name in infos and len(infos[name]) == count, f"{where}: infos['{name}'] must have {count} entries")
    done = terminated | truncated
    _require(bool((infos["_final_obs"] == done).all()), f"{where}: infos['_final_obs'] must mark the ended episodes")
    unknown = set(infos["outcome"].tolist()) - set(OUTCOMES)
    _require(not unknown, f"{where}: unknown outcomes {sorted(unknown)}")
    _require(
        bool(((infos["outcome"] != "") == done).all()),
        f"{where}: an outcome belongs to ended episodes, and only to them",
    )
    final = infos["final_obs"]
    going_on = ~done
    _require(
        bool((final["view"][going_on] == observation["view"][going_on]).all()),
        f"{where}: final_obs must be the observation where no episode ended",
    )


def _check_predicates(domain: Domain) -> int:
    predicates, spec = domain.predicates, domain.spec
    names = predicates.names
    _require(len(set(names)) == len(names) > 0, "predicate names must be unique, and there must be some")
    bad = [name for name in names if not (name.isidentifier() and name[0].islower())]
    _require(not bad, f"predicate '{bad[0] if bad else ''}' is no ASP constant: begin with a small letter")
    missing = set(names) - set(predicates.meanings)
    _require(not missing, f"predicates without a meaning: {sorted(missing)}")
    width = spec.geometry.view_size
    views = np.random.default_rng(0).integers(0, spec.num_cell_kinds, (7, width, width)).astype(np.uint8)
    truth = predicates.evaluate(views)
    _array(truth, np.bool_, (7, len(names)), "predicates.evaluate()")
    alone = np.concatenate([predicates.evaluate(view[None]) for view in views])
    _require(bool((alone == truth).all()), "predicates.evaluate() must treat every view by itself")
    return len(names)


def _check_refusals(domain: Domain) -> None:
    spec = domain.spec
    wrong = (
        ("an unknown task", lambda: domain.make("no-such-task", 1, spec.variants[0])),
        ("an unknown variant", lambda: domain.make(spec.tasks[0], 1, "no-such-variant")),
        ("an action out of range", lambda: _step_wrongly(domain)),
    )
    for what, attempt in wrong:
        try:
            attempt()
        except DomainError:
            continue
        raise DomainError(f"{what} must raise DomainError")


def _step_wrongly(domain: Domain) -> None:
    env = domain.make(domain.spec.tasks[0], 1, domain.spec.variants[0], seed=0)
    env.reset(seed=0)
    env.step(np.array([len(domain.spec.action_names)]))


def _array(value: Any, dtype: Any, shape: tuple[int, ...], what: str) -> None:
    array = np.asarray(value)
    _require(array.shape == shape, f"{what} must have shape {shape}, got {array.shape}")
    _require(array.dtype == dtype, f"{what} must be {np.dtype(dtype)}, got {array.dtype}")


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise DomainError(message)
