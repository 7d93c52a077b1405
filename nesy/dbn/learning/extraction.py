"""Extraction of the 2DBN of a run, and of any network whose conditionals are tables already.

The `symbolic` architecture decides every next factor from few parents, so that each of its conditionals
can be enumerated over all parent values: the table is the network, nothing is fitted. Counts of the
transitions met in experience stand behind every row; a row with count 0 is the network's guess.
Other architectures are fitted (nesy.dbn.learning.fitting).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.config import ExtractConfig
from nesy.dbn.codebook import Codebook, named_meanings, value_meanings
from nesy.dbn.learning.transitions import Conditionals, Marginals, Transitions, marginals, with_counts
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from nesy.run_folder import read_json

if TYPE_CHECKING:
    from nesy.run_folder import RunFolder

COLUMNS = ("view", "action", "next_view", "reward", "terminated", "t", "source_number")
"""Columns of experience that extraction reads."""
OWN_TASK = "crossing-"
"""How the names of sources of experience begin in which nobody else is about."""


def extract(
    model: Conditionals,
    codes: np.ndarray,
    actions: np.ndarray,
    next_codes: np.ndarray,
    *,
    action_names: Sequence[str] | None = None,
    factor_names: Sequence[str] | None = None,
    weights: np.ndarray | None = None,
    initial_codes: np.ndarray | None = None,
    meanings: Sequence[Sequence[str]] = (),
    provenance: dict[str, Any] | None = None,
) -> TwoSliceDBN:
    """Enumerate the conditionals of `model`, and count behind every row the transitions met.

    Args:
        model: the network.
        codes: uint8 [n, N], slice t of the transitions met in experience.
        actions: integers [n].
        next_codes: uint8 [n, N].
        action_names: A names.
        factor_names: N names; `X0`, `X1`, ... by default.
        weights: int64 [n], how often each transition was met; once each by default.
        initial_codes: uint8 [m, N], codes at the start of episodes; the initial distribution is theirs.
        meanings: [N][K] texts.
        provenance: where the model comes from, JSON values.

    Raises:
        UserError: the network's structure is none of a 2DBN.
    """
    structure = model.structure()
    cpts = [
        [np.asarray(model.conditional(a, i), dtype=np.float64) for i in range(len(per_action))]
        for a, per_action in enumerate(structure.parents_now)
    ]
    size = cpts[0][0].shape[-1]
    dbn = TwoSliceDBN.from_tables(
        cpts,
        structure.parents_now,
        structure.parents_next,
        order=structure.order,
        action_names=action_names,
        factor_names=factor_names,
        initial=None if initial_codes is None else marginals(initial_codes, size, len(cpts[0])),
        value_meanings=meanings,
        provenance=provenance,
    )
    return with_counts(dbn, codes, actions, next_codes, weights)


def extract_run(run: RunFolder, domain_name: str, config: ExtractConfig | None = None) -> dict[str, Any]:
    """Extract the 2DBN of a run: writes dbn/ (model and codebook) and returns its figures for summary.json.

    Args:
        run: the run.
        domain_name: where its experience is from.
        config: what the tables are of, and how parents are chosen.

    Raises:
        UserError: the run lacks its experience or its world model, or they are damaged.
    """
    from domains.core import load_domain
    from nesy.dbn.evaluation.measures import fidelity
    from nesy.dbn.learning.step_learning import with_observation, with_outcomes
    from nesy.log.experience import SOURCES, load_columns
    from nesy.world_model import SymbolicCodec, load_world_model

    config = config or ExtractConfig()
    domain = load_domain(domain_name)
    experience = load_columns(run.experience, COLUMNS)
    if not len(experience["action"]):
        raise UserError(f"{run.experience}: holds no transitions")
    model = load_world_model(run.world_model)
    codec = SymbolicCodec(model)
    transitions = encode(experience, codec)
    codebook = Codebook.build(transitions.views, transitions.view_codes, transitions.view_counts, domain.predicates)
    started = experience["t"] == 0
    described: dict[str, Any] = {
        "action_names": domain.spec.action_names,
        "initial_codes": transitions.codes[started] if started.any() else None,
        "meanings": _meanings(run, codebook, int(model.num_values)),
        "provenance": {
            "source": config.source,
            "domain": domain_name,
            "architecture": str(model.architecture),
            "seed": _seed(run),
            "world_model_sha256": _digest(run.world_model / "model.safetensors"),
            "transitions": len(experience["action"]),
        },
    }
    *distinct, kind = transitions.numbered()
    weights = np.bincount(kind)
    network = model if isinstance(model, Conditionals) else network_marginals(codec)
    if config.source == "network" and isinstance(model, Conditionals):
        dbn = extract(model, *distinct, weights=weights, **described)
    else:
        dbn = _fitted(network, distinct, weights, int(model.num_values), config, described)
    dbn = with_observation(dbn, codebook)
    # reward and end of the own task alone: those of a task with somebody else depend on more than the own code
    sources = [number for number, name in enumerate(SOURCES) if name.startswith(OWN_TASK)]
    own = np.isin(experience["source_number"], sources)
    if own.any():
        dbn = with_outcomes(dbn, distinct, kind[own], experience["reward"][own], experience["terminated"][own])
    codebook.save(run.dbn)
    # last: the step counts as done when model.json is there
    dbn.save(run.dbn)
    return fidelity(TwoSliceDBN.load(run.dbn), network if config.source == "network" else None, transitions)


def _fitted(
    network: Conditionals | Marginals,
    distinct: Sequence[np.ndarray],
    weights: np.ndarray,
    num_values: int,
    config: ExtractConfig,
    described: dict[str, Any],
) -> TwoSliceDBN:
    """Parents chosen by score; rows counted from experience, or the network's predictions marginalised over it."""
    from nesy.dbn.learning.fitting import from_callable, from_experience
    from nesy.dbn.learning.structure import Search

    if config.source == "network":
        assert not isinstance(network, Conditionals)
        search = Search(score=config.score, max_parents=config.max_parents)
        return from_callable(network, *distinct, weights=weights, num_values=num_values, search=search, **described)
    return from_experience(
        *distinct,
        weights=weights,
        num_values=num_values,
        num_actions=len(described["action_names"]),
        search=Search(score=config.score, max_parents=config.max_parents, max_next=1),
        prior_count=config.prior_count,
        **described,
    )


def _meanings(run: RunFolder, codebook: Codebook, num_values: int) -> tuple[tuple[str, ...], ...]:
    meanings, path = value_meanings(codebook, num_values), run.world_model / "readability.json"
    return named_meanings(meanings, read_json(path)) if path.is_file() else meanings


def _seed(run: RunFolder) -> int | None:
    if not run.config.is_file():
        return None
    return int(read_json(run.config).get("seed", 0))


def network_marginals(codec: Any) -> Marginals:
    """The next factors' marginals as the network of a codec predicts them from a certain code."""

    def predict(codes: np.ndarray, action: int) -> np.ndarray:
        beliefs = np.eye(codec.num_values, dtype=np.float32)[codes]
        return np.asarray(codec.predict(beliefs, np.full(len(codes), action)), dtype=np.float64)

    return predict


def encode(experience: Mapping[str, np.ndarray], codec: Any) -> Transitions:
    """Every transition of some columns of experience in the codes of `codec`."""
    return Transitions(experience["view"], experience["action"], experience["next_view"], codec.codes)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
