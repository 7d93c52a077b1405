"""The configuration of a run: presets, reading and writing config.json."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from nesy.config import CollectConfig, ExtractConfig, TrainConfig, check_ranges
from nesy.errors import UserError
from nesy.run_folder import read_json, write_json
from planners.config import CompareConfig, DQNConfig, SearchConfig

FORMAT = 1
PresetName = Literal["smoke", "quick", "paper"]


@dataclass(frozen=True)
class RunConfig:
    """Everything needed to repeat a run, but for the versions of the libraries."""

    preset: PresetName = "quick"
    """Where the other settings started from."""
    domain: str = "person_following"
    """Which world: `person_following`, or one of your own as `package.module:ATTRIBUTE`."""
    variant: str = "paper"
    """Variant of the task that the run is about."""
    seed: int = 0
    """Seed of everything random."""
    collect: CollectConfig = field(default_factory=CollectConfig)
    """Experience."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """World model."""
    extract: ExtractConfig = field(default_factory=ExtractConfig)
    """2DBN."""
    compare: CompareConfig = field(default_factory=CompareConfig)
    """Comparison."""

    def __post_init__(self) -> None:
        """Check the seed; the sections check themselves."""
        check_ranges(self, "run", seed="[0, inf)")


PRESETS: dict[str, RunConfig] = {
    # Every step once, in under a minute: for CI and for trying things out. Its agents are weak.
    "smoke": RunConfig(
        preset="smoke",
        collect=CollectConfig(crossing_episodes=100, following_episodes=100, shard_episodes=50),
        train=TrainConfig(epochs=2, searches=1, time_limit=0.0),
        compare=CompareConfig(
            episodes=42,
            planner_episodes=2,
            agents=("dqn", "pomdp", "greedy-follower", "random", "optimum"),
            dqn=DQNConfig.fast(episodes=100),
            search=SearchConfig(simulations=50, pomdp_py_simulations=10, practice_episodes=300),
        ),
    ),
    # The demo: everything for real within six minutes on two cores.
    "quick": RunConfig(preset="quick", train=TrainConfig(time_limit=0.0)),
    # As much experience and learning as the paper reports.
    "paper": RunConfig(
        preset="paper",
        collect=CollectConfig(crossing_episodes=3000, following_episodes=6000),
        compare=CompareConfig(
            inputs=("paper", "full"),
            seeds=(0, 1, 2, 3, 4),
            episodes=1008,
            planner_episodes=210,
            dqn=DQNConfig.fast(episodes=10_000),
        ),
    ),
}


RETIRED: dict[tuple[type, str], Any] = {(SearchConfig, "mind_discount"): 0.99}
"""Settings of older runs that are gone, with the value that means what happens now: with that they are read."""


def save(config: RunConfig, path: Path, versions: Mapping[str, str]) -> None:
    """Write config.json atomically, with the versions of the libraries that the run uses."""
    write_json(path, {"format": FORMAT, **dataclasses.asdict(config), "versions": dict(versions)})


def versions(path: Path) -> dict[str, str]:
    """The versions of the libraries that a config.json was written with."""
    return dict(read_json(path).get("versions", {}))


def load(path: Path) -> RunConfig:
    """Read config.json.

    Raises:
        UserError: the file is missing, damaged, of another format, or has an unknown or wrong setting.
    """
    value = read_json(path)
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise UserError(f"{path}: not a run configuration of format {FORMAT}")
    settings = {name: item for name, item in value.items() if name not in ("format", "versions")}
    config = _build(RunConfig, settings, str(path))
    assert isinstance(config, RunConfig)
    return config


def _build(kind: type, value: Any, where: str) -> Any:
    """An instance of the dataclass `kind` from plain JSON values, each checked against the field's type."""
    if not isinstance(value, dict):
        raise UserError(f"{where}: expected an object with settings, found {type(value).__name__}")
    value = {name: item for name, item in value.items() if RETIRED.get((kind, name), ...) != item}
    types_of = typing.get_type_hints(kind)
    names = [item.name for item in dataclasses.fields(kind)]
    unknown = sorted(set(value) - set(names))
    if unknown:
        raise UserError(f"{where}: unknown setting '{unknown[0][:80]}' (known: {', '.join(names)})")
    settings = {name: _convert(types_of[name], value[name], f"{where}: {name}") for name in names if name in value}
    try:
        return kind(**settings)
    except UserError as error:
        path = where.partition(": ")[0]  # the error names the section
        raise UserError(f"{path}: {error}") from None


def _convert(kind: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _build(kind, value, where)
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        if value in parts:
            return value
        raise UserError(f"{where}: {_short(value)} is not one of {', '.join(map(repr, parts))}")
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in parts:
            return None
        return _convert(next(part for part in parts if part is not type(None)), value, where)
    if origin is tuple and isinstance(value, list):
        return tuple(_convert(parts[0], item, where) for item in value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(kind, type) and isinstance(value, kind) and (kind is bool or not isinstance(value, bool)):
        return value
    expected = "a list" if origin is tuple else getattr(kind, "__name__", str(kind))
    raise UserError(f"{where}: expected {expected}, found {_short(value)}")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def differences(old: Any, new: Any, prefix: str = "") -> list[str]:
    """The settings in which two configurations differ, as `name: old, now new`."""
    found: list[str] = []
    for item in dataclasses.fields(old):
        before, after = getattr(old, item.name), getattr(new, item.name)
        if dataclasses.is_dataclass(before):
            found += differences(before, after, f"{prefix}{item.name}.")
        elif before != after:
            found.append(f"{prefix}{item.name}: {before}, now {after}")
    return found
