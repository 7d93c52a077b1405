"""The scores of a run's semantic rules, as they stand in summary.json under `semantics`."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from nesy.asp.semantics.predicates import predicate_rules
from nesy.asp.semantics.scores import maps_of, scores
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.run_folder import RunFolder


def semantics_report(run: RunFolder, domain_name: str, variant: str, seed: int) -> dict[str, Any]:
    """Scores of the rules in both directions (nesy.asp.semantics.scores), on views and on maps not learned from.

    Besides, `recovered`: predicates with a name of their own, read by rules off the codes of ALL views of the
    crossing task, if there is one (`views` many), with the share of the views where that is right (`accuracy`). Left
    out where the domain cannot list its views.
    """
    from nesy.log.experience import load_columns

    dbn, book = TwoSliceDBN.load(run.dbn), Codebook.load(run.dbn)
    columns = load_columns(run.experience, ("view", "map_id"))
    size = book.views.shape[1]
    met = maps_of(book, columns["view"].reshape(-1, size, size), columns["map_id"])
    result = scores(book, dbn.num_values, dbn.factor_names, met, seed)
    recovered = _recovered(run, book, domain_name, variant, dbn.num_values)
    return result if recovered is None else {**result, "recovered": recovered}


def _recovered(
    run: RunFolder, book: Codebook, domain_name: str, variant: str, num_values: int
) -> dict[str, Any] | None:
    from domains.core import MOST_MAPS, DomainError, load_domain
    from nesy.world_model import SymbolicCodec, load_world_model

    domain = load_domain(domain_name)
    try:
        if len(domain.maps(variant)[0]) > MOST_MAPS:
            return None
        views = domain.views(variant, domain.spec.model_task)
    except DomainError:
        return None
    codes = SymbolicCodec(load_world_model(run.world_model)).codes(views).astype(np.int64)
    truth = domain.predicates.evaluate(views)
    accuracy = {}
    for p, name in enumerate(domain.predicates.names):
        varies = truth[:, p].any() and not truth[:, p].all()
        if varies and not re.search(r"_\d+_\d+$", name) and name in book.predicate_names:
            said = predicate_rules(book, name, 0.0, num_values=num_values).applies(codes)
            accuracy[name] = float((said == truth[:, p]).mean())
    return {"views": len(views), "accuracy": accuracy}
