"""Episodes of a domain played at random, every step of them checked: the larger part of `check_domain`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from domains.core import (
    GOAL,
    OUTCOMES,
    BatchedEnvironment,
    Domain,
    DomainError,
    DomainSpec,
    RecordedSteps,
    StepRecorder,
)
from domains.defaults import NEVER_NEEDED


@dataclass(frozen=True)
class Played:
    """What came of playing: a trace to compare, and per finished episode its outcome and return."""

    trace: list[tuple[Any, ...]]
    outcomes: list[str]
    returns: list[float]
    steps: RecordedSteps


def play(domain: Domain, task: str, variant: str, num_envs: int, steps: int, seed: int, where: str) -> Played:
    """Play at random.

    Raises:
        DomainError: the first thing that is not as it should be.
    """
    env: Any = domain.make(task, num_envs, variant=variant, seed=seed)
    require(isinstance(env, BatchedEnvironment), f"{where}: make() must return a BatchedEnvironment{_lacking(env)}")
    require(env.num_envs == num_envs, f"{where}: num_envs must be {num_envs}, got {env.num_envs}")
    observation, _ = env.reset(seed=seed)
    spec = domain.spec
    check_state(env, spec, task, observation, where)
    recorder = StepRecorder(env)
    rng = np.random.default_rng(seed)
    trace, outcomes, returns, totals = [], [], [], np.zeros(num_envs)
    for _ in range(steps):
        actions = rng.integers(0, len(spec.action_names), num_envs)
        before = env.map_ids().copy()
        observation, reward, terminated, truncated, infos = env.step(actions)
        check_state(env, spec, task, observation, where)
        _check_step(env, spec, observation, reward, terminated, truncated, infos, where)
        recorder.step(actions, reward, infos)
        done = terminated | truncated
        require(bool((env.map_ids()[~done] == before[~done]).all()), f"{where}: map_ids() must stay within an episode")
        totals += reward
        outcomes += infos["outcome"][done].tolist()
        returns += totals[done].tolist()
        totals[done] = 0
        view, configuration = observation["view"], observation["configuration"]
        trace.append((view.tobytes(), configuration.tolist(), reward.tolist(), infos["outcome"].tolist()))
    env.close()
    return Played(trace, outcomes, returns, recorder.steps())


def _lacking(env: Any) -> str:
    members = [name for name in dir(BatchedEnvironment) if not name.startswith("_") and name not in NEVER_NEEDED]
    names = [name for name in members if not callable(getattr(env, name, None))]
    return f", it has no {', '.join(names)}" if names else ""


def check_state(env: Any, spec: DomainSpec, task: str, observation: dict[str, Any], where: str) -> None:
    """Everything that can be asked of an environment between two steps."""
    count = env.num_envs
    _check_observation(observation, spec, count, where, "an observation")
    width = spec.geometry.view_size
    check_array(env.person_views(), np.uint8, (count, width, width), f"{where}: person_views()")
    check_array(env.relative_poses(), np.int16, (count, 3), f"{where}: relative_poses()")
    check_array(env.person_actions(), np.int8, (count,), f"{where}: person_actions()")
    check_array(env.person_minds(), np.int16, (count, 2, 2), f"{where}: person_minds()")
    check_array(env.counters(), np.int16, (count, 2), f"{where}: counters()")
    check_array(env.map_ids(), np.int64, (count,), f"{where}: map_ids()")
    require(int(env.person_views().max()) < spec.num_cell_kinds, f"{where}: person_views() has unknown cell kinds")
    configuration = observation["configuration"]
    seen = configuration > 0
    agrees = spec.geometry.relative(configuration)[seen] == env.relative_poses()[seen]
    require(bool(np.asarray(agrees).all()), f"{where}: a seen person's configuration must agree with relative_poses()")
    require(task == "following" or not seen.any(), f"{where}: nobody is there, so configuration must be 0")
    for kind in ("goal", "follower") if task == "following" else ("goal",):
        actions = np.asarray(env.expert_actions(kind))
        require(actions.shape == (count,), f"{where}: expert_actions('{kind}') must have shape ({count},)")
        require(
            actions.dtype.kind in "iu" and bool(((actions >= 0) & (actions < len(spec.action_names))).all()),
            f"{where}: an expert's action is out of range",
        )
    _check_states(env.states(), count, task, where)


def _check_states(states: Any, count: int, task: str, where: str) -> None:
    """The full states, which replays and pictures show."""
    require(len(states) == count, f"{where}: states() must give one state per environment")
    shapes = {np.shape(state.get("grid")) for state in states}
    require(len(shapes) == 1 and len(next(iter(shapes))) == 2, f"{where}: states() must have a 'grid' of one size each")
    for state in states:
        grid = np.asarray(state["grid"])
        known = grid.dtype.kind in "iu" and bool(((grid >= 0) & (grid <= GOAL)).all())
        require(known, f"{where}: a state's grid must hold whole numbers: 0 empty, 1 wall, 2 goal")
        for who in ("agent", "person") if task == "following" else ("agent",):
            pose = state.get(who)
            there = pose is not None and np.shape(pose) == (3,)
            require(there, f"{where}: a state must have '{who}', its x, y and heading")
            x, y, heading = (int(part) for part in pose)
            inside = 0 <= x < grid.shape[0] and 0 <= y < grid.shape[1] and 0 <= heading < 4
            require(inside, f"{where}: a state's '{who}' must lie in the grid, its heading in 0..3, got {tuple(pose)}")


def _check_observation(observation: Any, spec: DomainSpec, count: int, where: str, what: str) -> None:
    require(set(observation) == {"view", "configuration"}, f"{where}: {what} has view and configuration")
    view, configuration = observation["view"], observation["configuration"]
    width, most = spec.geometry.view_size, spec.geometry.num_configurations
    check_array(view, np.uint8, (count, width, width), f"{where}: view of {what}")
    require(int(view.max()) < spec.num_cell_kinds, f"{where}: view of {what} has unknown cell kinds")
    check_array(configuration, np.int64, (count,), f"{where}: configuration of {what}")
    inside = bool(((configuration >= 0) & (configuration < most)).all())
    require(inside, f"{where}: configuration of {what} must be in 0..{most - 1}")


def _check_step(
    env: Any,
    spec: DomainSpec,
    observation: dict[str, Any],
    reward: Any,
    terminated: Any,
    truncated: Any,
    infos: dict[str, Any],
    where: str,
) -> None:
    count, width = env.num_envs, spec.geometry.view_size
    check_array(reward, np.float64, (count,), f"{where}: reward")
    check_array(terminated, np.bool_, (count,), f"{where}: terminated")
    check_array(truncated, np.bool_, (count,), f"{where}: truncated")
    require(bool(np.isfinite(reward).all()), f"{where}: rewards must be finite")
    done = terminated | truncated
    for name, kinds, shape in (
        ("outcome", "U", (count,)),
        ("outcome_code", "iu", (count,)),
        ("distance", "iuf", (count,)),
        ("visible", "b", (count,)),
        ("person_action", "i", (count,)),
        ("person_waited", "b", (count,)),
        ("_final_obs", "b", (count,)),
        ("final_person_view", "u", (count, width, width)),
        ("final_relative_pose", "iu", (count, 3)),
        ("final_counters", "iu", (count, 2)),
    ):
        array = np.asarray(infos.get(name))
        right = array.shape == shape and array.dtype.kind in kinds
        require(
            right, f"{where}: infos['{name}'] must have shape {shape} and kind {kinds}, got {array.dtype} {array.shape}"
        )
    require("final_obs" in infos, f"{where}: infos['final_obs'] is missing")
    require(bool((infos["_final_obs"] == done).all()), f"{where}: infos['_final_obs'] must mark the ended episodes")
    unknown = set(infos["outcome"].tolist()) - set(OUTCOMES)
    require(not unknown, f"{where}: unknown outcomes {sorted(unknown)}")
    ends = (infos["outcome"] != "") == done
    require(bool(ends.all()), f"{where}: an outcome belongs to ended episodes, and only to them")
    named = np.array(OUTCOMES)[np.clip(infos["outcome_code"], 0, len(OUTCOMES) - 1)] == infos["outcome"]
    require(bool(named.all()), f"{where}: infos['outcome_code'] must be the place of infos['outcome'] in OUTCOMES")
    moves = np.asarray(infos["person_action"])
    require(bool(((moves >= -1) & (moves <= 3)).all()), f"{where}: infos['person_action'] must be in -1..3")
    final = infos["final_obs"]
    _check_observation(final, spec, count, where, "final_obs")
    for name, now, then in (
        ("final_obs", observation["view"], final["view"]),
        ("final_obs", observation["configuration"], final["configuration"]),
        ("final_person_view", env.person_views(), infos["final_person_view"]),
        ("final_relative_pose", env.relative_poses(), infos["final_relative_pose"]),
        ("final_counters", env.counters(), infos["final_counters"]),
    ):
        same = bool((np.asarray(now)[~done] == np.asarray(then)[~done]).all())
        require(same, f"{where}: infos['{name}'] must be what holds after the step where no episode ended")


def check_refused(what: str, call: Callable[..., Any], *arguments: Any) -> None:
    """Whether bad input is refused with a DomainError."""
    try:
        call(*arguments)
    except DomainError:
        return
    except Exception as error:
        raise DomainError(f"{what} must raise DomainError, and raises {type(error).__name__}: {error}") from error
    raise DomainError(f"{what} must raise DomainError")


def check_array(value: Any, dtype: Any, shape: tuple[int, ...], what: str) -> None:
    """Whether a value is an array of a type and shape."""
    array = np.asarray(value)
    require(array.shape == shape, f"{what} must have shape {shape}, got {array.shape}")
    require(array.dtype == dtype, f"{what} must be {np.dtype(dtype)}, got {array.dtype}")


def require(holds: bool, message: str) -> None:
    """Refuse what does not hold.

    Raises:
        DomainError: with the message.
    """
    if not holds:
        raise DomainError(message)
