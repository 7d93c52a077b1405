"""Checkpoints of a training: what is needed to go on as if it had never stopped, in one safetensors file.

The environments are deterministic, so the actions taken so far stand for them, for the replay memory and for all
that was perceived: who resumes takes them again. Only what learning made is stored as it is.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from nesy.errors import UserError
from nesy.run_folder import atomic_path


class Checkpoint(NamedTuple):
    """What a checkpoint holds besides the networks and the optimiser, which are restored in place.

    Attributes:
        actions: uint8 [T, B], all actions so far.
        priorities: of the replay memory, [rows, B].
        state: plain values: counters, and the state of the random generator.
    """

    actions: np.ndarray
    priorities: np.ndarray
    state: dict[str, Any]


def save_checkpoint(
    path: Path,
    fingerprint: str,
    networks: dict[str, nn.Module],
    optimiser: torch.optim.Optimizer,
    checkpoint: Checkpoint,
) -> None:
    """Write a checkpoint atomically; `fingerprint` says what training it belongs to."""
    from safetensors.torch import save_file

    tensors = {"actions": torch.from_numpy(checkpoint.actions), "priorities": torch.from_numpy(checkpoint.priorities)}
    for name, network in networks.items():
        tensors |= {f"{name}.{key}": value for key, value in network.state_dict().items()}
    for index, moments in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{index}.{key}": value for key, value in moments.items()}
    tensors = {key: value.contiguous() for key, value in tensors.items()}
    state = json.dumps(checkpoint.state)
    metadata = {"fingerprint": fingerprint, "state": state, "sha256": _digest(tensors, state)}
    with atomic_path(path) as temporary:
        save_file(tensors, str(temporary), metadata=metadata)


def load_checkpoint(
    path: Path, fingerprint: str, networks: dict[str, nn.Module], optimiser: torch.optim.Optimizer
) -> Checkpoint | None:
    """Restore networks and optimiser in place; None where there is no whole checkpoint of this training.

    Raises:
        UserError: the file is whole, but does not fit these networks.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as stored:
            metadata = stored.metadata() or {}
            if metadata.get("fingerprint") != fingerprint:
                return None
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
        if metadata["sha256"] != _digest(tensors, metadata["state"]):
            return None
        state = json.loads(metadata["state"])
    except (OSError, SafetensorError, KeyError, ValueError, RuntimeError):
        return None  # none yet, cut off or damaged: the training starts anew
    try:
        for name, network in networks.items():
            network.load_state_dict({key: tensors[f"{name}.{key}"] for key in network.state_dict()})
        moments: dict[int, dict[str, torch.Tensor]] = {}
        for name, value in tensors.items():
            if name.startswith("optimiser."):
                _, index, key = name.split(".", 2)
                moments.setdefault(int(index), {})[key] = value
        optimiser.load_state_dict({"state": moments, "param_groups": optimiser.state_dict()["param_groups"]})
        return Checkpoint(tensors["actions"].numpy(), tensors["priorities"].numpy(), state)
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise UserError(f"{path}: not a checkpoint of this training ({reason}); delete it to train anew") from None


def _digest(tensors: dict[str, torch.Tensor], state: str) -> str:
    """Of everything a checkpoint holds: safetensors would not notice a changed byte."""
    digest = hashlib.sha256(state.encode())
    for name in sorted(tensors):
        array = tensors[name].numpy()
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
