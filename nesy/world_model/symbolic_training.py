"""Training of the `symbolic` architecture, in four stages.

1. `network`: encoder, decoder, inverse model and an autoregressive forward guide are trained together on
   `L = L_VAE + L_forward + L_inverse` with straight-through Gumbel samples of a falling temperature, less a
   bonus for using all values. Only maps that are not held out are learned from; the figures on held-out maps are
   those at the end of this stage.
2. `questions` and 3. `codes` (where the distinct views are few): a code book is searched whose named factors answer
   questions about the view, and whose other factors make codes distinct and the next code predictable
   (`code_search.py`).
4. `fit`: encoder, decoder and inverse model learn the code book, until every view is encoded to its code and rebuilt
   exactly. The tables are then counted from the encoder's own codes.

Where views are many, stages 2 and 3 are left out and the last stage goes on as the first without noise.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from domains.core import PredicateVocabulary
from nesy.config import TrainConfig
from nesy.world_model import losses
from nesy.world_model.code_search import CodeSearch, structure_of
from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.distinct import Transitions, view_keys
from nesy.world_model.gates import limits, next_gates, view_gates
from nesy.world_model.networks import SymbolicWorldModel, perceptron
from nesy.world_model.questions import Questions
from nesy.world_model.refinement import Refiner
from nesy.world_model.structure import Limits

REFINE_UP_TO = 5000
"""Most distinct views for which codes are refined one by one."""
MOST_STEPS = 200
"""Mini-batches in one epoch at most."""
MOST_PARENTS = 5
"""Parents of a factor in both slices together: a table has `values ** MOST_PARENTS` rows at most."""
LEARNING_SCALE = 0.3
"""Share of the configured step size that suits plain perceptrons."""
USAGE_WEIGHT, FORWARD_WEIGHT, INVERSE_WEIGHT = 0.02, 0.1, 0.1
FIT_EPOCHS = 120
"""Epochs that the third stage may take at least."""
PASSES = 4
"""How often an epoch of the third stage shows every view."""


class ForwardGuide(nn.Module):
    """Predicts the next code factor by factor, later factors seeing the earlier ones; only used in training."""

    mask: Tensor

    def __init__(self, model: SymbolicWorldModel) -> None:
        super().__init__()
        self.sizes = (model.num_factors, model.num_values, model.num_actions)
        code = model.num_factors * model.num_values
        self.context = perceptron(code + model.num_actions, model.hidden, code)
        self.earlier = nn.Linear(code, code, bias=False)
        factor = torch.arange(code) // model.num_values
        self.register_buffer("mask", (factor[:, None] > factor[None, :]).float())

    def forward(self, belief: Tensor, action: Tensor, then: Tensor) -> Tensor:
        """Logits [B, N, K] of the next code, given what really followed in earlier factors, `then` [B, N, K]."""
        num_factors, num_values, num_actions = self.sizes
        inputs = torch.cat([belief.flatten(1), F.one_hot(action.long(), num_actions).float()], 1)
        logits = self.context(inputs) + F.linear(then.flatten(1), self.earlier.weight * self.mask)
        shaped: Tensor = logits.view(-1, num_factors, num_values)
        return shaped


class SymbolicTrainer:
    """One training run; `tick` does one epoch or one round, and all state goes through `state` and `restore`."""

    stages = ("network", "questions", "codes", "fit")

    def __init__(
        self,
        config: TrainConfig,
        seed: int,
        everything: Transitions,
        training: Transitions,
        held_out: Transitions | None,
        predicates: PredicateVocabulary | None = None,
    ) -> None:
        self.config, self.everything, self.held_out = config, everything, held_out
        self.refines = everything.num_views <= REFINE_UP_TO
        self.training = training
        self.final = everything if self.refines else training
        self.device = torch.device(config.device)
        self.generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.model = SymbolicWorldModel(view_size=everything.views.shape[1])
            self.guide = ForwardGuide(self.model)
        self.model.to(self.device)
        self.guide.to(self.device)
        self.weights = losses.class_weights(training.views, np.maximum(training.visits, 0)).to(self.device)
        self.optimizer = self._optimizer(config.learning_rate * LEARNING_SCALE)
        self.rng = np.random.default_rng(seed)
        arcs = 2 if config.intra_slice_arcs else 0
        bounds = Limits(
            now=config.max_parents, next=arcs, total=min(config.max_parents + arcs, MOST_PARENTS), penalty=1.0
        )
        self.refiner = Refiner(self.final, self.model.num_values, self.model.num_actions, bounds)
        self.train_refiner = Refiner(training, self.model.num_values, self.model.num_actions, bounds)
        self.search: CodeSearch | None = None
        if self.refines:
            questions = Questions.about_cells(everything.views)
            if predicates is not None:
                truth = predicates.evaluate(everything.views)
                questions = Questions.of(predicates.names, truth, config.headline)
            self.search = CodeSearch(
                self.refiner, questions, self.model.num_factors, config.named_factors, config.headline
            )
        self.held_out_figures: dict[str, Any] = {}
        self.stage, self.epoch, self.finished = "network", 0, False
        self.views = torch.as_tensor(everything.views, device=self.device)

    # ---------------------------------------------------------------- progress and time
    def length(self) -> int:
        """Most ticks that the run can take."""
        return sum(self._rounds(stage) for stage in self.stages)

    def _rounds(self, stage: str) -> int:
        epochs, refines = self.config.epochs, self.refines
        named = self.search is not None and self.search.named > 0
        return {
            "network": epochs,
            "questions": max(3, round(epochs / 6)) if named else 0,
            "codes": max(4, round(epochs / 2)) if refines else 0,
            # A refined code book is learned from scratch, which takes its time however little there was before.
            "fit": max(epochs, FIT_EPOCHS) if refines else epochs,
        }[stage]

    def deadline(self) -> float:
        """Seconds of the time limit after which the present stage must end."""
        if not self.config.time_limit:
            return math.inf
        share = {"network": 0.3 if self.refines else 0.7, "questions": 0.6, "codes": 0.8, "fit": 0.97}[self.stage]
        return share * self.config.time_limit

    def tick(self, elapsed: float) -> dict[str, Any]:
        """Do one epoch or round; `elapsed` is the time used so far, in seconds."""
        stage = self.stage
        figures = {
            "network": self._network_epoch,
            "questions": self._questions_round,
            "codes": self._codes_round,
            "fit": self._fit_epoch,
        }[stage]()
        self.epoch += 1
        if self.epoch >= self._rounds(stage) or figures.pop("converged", False) or elapsed >= self.deadline():
            self._end_stage()
        return {"stage": stage, **figures}

    def _end_stage(self) -> None:
        if self.stage == "network":
            self._measure_held_out()
            if self.search is not None:
                self.search.start(self._logits(), self.rng)
        if self.stage == "questions" and self.search is not None:
            self.search.separate()
        if self.stage == "fit":
            self._set_forward_model(self.final)
            if not self.refines:
                self._measure_held_out()
            self.finished = True
            return
        self.stage = next(
            stage for stage in self.stages[self.stages.index(self.stage) + 1 :] if self._rounds(stage) > 0
        )
        self.epoch = 0
        self.optimizer = self._optimizer(self.config.learning_rate * LEARNING_SCALE * (1.0 if self.refines else 0.3))

    # ---------------------------------------------------------------- stage 1
    def _network_epoch(self) -> dict[str, Any]:
        done = self.epoch / self.config.epochs
        noise = max(0.0, 1.0 - 1.3 * done)
        temperature = max(0.4, 1.0 - done)
        figures = self._autoencoder_epoch(noise, temperature, done)
        return {**figures, "temperature": temperature, **self._view_figures()}

    def _autoencoder_epoch(self, noise: float, temperature: float, done: float) -> dict[str, float]:
        self._set_learning_rate(done)
        t = self.training
        order = torch.randperm(len(t), generator=self.generator)
        steps = min(MOST_STEPS, max(1, len(t) // self.config.batch_size))
        totals = {"loss": 0.0, "reconstruction": 0.0, "kl": 0.0, "forward": 0.0, "inverse": 0.0}
        for rows in order[: steps * self.config.batch_size].chunk(steps):
            parts = self._loss(rows.numpy(), noise, temperature)
            self.optimizer.zero_grad(set_to_none=True)
            parts["loss"].backward()
            self.optimizer.step()
            for name, value in parts.items():
                totals[name] += float(value.detach()) / steps
        return totals

    def _loss(self, rows: np.ndarray, noise: float, temperature: float) -> dict[str, Tensor]:
        t, model = self.training, self.model
        action = torch.as_tensor(t.action[rows], device=self.device)
        # Source and target views overlap much; each distinct view goes through the encoder once.
        views, place = np.unique(np.concatenate([t.source[rows], t.target[rows]]), return_inverse=True)
        source, target = torch.as_tensor(place, device=self.device).chunk(2)
        batch = self.views[torch.as_tensor(views, device=self.device)]
        logits = model.encode(batch)
        sample, soft = losses.sample_straight_through(logits, temperature, noise, self.generator)
        certain = model.one_hot(logits.argmax(-1))
        before, then = sample[source], certain[target]
        parts = {
            "reconstruction": losses.reconstruction(model.decode(sample), batch, self.weights),
            "kl": losses.kl_to_uniform(logits),
            "forward": F.cross_entropy(self.guide(before, action, then).flatten(0, 1), then.argmax(-1).flatten())
            * model.num_factors,
            "inverse": F.cross_entropy(model.infer_action(before, sample[target]), action),
        }
        # The KL pulls towards the uniform prior; its weight fades with the noise, for codes are to be certain.
        parts["loss"] = (
            parts["reconstruction"]
            + self.config.kl_weight * noise * 0.1 * parts["kl"]
            + FORWARD_WEIGHT * parts["forward"]
            + INVERSE_WEIGHT * parts["inverse"]
            - USAGE_WEIGHT * losses.usage_entropy(soft)
        )
        return parts

    # ---------------------------------------------------------------- stages 2 and 3
    def _questions_round(self) -> dict[str, Any]:
        assert self.search is not None
        return self.search.questions_round(self.epoch / (self._rounds("questions") - 1), self.rng)

    def _codes_round(self) -> dict[str, Any]:
        assert self.search is not None
        return self.search.codes_round(self.epoch / self._rounds("codes"), self.rng)

    def named_factors(self) -> dict[str, Any]:
        """The questions of the named factors and what every value answers; see `CodeSearch.meanings`."""
        return self.search.meanings() if self.search is not None else {}

    # ---------------------------------------------------------------- stage 4
    def _fit_epoch(self) -> dict[str, Any]:
        done = self.epoch / self._rounds("fit")
        if self.search is None or self.search.book is None:
            return {**self._autoencoder_epoch(0.0, 0.4, done), **self._view_figures()}
        self._set_learning_rate(done)
        t, model = self.final, self.model
        codes = torch.as_tensor(self.search.book.codes, device=self.device)
        size = min(t.num_views, self.config.batch_size)
        steps = max(8, min(MOST_STEPS, PASSES * t.num_views // size))
        totals = {"loss": 0.0, "code": 0.0, "reconstruction": 0.0, "inverse": 0.0}
        for _ in range(steps):
            rows = torch.randperm(t.num_views, generator=self.generator)[:size].to(self.device)
            edges = torch.randint(len(t), (size,), generator=self.generator).numpy()
            before, after = (model.one_hot(codes[torch.as_tensor(ends[edges])]) for ends in (t.source, t.target))
            action = torch.as_tensor(t.action[edges], device=self.device)
            parts = {
                "code": F.cross_entropy(model.encode(self.views[rows]).flatten(0, 1), codes[rows].flatten())
                * model.num_factors,
                "reconstruction": losses.reconstruction(model.decode(model.one_hot(codes[rows])), self.views[rows]),
                "inverse": F.cross_entropy(model.infer_action(before, after), action),
            }
            parts["loss"] = parts["code"] + parts["reconstruction"] + parts["inverse"]
            self.optimizer.zero_grad(set_to_none=True)
            parts["loss"].backward()
            self.optimizer.step()
            for name, value in parts.items():
                totals[name] += float(value.detach()) / steps
        figures = self._view_figures()
        with torch.no_grad():
            agree = float((model.codes(self.views) == codes).all(1).float().mean())
        settled = done >= 0.5 and agree == 1.0 and figures["views_exact"] == 1.0
        return {**totals, "code_agreement": agree, **figures, "converged": settled}

    # ---------------------------------------------------------------- shared
    def _view_figures(self) -> dict[str, Any]:
        # The gates of every epoch: on held-out maps where the stage leaves some out, on all views otherwise.
        held_out = self.held_out is not None and (self.stage == "network" or not self.refines)
        target = self.held_out if held_out and self.held_out is not None else self.final
        figures = view_gates(SymbolicCodec(self.model), target.views)
        self.model.train()
        return figures

    def _measure_held_out(self) -> None:
        if self.held_out is None:
            return
        self._set_forward_model(self.training)
        codec = SymbolicCodec(self.model)
        new = ~np.isin(view_keys(self.held_out.views), view_keys(self.training.views[self.training.visits > 0]))
        self.held_out_figures = {**view_gates(codec, self.held_out.views), **next_gates(codec, self.held_out)}
        self.held_out_figures |= {"limits": limits(self.held_out), "new_views": int(new.sum())}
        if new.any():
            figures = view_gates(codec, self.held_out.views[new])
            self.held_out_figures |= {f"new_{name}": figures[name] for name in ("views_exact", "cells")}
        self.model.train()

    def _set_forward_model(self, transitions: Transitions) -> None:
        t = transitions
        refiner = self.refiner if t is self.final else self.train_refiner
        with torch.no_grad():
            codes = self.model.codes(self.views).cpu().numpy().astype(np.int64)
        found = self.search.book if self.search is not None else None
        start = found.structure if found is not None else None
        book = refiner.search(codes, start)
        self.model.set_transitions(book.structure, codes[t.source], t.action, codes[t.target], t.weight)

    def _logits(self) -> np.ndarray:
        with torch.no_grad():
            return np.asarray(self.model.encode(self.views).cpu().numpy(), dtype=np.float64)

    def _optimizer(self, rate: float) -> torch.optim.Adam:
        modules = [*self.model.parameters(), *self.guide.parameters()]
        return torch.optim.Adam(modules, lr=rate)

    def _set_learning_rate(self, done: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = group["initial_lr"] = group.get("initial_lr", group["lr"])
            group["lr"] = group["initial_lr"] * (0.03 + 0.97 * 0.5 * (1 + math.cos(math.pi * done)))

    # ---------------------------------------------------------------- state
    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that the next tick depends on: tensors, and a JSON value."""
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"guide.{name}": value for name, value in self.guide.state_dict().items()}
        tensors |= optimizer_tensors(self.optimizer)
        tensors["generator"] = self.generator.get_state()
        value: dict[str, Any] = {
            "stage": self.stage,
            "epoch": self.epoch,
            "finished": self.finished,
            "rng": self.rng.bit_generator.state,
            "rates": [[group["lr"], group.get("initial_lr", group["lr"])] for group in self.optimizer.param_groups],
            "held_out": self.held_out_figures,
        }
        structure = self.model.settings().get("structure")
        if structure is not None:
            value["structure"] = structure
        if self.search is not None:
            search_tensors, value["search"] = self.search.state()
            tensors |= search_tensors
        return tensors, value

    def restore(self, tensors: dict[str, Tensor], value: dict[str, Any]) -> None:
        """Continue from what `state` gave."""
        weights = {name[6:]: tensor for name, tensor in tensors.items() if name.startswith("model.")}
        for name in ("now", "action", "then", "weight"):
            key = f"transitions_{name}"
            setattr(self.model, key, torch.zeros_like(weights[key], device=self.device))
        self.model.load_state_dict(weights)
        self.guide.load_state_dict({n[6:]: tensor for n, tensor in tensors.items() if n.startswith("guide.")})
        self.optimizer = self._optimizer(self.config.learning_rate)
        restore_optimizer(self.optimizer, tensors)
        for group, (rate, initial) in zip(self.optimizer.param_groups, value["rates"], strict=True):
            group["lr"], group["initial_lr"] = rate, initial
        self.generator.set_state(tensors["generator"])
        self.rng.bit_generator.state = value["rng"]
        self.stage, self.epoch, self.finished = value["stage"], value["epoch"], value["finished"]
        self.held_out_figures = value["held_out"]
        if "structure" in value:
            self.model.set_structure(structure_of(value["structure"]))
        if self.search is not None:
            self.search.restore(tensors, value["search"])


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Adam's moments and step counts by name."""
    tensors = {}
    for index, state in optimizer.state_dict()["state"].items():
        for name, tensor in state.items():
            tensors[f"optimizer.{index}.{name}"] = tensor
    return tensors


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Put back what `optimizer_tensors` gave."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimizer."):
            _, index, part = name.split(".", 2)
            state.setdefault(int(index), {})[part] = tensor
    value = optimizer.state_dict()
    value["state"] = state
    optimizer.load_state_dict(value)
