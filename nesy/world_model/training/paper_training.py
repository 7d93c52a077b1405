"""Training of the `paper` architecture as published: Adam decayed per epoch, Gumbel-softmax at a fixed temperature.

An epoch draws 600 mini-batches from the steps as they were made, so a view counts as often as it was met.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nesy.config import TrainConfig
from nesy.world_model import losses
from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.columns import Columns
from nesy.world_model.distinct import Transitions, view_keys
from nesy.world_model.paper import PaperWorldModel
from nesy.world_model.training.gates import evaluate
from nesy.world_model.training.imagination import imagined_rollouts
from nesy.world_model.training.symbolic_training import optimizer_tensors, restore_optimizer

STEPS = 600
"""Mini-batches of an epoch: 300,000 transitions at 500 each, about what 3,000 episodes of the publication give."""
CLIP = 100.0
"""Largest norm of a gradient."""


class PaperTrainer:
    """One training run; `tick` does one epoch."""

    def __init__(
        self,
        config: TrainConfig,
        seed: int,
        everything: Transitions,
        columns: Columns,
        apart: np.ndarray,
        held_out: Transitions | None,
        reference: Transitions,
    ) -> None:
        """Prepare the training.

        Args:
            config: how to learn.
            seed: of everything random.
            everything: indexes every view.
            columns: the steps.
            apart: bool [M], the maps kept out of training.
            held_out: the transitions on those; None where there are none.
            reference: what the gates are computed on, beside held-out maps.
        """
        self.config, self.seed, self.everything, self.held_out = config, seed, everything, held_out
        self.columns, self.apart, self.reference = columns, apart, reference
        self.rows = columns.rows(~apart)
        self.device = torch.device(config.device)
        self.generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.model = PaperWorldModel(view_size=everything.views.shape[1], num_actions=everything.num_actions)
        self.model.to(self.device)
        learned = columns.transitions(~apart)
        self.weights = losses.class_weights(learned.views, learned.visits).to(self.device)
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=config.learning_rate)
        # The columns' views are numbered among themselves; `everything` may hold more.
        index = np.searchsorted(view_keys(everything.views), view_keys(columns.views))
        self.views = torch.as_tensor(everything.views[index], device=self.device)
        self.held_out_figures: dict[str, Any] = {}
        self.epoch, self.finished = 0, False

    def length(self) -> int:
        """Most ticks that the run can take."""
        return self.config.epochs

    def tick(self, elapsed: float) -> dict[str, Any]:
        """Do one epoch; `elapsed` is the time used so far, in seconds."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * self.config.learning_rate_decay**self.epoch
        totals: dict[str, Tensor] = {}
        for _ in range(STEPS):
            drawn = torch.randint(len(self.rows), (self.config.batch_size,), generator=self.generator).numpy()
            parts = self._loss(self.rows[drawn])
            self.optimizer.zero_grad(set_to_none=True)
            parts["loss"].backward()
            nn.utils.clip_grad_norm_(self.model.parameters(), CLIP)
            self.optimizer.step()
            for name, value in parts.items():
                totals[name] = totals.get(name, torch.zeros((), device=self.device)) + value.detach() / STEPS
        self.epoch += 1
        codec = SymbolicCodec(self.model)
        gates = evaluate(codec, self.reference, self.everything.views)
        figures, holds = gates, all(gates["passed"].values())
        if self.held_out is not None:
            figures = evaluate(codec, self.held_out)
            maps = self.apart
            holds = holds and all(figures["passed"].values())
            figures["rollouts"] = imagined_rollouts(codec, self.columns, np.random.default_rng(self.seed), maps=maps)
            self.held_out_figures = figures
        limit = self.config.time_limit or math.inf
        self.finished = holds or self.epoch >= self.config.epochs or elapsed >= 0.95 * limit
        self.model.train()
        return {"stage": "network", **{name: float(value) for name, value in totals.items()}, **figures}

    def _loss(self, rows: np.ndarray) -> dict[str, Tensor]:
        """The parts of the loss on the steps `rows`, each a mean over batch and cells or factors, as published."""
        model, columns = self.model, self.columns
        action = torch.as_tensor(columns.action[rows].astype(np.int64), device=self.device)
        # A view is met many times in a batch: each distinct one goes through the encoder once, each meeting draws
        # its own sample. Sums and gradients are the same.
        views, place = np.unique(np.concatenate([columns.source[rows], columns.target[rows]]), return_inverse=True)
        met = torch.as_tensor(place, device=self.device)
        distinct = self.views[torch.as_tensor(views, device=self.device)]
        logits = model.encode(distinct)[met]
        before, after = self._sample(logits).chunk(2)
        now, then = logits.chunk(2)
        seen, seen_next = distinct[met].chunk(2)
        expected = model.transition_logits(before, action)
        imagined = self._sample(expected)
        inferred = model.inferred_embedding(before, imagined)
        decoded = model.decode(torch.cat([after, imagined]), torch.cat([action, action]))
        parts = {
            "reconstruction": self._cells(model.decode(before), seen) + self._cells(decoded[: len(rows)], seen_next),
            "kl": losses.kl_to_uniform(now) / model.num_factors,
            "forward": losses.kl_to_target(torch.softmax(expected, -1), torch.softmax(then, -1)) / model.num_factors
            + self._cells(decoded[len(rows) :], seen_next),
            "inverse": F.mse_loss(inferred, model.actions(action).detach()),
        }
        parts["loss"] = (
            parts["reconstruction"] + self.config.kl_weight * parts["kl"] + parts["forward"] + parts["inverse"]
        )
        return parts

    def _sample(self, logits: Tensor) -> Tensor:
        noisy = logits + losses.gumbel(logits.shape, self.generator, self.device)
        return torch.softmax(noisy / self.config.temperature, -1)

    def _cells(self, logits: Tensor, views: Tensor) -> Tensor:
        return F.cross_entropy(logits.flatten(0, 2), views.long().flatten(), weight=self.weights)

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
