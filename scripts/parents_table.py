"""Next-code NLL against the largest number of parents, with and without arcs inside slice t+1; or against readability.

For every row a code book is searched anew, named factors and completing ones, so that each row has codes that
suit it, and the tables are counted and smoothed as in training. Prints a Markdown table.

    python scripts/parents_table.py --run runs/demo
    python scripts/parents_table.py --run runs/demo --table named
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from domains.core import load_domain, symmetries_of
from nesy.cli import configuration
from nesy.log.experience import Experience
from nesy.run_folder import RunFolder
from nesy.world_model import Transitions, reference_transitions
from nesy.world_model.codes.code_search import CodeSearch
from nesy.world_model.codes.questions import Questions
from nesy.world_model.codes.readability import readability
from nesy.world_model.codes.refinement import CodeBook, Refiner
from nesy.world_model.distinct import transitions_of, view_keys
from nesy.world_model.images import with_images
from nesy.world_model.structure import Limits
from nesy.world_model.tables import all_tables, log_probability
from nesy.world_model.training.gates import limits
from nesy.world_model.training.symbolic_training import MOST_PARENTS


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/default")
    """A run with experience."""
    table: Literal["parents", "named"] = "parents"
    """What changes from row to row: the largest number of parents, or the number of named factors."""
    epochs: int = 60
    """As in training: a sixth of them are rounds of questions, half of them rounds of the codes."""
    named_factors: int = 6
    """As in training."""
    seed: int = 0
    """Seed of the search."""


def nll_on(book: CodeBook, transitions: Transitions, reference: Transitions) -> float:
    """NLL in nats of `reference` under tables counted from `transitions`."""
    codes, t = book.codes, transitions
    tables = all_tables(book.structure, codes[t.source], t.action, codes[t.target], t.weight, 8)
    c = codes[np.searchsorted(view_keys(t.views), view_keys(reference.views))]
    logs = log_probability(book.structure, tables, c[reference.source], reference.action, c[reference.target], 8)
    return float(-(reference.weight * logs).sum() / reference.weight.sum())


def main(arguments: Arguments) -> None:
    """Print the table."""
    run = RunFolder.open(arguments.run)
    run.require("collect")
    config = configuration.load(run.config)
    domain = load_domain(config.domain)
    reference = reference_transitions(domain, config.variant, "crossing")
    following = reference_transitions(domain, config.variant, "following")
    views = following.views if following is not None else None
    met = transitions_of(Experience.load(run.experience), views=views, weighting=domain.spec.weighting)
    transitions = with_images(met, symmetries_of(domain))
    reference = transitions if reference is None else reference
    truth = domain.predicates.evaluate(transitions.views)
    questions = Questions.of(domain.predicates.names, truth, config.train.headline)
    print(f"limit of the data: {limits(reference)['next_code_nll']:.3f} nats (all maps, poses and actions)\n")
    cases = [(now, arcs, arguments.named_factors) for now in (1, 2, 3, 4) for arcs in (0, 2)]
    if arguments.table == "named":
        cases = [(4, 2, named) for named in range(8)]
    print(
        "| parents from slice t | arcs inside t+1 | named factors | NLL, nats | counted NLL on the experience | rows "
        "| factors per predicate | one factor | at most two | mutual information | seconds |"
    )
    print("| --- " * 11 + "|")
    for now, arcs, named in cases:
        rng = np.random.default_rng(arguments.seed)
        began = time.perf_counter()
        bounds = Limits(now=now, next=arcs, total=min(now + arcs, MOST_PARENTS), penalty=1.0)
        search = CodeSearch(Refiner(transitions, 8, 4, bounds), questions, 8, named, config.train.headline)
        search.start(rng)
        book = search.search(max(3, round(arguments.epochs / 6)), max(4, round(arguments.epochs / 2)), rng)
        count, _, _ = book.structure.arrays()
        seconds = time.perf_counter() - began
        read = readability(book.codes, truth, domain.predicates.names)
        print(
            f"| {now} | {'at most 2' if arcs else 'none'} | {named} | {nll_on(book, transitions, reference):.3f} "
            f"| {book.nll:.3f} | {int((8**count).sum()):,} | {read['mean_factors']:.2f} | {100 * read['single']:.0f} % "
            f"| {100 * read['pairs']:.0f} % | {read['mean_information']:.3f} | {seconds:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
