"""Checkpoints of a training: whole or not used, and never a traceback for one that does not fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from nesy.errors import UserError
from planners.dqn.checkpoints import Checkpoint, _digest, load_checkpoint, save_checkpoint


def _network(width: int = 3) -> tuple[torch.nn.Module, torch.optim.Optimizer]:
    torch.manual_seed(0)
    network = torch.nn.Linear(2, width)
    optimiser = torch.optim.Adam(network.parameters())
    network(torch.ones(1, 2)).sum().backward()
    optimiser.step()
    return network, optimiser


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    network, optimiser = _network()
    path = tmp_path / "it.safetensors"
    held = Checkpoint(np.arange(64, dtype=np.uint8).reshape(16, 4), np.zeros((0, 4)), {"updates": 7})
    save_checkpoint(path, "mine", {"network": network}, optimiser, held)
    return path


def test_what_was_saved_is_restored(stored: Path) -> None:
    network, optimiser = _network()
    torch.nn.init.zeros_(network.weight)  # type: ignore[arg-type]
    found = load_checkpoint(stored, "mine", {"network": network}, optimiser)
    assert found is not None and found.state == {"updates": 7} and found.actions[15, 3] == 63
    assert torch.equal(network.weight, _network()[0].weight)  # type: ignore[arg-type]


def test_no_changed_byte_is_taken(stored: Path) -> None:
    good = stored.read_bytes()
    header = 8 + int.from_bytes(good[:8], "little")
    for position in range(header, len(good)):
        stored.write_bytes(good[:position] + bytes([good[position] ^ 1]) + good[position + 1 :])
        network, optimiser = _network()
        assert load_checkpoint(stored, "mine", {"network": network}, optimiser) is None
        assert torch.equal(network.weight, _network()[0].weight)  # type: ignore[arg-type]


def test_one_that_does_not_fit_is_named(stored: Path) -> None:
    network, optimiser = _network(width=4)
    with pytest.raises(UserError, match=r"it\.safetensors: not a checkpoint of this training"):
        load_checkpoint(stored, "mine", {"network": network}, optimiser)
    with safe_open(str(stored), framework="pt") as stream:
        tensors = {name: stream.get_tensor(name) for name in stream.keys() if name != "actions"}  # noqa: SIM118
        metadata = dict(stream.metadata())
    save_file(tensors, str(stored), metadata=metadata | {"sha256": _digest(tensors, metadata["state"])})
    network, optimiser = _network()
    with pytest.raises(UserError, match="actions"):
        load_checkpoint(stored, "mine", {"network": network}, optimiser)
