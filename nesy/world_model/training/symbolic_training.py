"""Training of the `symbolic` architecture.

1. `questions` and 2. `codes`: a code book is searched whose named factors answer questions about the view, and whose
   other factors make codes distinct and the next code predictable (`code_search.py`). Only steps on maps that are
   not held out count. Where the codes predict too badly to pass, there is another search, and the better book stays.
3. `fit`: encoder, decoder and inverse model learn the codes of the views met on those maps, until each is encoded to
   its code and rebuilt exactly. The gates on held-out maps are those of this stage.
4. `complete`: the views met nowhere but on held-out maps, or by nobody, are learned too. The tables are then counted
   from all steps, in the encoder's own codes.

Where views are too many to search a code book (`REFINE_UP_TO`), two stages of gradients alone take the place of all
these: `network`, with noise that fades (`autoencoding.py`), and `fit`, without.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from domains.core import PredicateVocabulary
from nesy.config import TrainConfig
from nesy.world_model import losses
from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.codes.autoencoding import Autoencoding, ForwardGuide, Ingredients
from nesy.world_model.codes.code_search import CodeSearch, structure_of
from nesy.world_model.codes.questions import Questions
from nesy.world_model.codes.refinement import Refiner
from nesy.world_model.distinct import Transitions
from nesy.world_model.networks import SymbolicWorldModel
from nesy.world_model.structure import Limits, Structure
from nesy.world_model.training.gates import evaluate, limits, view_gates
from nesy.world_model.training.held_out import HeldOut

REFINE_UP_TO = 5000
"""Most distinct views for which codes are refined one by one."""
MOST_STEPS = 200
"""Mini-batches in one epoch at most."""
MOST_PARENTS = 5
"""Parents of a factor in both slices together: a table has `values ** MOST_PARENTS` rows at most."""
LEARNING_SCALE = 0.3
"""Share of the configured step size that suits plain perceptrons."""
CALMER = 0.1
"""Factor on it in the last stage, which goes on from what is learned."""
ENOUGH = 0.08
"""Nats above the limit of the data at which a code book passes: the gate's margin less what steps never met cost."""
FIT_EPOCHS = 40
"""Epochs that learning a code book may take at least: it is learned from scratch, whatever the number of epochs."""
FIT_STEPS = 20
"""Mini-batches in one of them at least."""
PASSES = 8
"""How often one of them shows every view."""


