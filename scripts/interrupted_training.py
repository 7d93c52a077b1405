"""Train, be killed by SIGKILL at random moments, go on, and compare the weights with those of an uninterrupted run.

The training runs in a forked process, which is killed after a random time and started again, over and over; one that
ends before its next kill is compared and another one begun. Exit status 0: all weights and figures are equal.

    python scripts/interrupted_training.py --kills 20
"""

from __future__ import annotations

import json
import multiprocessing
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

from domains.core import load_domain
from nesy.config import CollectConfig, TrainConfig
from nesy.log.collection import collect
from nesy.world_model import train
from nesy.world_model.storage import load_tensors


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    kills: int = 20
    """How often to kill."""
    architecture: Literal["symbolic", "paper"] = "symbolic"
    """What to train."""
    epochs: int = 4
    """Epochs of the training."""
    episodes: int = 20
    """Episodes of each task to learn from."""
    seed: int = 0
    """Seed of the training, and of the moments."""
    device: str = "cpu"
    """Where to train."""


def interrupted(experience: Path, config: TrainConfig, folder: Path, kills: int, seed: int) -> tuple[int, list[float]]:
    """Compare interrupted trainings with an uninterrupted one.

    Args:
        experience: a folder of experience.
        config: of the training.
        folder: where trainings may be written.
        kills: how often to kill.
        seed: of the training, and of the moments.

    Returns:
        How many trainings were completed after being killed, and the moments of the kills: seconds since the
        process was started.

    Raises:
        AssertionError: a weight or a figure differs.
    """
    train(experience, config, folder / "whole", seed)  # here, so that what is compiled is there in every fork
    started = time.monotonic()
    _complete(experience, config, folder / "again", seed)
    duration = time.monotonic() - started
    compare(folder / "whole", folder / "again")
    rng = np.random.default_rng(seed)
    moments: list[float] = []
    trainings = 0
    while len(moments) < kills:
        trainings += 1
        cut = folder / f"cut-{trainings}"
        while len(moments) < kills:
            # On average a few kills per training: no more of it is lost than since the last checkpoint.
            moment = float(rng.uniform(0, duration / 2))
            if not _killed(experience, config, cut, seed, moment):
                break
            moments.append(moment)
        if not (cut / "model.safetensors").exists():
            _complete(experience, config, cut, seed)
        compare(folder / "whole", cut)
        shutil.rmtree(cut)
    return trainings, moments


def _start(experience: Path, config: TrainConfig, folder: Path, seed: int) -> multiprocessing.process.BaseProcess:
    # Forked: the libraries are loaded already, so that nearly all of the time is training.
    process = multiprocessing.get_context("fork").Process(target=train, args=(experience, config, folder, seed))
    process.start()
    return process


def _complete(experience: Path, config: TrainConfig, folder: Path, seed: int) -> None:
    process = _start(experience, config, folder, seed)
    process.join()
    assert process.exitcode == 0, f"the training failed with exit status {process.exitcode}"


def _killed(experience: Path, config: TrainConfig, folder: Path, seed: int, moment: float) -> bool:
    """Train for `moment` seconds and kill; whether the training was still under way."""
    process = _start(experience, config, folder, seed)
    process.join(moment)
    process.kill()
    process.join()
    assert process.exitcode in (0, -9), f"the training failed with exit status {process.exitcode}"
    return process.exitcode != 0


def compare(whole: Path, cut: Path) -> None:
    """Check that two trainings ended with the same weights, bit for bit, and the same figures after every epoch.

    Raises:
        AssertionError: they differ.
    """
    expected, found = (load_tensors(folder / "model.safetensors")[0] for folder in (whole, cut))
    assert expected.keys() == found.keys(), "the models have other tensors"
    for name, tensor in expected.items():
        assert torch.equal(tensor, found[name]), f"{name} differs"
    logs = []
    for folder in (whole, cut):
        lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
        logs.append([{**line, "seconds": 0} for line in lines])
    assert logs[0] == logs[1], "the figures of an epoch differ"


def main(arguments: Arguments) -> int:
    """Collect a little experience, interrupt, compare, tell."""
    torch.set_num_threads(1)
    config = TrainConfig(epochs=arguments.epochs, time_limit=0.0, device=arguments.device)
    config = replace(config, architecture=arguments.architecture)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        amount = CollectConfig(crossing_episodes=arguments.episodes, following_episodes=arguments.episodes)
        collect(load_domain("person_following"), amount, folder / "experience", seed=arguments.seed)
        experience = folder / "experience"
        trainings, moments = interrupted(experience, config, folder, arguments.kills, arguments.seed)
    print(f"{len(moments)} kills in {trainings} trainings: all weights equal to those of an uninterrupted training")
    print("seconds after the start: " + ", ".join(f"{moment:.2f}" for moment in moments))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, description=__doc__)))
