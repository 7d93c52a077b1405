"""World models and checkpoints on disk: safetensors and JSON, never pickles."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from nesy.errors import UserError
from nesy.run_folder import atomic_path, read_json, write_json
from nesy.world_model.networks import SymbolicWorldModel, WorldModel
from nesy.world_model.paper import PaperWorldModel
from nesy.world_model.structure import Structure

FORMAT = "nesy-world-model"
WEIGHTS, CONFIG = "model.safetensors", "config.json"
ARCHITECTURES = {"symbolic": SymbolicWorldModel, "paper": PaperWorldModel}
MAX_SIZE = 1 << 12


def save_tensors(path: Path, tensors: dict[str, Tensor], state: dict[str, Any]) -> None:
    """Write named tensors and a JSON value into one safetensors file, atomically."""
    with atomic_path(path) as temporary:
        contiguous = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
        save_file(contiguous, temporary, metadata={"state": json.dumps(state, allow_nan=False)})


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_tensors` wrote.

    Raises:
        UserError: the file is missing or damaged.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    try:
        with safe_open(path, framework="pt") as stream:
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
            state = json.loads((stream.metadata() or {})["state"])
    except (SafetensorError, OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{path}: damaged, cannot be read as safetensors ({reason}); train again") from None
    if not isinstance(state, dict):
        raise UserError(f"{path}: damaged, its state is no JSON object; train again")
    return tensors, state


def save_world_model(model: WorldModel, folder: Path, metrics: dict[str, Any]) -> None:
    """Write model.safetensors and config.json; the weights come last, they mark the model as complete."""
    folder = Path(folder)
    settings = model.settings()
    write_json(folder / CONFIG, {"format": FORMAT, "model": settings, "metrics": metrics})
    save_tensors(folder / WEIGHTS, model.state_dict(), {"format": FORMAT, "model": json.loads(json.dumps(settings))})


def load_world_model(folder: Path | str) -> WorldModel:
    """Read a world model, in evaluation mode, on the CPU.

    Raises:
        UserError: a file is missing, damaged, or does not belong to the others.
    """
    folder = Path(folder)
    config = read_json(folder / CONFIG)
    tensors, state = load_tensors(folder / WEIGHTS)
    if not isinstance(config, dict) or config.get("format") != FORMAT:
        raise UserError(f"{folder / CONFIG}: not the configuration of a world model")
    if config.get("model") != state.get("model"):
        raise UserError(f"{folder}: {CONFIG} and {WEIGHTS} are of different models; train again")
    try:
        model = from_settings(config["model"])
        for name in ("now", "action", "then", "weight"):  # of any length, so not checked by load_state_dict
            key = f"transitions_{name}"
            if isinstance(model, SymbolicWorldModel):
                setattr(model, key, torch.zeros_like(tensors[key]))
        model.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError, AssertionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{folder}: damaged world model ({reason}); train again") from None
    if isinstance(model, SymbolicWorldModel):
        _check_transitions(model, folder)
    return model.eval()


def from_settings(settings: dict[str, Any]) -> WorldModel:
    """An untrained model from `WorldModel.settings()`.

    Raises:
        UserError: an unknown architecture or an impossible size.
    """
    values = dict(settings)
    architecture = values.pop("architecture", None)
    if architecture not in ARCHITECTURES:
        raise UserError(f"unknown architecture '{architecture}'; known: {', '.join(ARCHITECTURES)}")
    structure = values.pop("structure", None)
    for name, value in values.items():
        if not isinstance(value, int) or not 0 < value <= MAX_SIZE:
            raise UserError(f"world model: {name} must be an integer from 1 to {MAX_SIZE}, not {value!r}")
    model: WorldModel = ARCHITECTURES[architecture](**values)
    if structure is not None and isinstance(model, SymbolicWorldModel):
        model.set_structure(_structure(structure, model))
    return model


def _structure(value: dict[str, Any], model: SymbolicWorldModel) -> Structure:
    def parents(name: str) -> tuple[tuple[tuple[int, ...], ...], ...]:
        return tuple(tuple(tuple(int(j) for j in family) for family in action) for action in value[name])

    structure = Structure(parents("parents_now"), parents("parents_next"), tuple(int(i) for i in value["order"]))
    factors = list(range(model.num_factors))
    for families in (structure.parents_now, structure.parents_next):
        shapes = [len(families) == model.num_actions, *(len(action) == model.num_factors for action in families)]
        known = all(j in factors for action in families for family in action for j in family)
        if not all(shapes) or not known:
            raise UserError("world model: the structure does not fit the number of actions and factors")
    rank = {factor: position for position, factor in enumerate(structure.order)}
    if sorted(structure.order) != factors or any(
        rank[j] >= rank[i] for action in structure.parents_next for i, family in enumerate(action) for j in family
    ):
        raise UserError("world model: the order of the factors does not fit the arcs inside slice t+1")
    widest = max(
        len(now) + len(then)
        for a in range(model.num_actions)
        for now, then in zip(structure.parents_now[a], structure.parents_next[a], strict=True)
    )
    if model.num_values ** (widest + 1) > 1 << 24:
        raise UserError(f"world model: a table of {widest} parents is too large")
    return structure


def _check_transitions(model: SymbolicWorldModel, folder: Path) -> None:
    edges = len(model.transitions_action)
    shapes = model.transitions_now.shape == model.transitions_then.shape == (edges, model.num_factors)
    types = model.transitions_now.dtype == model.transitions_then.dtype == torch.uint8
    if not shapes or not types or model.transitions_weight.shape != (edges,):
        raise UserError(f"{folder / WEIGHTS}: damaged, the transitions do not fit together; train again")
    if edges and (
        max(int(model.transitions_now.max()), int(model.transitions_then.max())) >= model.num_values
        or int(model.transitions_action.max()) >= model.num_actions
        or int(model.transitions_weight.min()) <= 0
    ):
        raise UserError(f"{folder / WEIGHTS}: damaged, a transition is out of range; train again")