class SymbolicTrainer:
    """One training run; `tick` does one epoch or one round, and all state goes through `state` and `restore`."""

    stages = ("network", "questions", "codes", "fit", "complete")

    def __init__(
        self,
        config: TrainConfig,
        seed: int,
        everything: Transitions,
        training: Transitions,
        held_out: HeldOut | None,
        predicates: PredicateVocabulary | None = None,
        reference: Transitions | None = None,
        ingredients: Ingredients | None = None,
        refine_up_to: int | None = None,
    ) -> None:
        """Prepare the training.

        Args:
            config: how to learn.
            seed: of everything random.
            everything: all that was met, indexes every view.
            training: what was met on maps that are not held out; indexes the same views.
            held_out: what was met on the others.
            predicates: to ask about views; by default the kinds of cells.
            reference: what the gates are computed on at the end; `everything` by default.
            ingredients: of the loss where views are many.
            refine_up_to: most views for which a code book is searched; `REFINE_UP_TO` by default.
        """
        self.config, self.everything, self.training, self.held_out = config, everything, training, held_out
        self.reference = everything if reference is None else reference
        self.refines = everything.num_views <= (REFINE_UP_TO if refine_up_to is None else refine_up_to)
        self.ingredients = ingredients or Ingredients()
        self.device = torch.device(config.device)
        self.generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.model = SymbolicWorldModel(view_size=everything.views.shape[1], num_actions=everything.num_actions)
            self.guide = ForwardGuide(self.model)
        self.model.to(self.device)
        self.guide.to(self.device)
        self.autoencoding = Autoencoding(
            self.model, self.guide, training, config.kl_weight, self.ingredients, self.generator
        )
        self.optimizer = self._optimizer(config.learning_rate * LEARNING_SCALE)
        self.rng = np.random.default_rng(seed)
        arcs = 2 if config.intra_slice_arcs else 0
        self.bounds = Limits(
            now=config.max_parents, next=arcs, total=min(config.max_parents + arcs, MOST_PARENTS), penalty=1.0
        )
        self.search: CodeSearch | None = None
        if self.refines:
            questions = Questions.about_cells(everything.views)
            if predicates is not None:
                truth = predicates.evaluate(everything.views)
                questions = Questions.of(predicates.names, truth, config.headline)
            self.search = CodeSearch(
                self._refiner(training), questions, self.model.num_factors, config.named_factors, config.headline
            )
        self.limit = limits(training)["next_code_nll"]
        self.held_out_figures: dict[str, Any] = {}
        self.epoch, self.searches, self.finished = 0, 1, False
        self.stage = self._first_stage()
        self.views = torch.as_tensor(everything.views, device=self.device)

    # ---------------------------------------------------------------- progress and time
    def length(self) -> int:
        """Most ticks that the run can take."""
        searched = sum(self._rounds(stage) for stage in ("questions", "codes"))
        return sum(self._rounds(stage) for stage in self.stages) + (self.config.searches - 1) * searched

    def _first_stage(self) -> str:
        return next(stage for stage in self.stages if self._rounds(stage) > 0)

    def _rounds(self, stage: str) -> int:
        epochs = self.config.epochs
        if self.search is None:
            return epochs if stage in ("network", "fit") else 0
        return {
            "network": 0,
            "questions": max(3, round(epochs / 6)) if self.search.named else 0,
            "codes": max(4, round(epochs / 2)),
            "fit": max(round(2 * epochs / 3), FIT_EPOCHS),
            "complete": max(round(2 * epochs / 3), FIT_EPOCHS),
        }[stage]

    def deadline(self) -> float:
        """Seconds of the time limit after which the present stage must end."""
        if not self.config.time_limit:
            return math.inf
        first = {"network": 0.7, "questions": 0.35, "codes": 0.7, "fit": 0.9, "complete": 0.97}
        share = first if self.searches == 1 else {**first, "questions": 0.55, "codes": 0.8}
        return share[self.stage] * self.config.time_limit

    def tick(self, elapsed: float) -> dict[str, Any]:
        """Do one epoch or round; `elapsed` is the time used so far, in seconds."""
        stage = self.stage
        self.model.train()
        figures = self._network_epoch() if self.search is None else self._search_or_fit(self.search)
        self.epoch += 1
        settled = figures.pop("settled", False)
        if settled or self.epoch >= self._rounds(stage) or elapsed >= self.deadline():
            self._end_stage()
        return {"stage": stage, **figures}

    def _search_or_fit(self, search: CodeSearch) -> dict[str, Any]:
        if search.book is None:
            search.start(self.rng)
        done = self.epoch / self._rounds(self.stage)
        if self.stage in ("fit", "complete"):
            return self._fit_epoch(done)
        if self.stage == "questions":
            figures = search.questions_round(self.epoch / (self._rounds("questions") - 1), self.rng)
        else:
            figures = search.codes_round(done, self.rng)
        if self.held_out is not None and search.book is not None:
            figures["next_code_nll"] = self.held_out.nll(search.book, self.model.num_values)
        return figures

    def _end_stage(self) -> None:
        if self.stage == "questions" and self.search is not None:
            self.search.separate()
        if self.stage == "codes" and self.search is not None:
            self.search.keep()
            assert self.search.book is not None
            if self.search.book.nll > self.limit + ENOUGH and self.searches < self.config.searches:
                self.search.again()
                self.searches += 1
                self.stage, self.epoch = self._first_stage(), 0
                return
        later = [s for s in self.stages[self.stages.index(self.stage) + 1 :] if self._rounds(s) > 0]
        if not later:
            if self.search is None:
                self._set_forward_model(self.training)
                if self.held_out is not None:
                    self.held_out_figures = self.held_out.gates(SymbolicCodec(self.model))
            self.finished = True
            return
        self.stage, self.epoch = later[0], 0
        scale = LEARNING_SCALE * (CALMER if len(later) == 1 else 1.0)
        self.optimizer = self._optimizer(self.config.learning_rate * scale)

    # ---------------------------------------------------------------- many views
    def _network_epoch(self) -> dict[str, Any]:
        done = self.epoch / self._rounds(self.stage)
        self._set_learning_rate(done)
        progress = done if self.stage == "network" else 1.0
        noise, temperature = self.ingredients.noise(progress), self.ingredients.temperature(progress)
        order = torch.randperm(len(self.training), generator=self.generator)
        steps = min(MOST_STEPS, max(1, len(order) // self.config.batch_size))
        totals: dict[str, float] = {}
        for rows in order[: steps * self.config.batch_size].chunk(steps):
            self._step(self.autoencoding.loss(rows.numpy(), noise, temperature), totals, steps)
        codec = SymbolicCodec(self.model)
        if self.held_out is not None:
            gates = self.held_out.guided(codec, self.guide)
        else:
            gates = view_gates(codec, self.everything.views)
        return {**totals, "temperature": temperature, **gates}

    # ---------------------------------------------------------------- a code book is learned
    def _fit_epoch(self, done: float) -> dict[str, Any]:
        assert self.search is not None and self.search.book is not None
        self._set_learning_rate(done)
        t = self.training if self.stage == "fit" else self.everything
        model, book = self.model, self.search.book
        codes = torch.as_tensor(book.codes, device=self.device)
        known = torch.arange(t.num_views) if self.stage == "complete" else torch.as_tensor(np.flatnonzero(t.visits))
        size = min(len(known), self.config.batch_size)
        steps = max(FIT_STEPS, min(MOST_STEPS, PASSES * len(known) // size))
        chance = torch.as_tensor(t.weight, dtype=torch.float32)
        totals: dict[str, float] = {}
        for _ in range(steps):
            rows = known[torch.randperm(len(known), generator=self.generator)[:size]].to(self.device)
            edges = torch.multinomial(chance, size, replacement=True, generator=self.generator).numpy()
            before, after = (model.one_hot(codes[torch.as_tensor(ends[edges])]) for ends in (t.source, t.target))
            action = torch.as_tensor(t.action[edges], device=self.device)
            parts = {
                "code": F.cross_entropy(model.encode(self.views[rows]).flatten(0, 1), codes[rows].flatten())
                * model.num_factors,
                "reconstruction": losses.reconstruction(model.decode(model.one_hot(codes[rows])), self.views[rows]),
                "inverse": F.cross_entropy(model.infer_action(before, after), action),
            }
            parts["loss"] = parts["code"] + parts["reconstruction"] + parts["inverse"]
            self._step(parts, totals, steps)
        known = known.to(self.device)
        codec = SymbolicCodec(self.model)
        with torch.no_grad():
            agree = float((model.codes(self.views[known]) == codes[known]).all(1).float().mean())
        exact = view_gates(codec, t.views[known.cpu().numpy()])["views_exact"]
        # What the codes themselves decide cannot change any more: every gate that this stage can meet is met.
        figures: dict[str, Any] = {**totals, "code_agreement": agree, "settled": agree == exact == 1.0}
        self._set_forward_model(t, book.structure)
        codec = SymbolicCodec(self.model)
        if self.stage == "complete":
            return {**figures, **evaluate(codec, self.reference, self.everything.views)}
        if self.held_out is not None:
            self.held_out_figures = self.held_out.gates(codec)
        return {**figures, **self.held_out_figures}

    # ---------------------------------------------------------------- shared
    def named_factors(self) -> dict[str, Any]:
        """The questions of the named factors and what every value answers; see `CodeSearch.meanings`."""
        return self.search.meanings() if self.search is not None else {}

    def _step(self, parts: dict[str, Tensor], totals: dict[str, float], steps: int) -> None:
        self.optimizer.zero_grad(set_to_none=True)
        parts["loss"].backward()
        self.optimizer.step()
        for name, value in parts.items():
            totals[name] = totals.get(name, 0.0) + float(value.detach()) / steps

    def _refiner(self, transitions: Transitions) -> Refiner:
        return Refiner(transitions, self.model.num_values, self.model.num_actions, self.bounds)

    def _set_forward_model(self, t: Transitions, structure: Structure | None = None) -> None:
        """Tables of `t` in the encoder's own codes; without a structure one is searched."""
        with torch.no_grad():
            codes = self.model.codes(self.views).cpu().numpy().astype(np.int64)
        if structure is None:
            structure = self._refiner(t).search(codes).structure
        self.model.set_transitions(structure, codes[t.source], t.action, codes[t.target], t.weight)

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
            "searches": self.searches,
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
        self.held_out_figures, self.searches = value["held_out"], value["searches"]
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
