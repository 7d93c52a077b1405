"""Which parts of the training help? Leaves them out one at a time, with fewer rounds, and prints a Markdown table.

`codes` is the search of the code book, which every world of few views gets; `network` is learning by gradients
alone, which takes its place where views are many. Nothing is learned from held-out maps in either.

    python scripts/ablations.py --run runs/demo
    python scripts/ablations.py --run runs/demo --table network
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

from domains.core import Domain, load_domain, symmetries_of
from nesy.cli import configuration
from nesy.config import TrainConfig
from nesy.run_folder import RunFolder
from nesy.world_model import Transitions, reference_transitions
from nesy.world_model.codes.autoencoding import Ingredients
from nesy.world_model.codes.code_search import CodeSearch, SearchSettings
from nesy.world_model.codes.questions import Questions
from nesy.world_model.codes.readability import readability
from nesy.world_model.codes.refinement import Refiner
from nesy.world_model.columns import Columns
from nesy.world_model.distinct import view_keys
from nesy.world_model.images import with_images
from nesy.world_model.structure import Limits
from nesy.world_model.training.gates import book_nll
from nesy.world_model.training.held_out import HeldOut
from nesy.world_model.training.symbolic_training import MOST_PARENTS, SymbolicTrainer

CODES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "everything": ({}, {}),
    "no annealing of the entries": ({"noise": 0.0}, {}),
    "completing factors need not tell": ({"meaning": 0.0}, {}),
    "no bonus for told predicates": ({"told": 0.0}, {}),
    "questions stay as they are in the second step": ({"adjusting": 0}, {}),
    "no named factors": ({}, {"named_factors": 0}),
    "no mirror images": ({}, {"mirror_images": False}),
    "collisions are free at first": ({"collision": 0.0}, {}),
}
"""What is changed: of the search's settings, and of the training's (scripts/parents_table.py varies the parents)."""
NETWORK: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "everything": ({}, {}),
    "no Gumbel noise": ({"gumbel": False}, {}),
    "relaxed samples": ({"straight_through": False}, {}),
    "no annealing of the temperature": ({"annealing": False}, {}),
    "no bonus for the use of values": ({"usage": 0.0}, {}),
    "no forward loss": ({"forward": 0.0}, {}),
    "no inverse loss": ({"inverse": 0.0}, {}),
    "no weights of cell kinds": ({"class_weights": False}, {}),
    "no KL": ({}, {"kl_weight": 0.0}),
    "no mirror images": ({}, {"mirror_images": False}),
}
"""What is changed: of the loss, and of the training."""


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/default")
    """A run with experience."""
    table: Literal["codes", "network"] = "codes"
    """What is left out parts of."""
    epochs: int = 24
    """Epochs of every training; of a search, a sixth of them are rounds of questions, half of them of codes."""
    seed: int = 0
    """Seed of every training."""


class Data:
    """What a run has met, with or without mirror images."""

    def __init__(self, run: RunFolder, domain: Domain, variant: str, share: float, seed: int) -> None:
        self.columns = Columns.mapped(run.experience, run.path, len(domain.spec.action_names))
        self.apart = self.columns.held_out(share, np.random.default_rng(seed))
        self.seed = seed
        found = {task: reference_transitions(domain, variant, task) for task in ("crossing", "following")}
        known = [transitions.views for transitions in found.values() if transitions is not None]
        # Views are always indexed with their mirror images, so that rows can be compared.
        self.symmetries, self.weighting = symmetries_of(domain), domain.spec.weighting
        met = self.columns.transitions(views=np.concatenate(known) if known else None, weighting=self.weighting)
        self.everything = with_images(met, self.symmetries)
        crossing = found["crossing"]
        self.reference = self.everything if crossing is None else crossing
        self.place = np.searchsorted(view_keys(self.everything.views), view_keys(self.reference.views))

    def learned(self, mirror: bool) -> tuple[Transitions, Transitions]:
        """All transitions, and those of maps that are not held out; both index the same views."""
        views = self.everything.views
        plain = (
            self.columns.transitions(None, views, self.weighting),
            self.columns.transitions(~self.apart, views, self.weighting),
        )
        if not mirror:
            return plain
        return with_images(plain[0], self.symmetries, views), with_images(plain[1], self.symmetries, views)


def codes_row(data: Data, domain: Domain, config: TrainConfig, settings: SearchSettings) -> list[str]:
    """Figures of a code book."""
    everything, training = data.learned(config.mirror_images is not False)
    truth = domain.predicates.evaluate(everything.views)
    questions = Questions.of(domain.predicates.names, truth, config.headline)
    arcs = 2 if config.intra_slice_arcs else 0
    bounds = Limits(now=config.max_parents, next=arcs, total=min(config.max_parents + arcs, MOST_PARENTS), penalty=1.0)
    search = CodeSearch(Refiner(training, 8, 4, bounds), questions, 8, config.named_factors, config.headline, settings)
    rng = np.random.default_rng(data.seed)
    search.start(rng)
    book = search.search(max(3, round(config.epochs / 6)), max(4, round(config.epochs / 2)), rng)
    read = readability(book.codes, truth, domain.predicates.names)
    return [
        f"{book_nll(book, everything, data.reference, data.place, 8):.3f}",
        f"{HeldOut(data.columns, data.apart, training, data.seed, data.weighting).nll(book, 8):.3f}",
        f"{len(np.unique(book.codes, axis=0))}",
        f"{read['mean_factors']:.2f}",
        f"{100 * read['single']:.0f} %",
        f"{read['mean_information']:.3f}",
    ]


def network_row(data: Data, config: TrainConfig, ingredients: Ingredients) -> list[str]:
    """Figures of networks trained by gradients alone."""
    everything, training = data.learned(config.mirror_images is not False)
    held_out = HeldOut(data.columns, data.apart, training, data.seed, data.weighting)
    trainer = SymbolicTrainer(
        config, data.seed, everything, training, held_out, None, None, ingredients, refine_up_to=0
    )
    figures: dict[str, Any] = {}
    while not trainer.finished:
        figures = trainer.tick(0.0)
    guided, counted = figures["next_code_nll"], trainer.held_out_figures["next_code_nll"]
    return [
        f"{100 * figures['views_exact']:.1f} %",
        f"{100 * figures['cells']:.2f} %",
        f"{figures['distinct_codes']} of {figures['distinct_views']}",
        f"{100 * figures['new_views_exact']:.1f} %" if figures["new_views"] else "none",
        f"{guided:.2f}",
        f"{counted:.2f}",
        f"{100 * figures['next_view_exact']:.1f} %",
        f"{100 * figures['inverse_accuracy']:.1f} %",
    ]


HEADS = {
    "codes": ("NLL on all maps", "on held-out maps", "distinct codes", "factors per predicate", "one factor",
              "mutual information"),
    "network": ("views exact", "cells", "distinct codes", "new views exact", "NLL of the guide", "NLL of tables",
                "next view exact", "action"),
}  # fmt: skip


def main(arguments: Arguments) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    run = RunFolder.open(arguments.run)
    run.require("collect")
    config = configuration.load(run.config)
    domain = load_domain(config.domain)
    data = Data(run, domain, config.variant, config.train.held_out, arguments.seed)
    base = replace(config.train, architecture="symbolic", epochs=arguments.epochs, time_limit=0.0)
    head = ("left out", *HEADS[arguments.table], "seconds of processor time")
    print(f"| {' | '.join(head)} |\n{'| --- ' * len(head)}|")
    for name, (part, training) in (CODES if arguments.table == "codes" else NETWORK).items():
        began = time.process_time()
        changed = replace(base, **training)
        if arguments.table == "codes":
            figures = codes_row(data, domain, changed, SearchSettings(**part))
        else:
            figures = network_row(data, changed, Ingredients(**part))
        print(f"| {' | '.join([name, *figures, f'{time.process_time() - began:.0f}'])} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
