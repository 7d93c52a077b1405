"""Training of the `paper` architecture as published: Adam decayed per epoch, Gumbel-softmax at a fixed temperature."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from nesy.config import TrainConfig
from nesy.world_model import losses
from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.distinct import Transitions
from nesy.world_model.gates import next_gates, view_gates
from nesy.world_model.paper import PaperWorldModel
from nesy.world_model.symbolic_training import optimizer_tensors, restore_optimizer

STEPS = 400
"""Mini-batches of an epoch: what 3,000 episodes give at 500 transitions each."""


class PaperTrainer:
    """One training run; `tick` does one epoch."""

    def __init__(
        self,
        config: TrainConfig,
        seed: int,
        everything: Transitions,
        training: Transitions,
        held_out: Transitions | None,
    ) -> None:
        self.config, self.everything, self.held_out = config, everything, held_out
        self.training = training
        self.device = torch.device(config.device)
        self.generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.model = PaperWorldModel(view_size=everything.views.shape[1])
        self.model.to(self.device)
        self.weights = losses.class_weights(training.views, training.visits).to(self.device)
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=config.learning_rate)
        self.views = torch.as_tensor(everything.views, device=self.device)
        self.chances = torch.as_tensor(training.weight, dtype=torch.float64)
        self.held_out_figures: dict[str, Any] = {}
        self.epoch, self.finished = 0, False

    def length(self) -> int:
        """Most ticks that the run can take."""
        return self.config.epochs

    def tick(self, elapsed: float) -> dict[str, Any]:
        """Do one epoch; `elapsed` is the time used so far, in seconds."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * self.config.learning_rate_decay**self.epoch
        t = self.training
        totals = {"loss": 0.0, "reconstruction": 0.0, "kl": 0.0, "forward": 0.0, "inverse": 0.0}
        for _ in range(STEPS):
            rows = torch.multinomial(self.chances, self.config.batch_size, True, generator=self.generator).numpy()
            parts = self._loss(t.source[rows], t.action[rows], t.target[rows])
            self.optimizer.zero_grad(set_to_none=True)
            parts["loss"].backward()
            self.optimizer.step()
            for name, value in parts.items():
                totals[name] += float(value.detach()) / STEPS
        self.epoch += 1
        limit = self.config.time_limit or math.inf
        self.finished = self.epoch >= self.config.epochs or elapsed >= 0.95 * limit
        target = self.everything if self.held_out is None else self.held_out
        codec = SymbolicCodec(self.model)
        figures = view_gates(codec, target.views)
        if self.finished and self.held_out is not None:
            self.held_out_figures = {**figures, **next_gates(codec, self.held_out)}
        self.model.train()
        shown = ("views_exact", "cells", "distinct_codes", "distinct_views")
        return {"stage": "network", **totals, **{name: figures[name] for name in shown}}

    def _loss(self, source: np.ndarray, actions: np.ndarray, target: np.ndarray) -> dict[str, Tensor]:
        model = self.model
        action = torch.as_tensor(actions, device=self.device)
        batch = self.views[torch.as_tensor(np.concatenate([source, target]), device=self.device)]
        logits = model.encode(batch)
        noisy = logits + losses.gumbel(logits.shape, self.generator, self.device)
        sample = torch.softmax(noisy / self.config.temperature, -1)
        belief = torch.softmax(logits, -1)
        before, after = sample.chunk(2)
        predicted = model.transition(before, action)
        embedding = model.actions(action).detach()
        parts = {
            "reconstruction": losses.reconstruction(model.decode(sample), batch, self.weights),
            "kl": losses.kl_to_uniform(logits),
            "forward": losses.kl_to_target(predicted, belief[len(source) :]),
            "inverse": F.mse_loss(model.inferred_embedding(before, after), embedding),
        }
        parts["loss"] = (
            parts["reconstruction"] + self.config.kl_weight * parts["kl"] + parts["forward"] + parts["inverse"]
        )
        return parts

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that the next tick depends on: tensors, and a JSON value."""
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= optimizer_tensors(self.optimizer)
        tensors["generator"] = self.generator.get_state()
        value = {"epoch": self.epoch, "finished": self.finished, "held_out": self.held_out_figures}
        return tensors, value

    def restore(self, tensors: dict[str, Tensor], value: dict[str, Any]) -> None:
        """Continue from what `state` gave."""
        self.model.load_state_dict({n[6:]: tensor for n, tensor in tensors.items() if n.startswith("model.")})
        restore_optimizer(self.optimizer, tensors)
        self.generator.set_state(tensors["generator"])
        self.epoch, self.finished = value["epoch"], value["finished"]
        self.held_out_figures = value["held_out"]
