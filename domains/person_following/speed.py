"""Speed of the environments: steps per second by size and batch, beside Minigrid in the same run.

Everything a learner pays for is included: views, configurations, rewards, infos, automatic resets to fresh
maps, and for greedy play the expert's actions. Time is that of the processor, on one core.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium
import numpy as np

from domains.person_following.domain import DOMAIN

_CROSSINGS = {5: 1, 7: 1, 9: 1, 11: 2, 13: 3, 19: 5, 25: 7, 31: 9}


@dataclass(frozen=True)
class SpeedRow:
    """One measurement; `minigrid_ratio` is against Minigrid's SimpleCrossingS9N1 in the same run."""

    what: str
    size: int
    num_crossings: int
    batch: int
    player: str
    steps_per_second: float
    minigrid_ratio: float


def benchmark(
    variant: str = "paper",
    sizes: Sequence[int] = (9, 13, 19, 31),
    batches: Sequence[int] = (1, 16, 128, 1024, 4096, 16384),
    seconds: float = 1.0,
    seed: int = 0,
) -> list[dict[str, Any]]:
    """Rows of `SpeedRow` as dicts: Minigrid first, then the single environment, then every size and batch.

    Args:
        variant: whose rules to play.
        sizes: map sizes.
        batches: numbers of environments, measured at every size.
        seconds: how long to step for each row, after a warm-up.
        seed: of maps and random actions.
    """
    base = _minigrid(seconds, seed)
    rows = [SpeedRow("minigrid SimpleCrossingS9N1", 9, 1, 1, "random", base, 1.0)]
    single = _single(variant, seconds, seed)
    rows.append(SpeedRow("single environment", 9, 1, 1, "random", single, single / base))
    for size in sizes:
        crossings = _CROSSINGS.get(size, max(1, size // 4))
        for batch in batches:
            for player in ("random", "greedy"):
                rate = _batched(variant, size, crossings, batch, player, seconds, seed)
                rows.append(SpeedRow("batch", size, crossings, batch, player, rate, rate / base))
    return [asdict(row) for row in rows]


def _minigrid(seconds: float, seed: int) -> float:
    import minigrid  # noqa: F401  registers its environments

    env = gymnasium.make("MiniGrid-SimpleCrossingS9N1-v0")
    return _rate_of_single(env, 3, seconds, seed)


def _single(variant: str, seconds: float, seed: int) -> float:
    env = gymnasium.make("nesy/PersonFollowing-v0", variant=variant, size=9, num_crossings=1)
    return _rate_of_single(env, 4, seconds, seed)


def _rate_of_single(env: gymnasium.Env[Any, Any], num_actions: int, seconds: float, seed: int) -> float:
    actions = np.random.default_rng(seed).integers(0, num_actions, 4096).tolist()
    env.reset(seed=seed)
    steps, limit = 0, 0.0
    started = time.process_time()
    while steps <= 64 or time.process_time() < limit:
        if steps == 64:
            started = time.process_time()
            limit = started + seconds
        _, _, terminated, truncated, _ = env.step(actions[steps % 4096])
        if terminated or truncated:
            env.reset()
        steps += 1
    return (steps - 64) / (time.process_time() - started)


def _batched(variant: str, size: int, crossings: int, batch: int, player: str, seconds: float, seed: int) -> float:
    env = DOMAIN.make("following", batch, variant, seed=seed, size=size, num_crossings=crossings)
    env.reset()
    rng = np.random.default_rng(seed)
    actions = rng.integers(0, 4, (64, batch))
    steps, rounds = 0, 0
    started, limit = time.process_time(), 0.0
    while rounds <= 8 or time.process_time() < limit:
        if rounds == 8:
            steps, started = 0, time.process_time()
            limit = started + seconds
        chosen = env.expert_actions("follower") if player == "greedy" else actions[rounds % 64]
        env.step(chosen)
        rounds += 1
        steps += batch
    return steps / (time.process_time() - started)


@dataclass(frozen=True)
class StartRow:
    """What a fresh process needs, beside the limit that it is held to."""

    what: str
    figure: float
    unit: str
    limit: float


_BEGIN = """
import resource, numpy, gymnasium, domains
environment = gymnasium.make_vec("nesy/PersonFollowing-v0", num_envs={batch}, vectorization_mode="vector_entry_point")
environment.reset(seed=0)
for step in range({steps}):
    environment.step(numpy.full({batch}, step % 4))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def starts() -> list[dict[str, Any]]:
    """Rows of `StartRow` as dicts: import, first steps with and without cached kernels, memory of a large batch.

    Each is a process of its own; times are of the processor, user and system together.
    """
    with tempfile.TemporaryDirectory() as cache:
        cold, _ = _spent(_BEGIN.format(batch=1024, steps=3), cache)
        warm, _ = _spent(_BEGIN.format(batch=1024, steps=3), cache)
        imported, _ = _spent("import domains, gymnasium; gymnasium.make('nesy/PersonFollowing-v0')", cache)
        _, kilobytes = _spent(_BEGIN.format(batch=16384, steps=50), cache)
    rows = (
        StartRow("cold start: kernels compiled, batch 1024, reset and 3 steps", cold, "s", 15.0),
        StartRow("warm start: kernels cached, batch 1024, reset and 3 steps", warm, "s", 1.5),
        StartRow("import and make", imported, "s", 1.5),
        StartRow("memory of batch 16,384 after 50 steps", int(kilobytes) / 1024**2, "GiB", 2.0),
    )
    return [asdict(row) for row in rows]


def _spent(program: str, cache: str) -> tuple[float, str]:
    """Seconds of processor time of a program in a process of its own, and what it printed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"NUMBA_CACHE_DIR": cache}
    done = subprocess.run([sys.executable, "-c", program], env=environment, check=True, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, done.stdout.strip()


__all__ = ["SpeedRow", "StartRow", "benchmark", "starts"]
