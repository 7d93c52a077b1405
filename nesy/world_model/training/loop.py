"""Training as a product: one loop for both architectures, with checkpoints, logs and the gates.

After every epoch the whole state (weights, optimiser, generators, codes) is written atomically, so a training
killed at any moment goes on at the last finished epoch and ends with the same weights, bit for bit.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from domains.core import Domain, Symmetry, Weighting, symmetries_of
from nesy.config import TrainConfig
from nesy.errors import UserError
from nesy.log.experience import Experience
from nesy.progress import SILENT, Progress
from nesy.run_folder import write_json
from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.codes.readability import readability
from nesy.world_model.columns import Columns
from nesy.world_model.distinct import Transitions, reference_transitions
from nesy.world_model.images import with_images
from nesy.world_model.storage import load_tensors, save_tensors, save_world_model
from nesy.world_model.training.gates import evaluate
from nesy.world_model.training.held_out import HeldOut
from nesy.world_model.training.imagination import imagined_rollouts
from nesy.world_model.training.logs import MetricsLog
from nesy.world_model.training.paper_training import PaperTrainer
from nesy.world_model.training.symbolic_training import SymbolicTrainer

CHECKPOINT = "checkpoint.safetensors"
Trainer = SymbolicTrainer | PaperTrainer
ARCHITECTURES = ("symbolic", "paper")
SHOWN = ("loss", "views_exact", "next_code_nll", "code_agreement")


def train(
    experience: Experience | Path,
    config: TrainConfig,
    folder: Path | str,
    seed: int = 0,
    progress: Progress = SILENT,
    *,
    domain: Domain | None = None,
    variant: str = "paper",
    symmetries: Sequence[Symmetry] | None = None,
) -> dict[str, Any]:
    """Train a world model, or go on where an interrupted training stopped.

    Args:
        experience: what to learn from: in memory, or a folder, whose steps are then mapped (see `columns`).
        config: how to learn.
        folder: where model, checkpoint and logs go.
        seed: of everything random.
        progress: where to report.
        domain: where the experience is from. If its maps can be listed, all their views are encoded and rebuilt,
            also those that no episode shows (rooms behind the goal), and the gates are computed on all maps, poses
            and actions alike; without it, on what was experienced. It also says how many actions there are, and what
            `config` leaves to the world.
        variant: of the domain.
        symmetries: of the world; those that the domain declares by default.

    Returns:
        The gates with the limits of the data beside them (see `gates.evaluate`): views of all kinds, transitions
        of the crossing task; `following`, the same for the transitions of the following task; `held_out`, figures
        from before anything on held-out maps was learned from (of the final codes); `rollouts`, the likeliest view
        after 1 to 8 imagined steps; `readability` (details in readability.json); `epochs`, `seconds`,
        `architecture`.

    Raises:
        UserError: impossible settings, no experience, or some that cannot be learned from: views that are not square,
            other kinds of cells, actions that the domain lacks.
    """
    folder = Path(folder)
    symmetries = symmetries_of(domain) if symmetries is None else tuple(symmetries)
    name = "this experience" if domain is None else domain.spec.name
    weighting: Weighting = "visits" if domain is None else domain.spec.weighting
    config = config.in_world(name, weighting, bool(symmetries))
    num_actions = None if domain is None else len(domain.spec.action_names)
    _check(config)
    threads, exact = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    torch.set_num_threads(1)  # small networks: one thread is as fast, and sums are in the same order everywhere
    if torch.device(config.device).type == "cuda":
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # or matrix products may differ from run to run
        torch.use_deterministic_algorithms(True)
    try:
        if isinstance(experience, Experience):
            columns = Columns.of(experience, num_actions)
        else:
            columns = Columns.mapped(experience, folder, num_actions)
        return _train(columns, config, folder, seed, progress, domain, variant, symmetries)
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(exact)


def _train(
    columns: Columns,
    config: TrainConfig,
    folder: Path,
    seed: int,
    progress: Progress,
    domain: Domain | None,
    variant: str,
    symmetries: tuple[Symmetry, ...],
) -> dict[str, Any]:
    assert config.weighting is not None
    references = {} if domain is None else _references(domain, variant)
    known = [reference.views for reference in references.values()]
    everything = columns.transitions(views=np.concatenate(known) if known else None, weighting=config.weighting)
    if config.mirror_images:
        everything = with_images(everything, symmetries)
    apart = columns.held_out(config.held_out, np.random.default_rng(seed))
    reference = everything if domain is None else references.get(domain.spec.model_task, everything)
    trainer: Trainer
    if config.architecture == "paper":
        held_out = columns.transitions(apart, weighting=config.weighting) if apart.any() else None
        trainer = PaperTrainer(config, seed, everything, columns, apart, held_out, reference)
    else:
        training = everything
        if apart.any():
            training = columns.transitions(~apart, everything.views, config.weighting)
            if config.mirror_images:
                training = with_images(training, symmetries, views=everything.views)
        kept = HeldOut(columns, apart, training, seed, config.weighting) if apart.any() else None
        predicates = domain.predicates if domain is not None else None
        trainer = SymbolicTrainer(config, seed, everything, training, kept, predicates, reference)
    fingerprint = _fingerprint(config, seed, everything)
    tick, elapsed = _resume(trainer, folder / CHECKPOINT, fingerprint)
    with MetricsLog(folder, keep=tick) as log, progress.task("training the world model", trainer.length()) as bar:
        bar.advance(tick)
        started = time.monotonic() - elapsed
        while not trainer.finished:
            figures = trainer.tick(time.monotonic() - started)
            tick += 1
            elapsed = time.monotonic() - started
            log.write(tick, {**figures, "seconds": round(elapsed, 3)})
            tensors, state = trainer.state()
            value = {"trainer": state, "tick": tick, "elapsed": elapsed, "fingerprint": fingerprint}
            save_tensors(folder / CHECKPOINT, tensors, value)
            shown = {name: figures[name] for name in SHOWN if name in figures}
            bar.advance(1, **shown)
    codec = SymbolicCodec(trainer.model)
    metrics: dict[str, Any] = {
        **evaluate(codec, reference, everything.views),
        **({"following": evaluate(codec, references["following"])} if "following" in references else {}),
        "held_out": trainer.held_out_figures,
        "rollouts": imagined_rollouts(codec, columns, np.random.default_rng(seed)),
        "architecture": config.architecture,
        "epochs": tick,
        "seconds": round(elapsed, 2),
    }
    if domain is not None:
        truth = domain.predicates.evaluate(everything.views)
        read = readability(codec.codes(everything.views), truth, domain.predicates.names, codec.num_values)
        named = trainer.named_factors() if isinstance(trainer, SymbolicTrainer) else {}
        write_json(folder / "readability.json", {**read, "named": named})
        metrics["readability"] = {name: read[name] for name in ("mean_factors", "single", "pairs", "mean_information")}
    save_world_model(trainer.model, folder, metrics)
    return metrics


def _references(domain: Domain, variant: str) -> dict[str, Transitions]:
    """All transitions of every task, by task; empty where the world does not list them."""
    found = {task: reference_transitions(domain, variant, task) for task in domain.spec.tasks}
    return {task: transitions for task, transitions in found.items() if transitions is not None}


def _check(config: TrainConfig) -> None:
    if config.architecture not in ARCHITECTURES:
        raise UserError(f"unknown architecture '{config.architecture}'; known: {', '.join(ARCHITECTURES)}")
    try:
        torch.empty(1, device=config.device)
    except (RuntimeError, AssertionError) as error:
        raise UserError(f"--device {config.device}: not usable here ({str(error).splitlines()[0]})") from None


def _fingerprint(config: TrainConfig, seed: int, transitions: Transitions) -> str:
    """What a checkpoint must agree in to be gone on from; the time limit may change."""
    settings = {
        **dataclasses.asdict(config),
        "time_limit": 0.0,
        "seed": seed,
        "num_actions": transitions.num_actions,
    }
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for array in (transitions.views, transitions.source, transitions.action, transitions.target, transitions.weight):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _resume(trainer: Trainer, path: Path, fingerprint: str) -> tuple[int, float]:
    """Restore the checkpoint, if there is one of this very training; returns its tick and the seconds used."""
    if not path.exists():
        return 0, 0.0
    tensors, value = load_tensors(path)
    if value.get("fingerprint") != fingerprint:
        return 0, 0.0
    try:
        trainer.restore(tensors, value["trainer"])
        return int(value["tick"]), float(value["elapsed"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{path}: damaged checkpoint ({reason}); delete it to train anew") from None
