"""Extraction of the 2DBN of a run, and of any network whose conditionals are tables already.

The `symbolic` architecture decides every next factor from few parents, so that each of its conditionals
can be enumerated over all parent values: the table is the network, nothing is fitted. Counts of the
transitions met in experience stand behind every row; a row with count 0 is the network's guess.
Other architectures are fitted (nesy.dbn.learning.fitting).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from nesy.checked_arrays import integers
from nesy.config import ExtractConfig
from nesy.dbn.checked_steps import Steps
from nesy.dbn.codebook import Codebook, distinct_views, named_meanings, value_meanings
from nesy.dbn.model import Parents, TwoSliceDBN
from nesy.dbn.rows import unique_rows
from nesy.errors import UserError
from nesy.run_folder import read_json

if TYPE_CHECKING:
    from nesy.run_folder import RunFolder

COLUMNS = ("view", "action", "next_view", "reward", "terminated", "t", "source_number")
"""Columns of experience that extraction reads."""
OWN_TASK = "crossing-"
"""How the names of sources of experience begin in which nobody else is about."""

Marginals = Callable[[np.ndarray, int], np.ndarray]
"""Codes uint8 [n, N] and an action -> marginals of the next factors, float64 [n, N, K]."""


class Structure(Protocol):
    """Who depends on whom, in the words of `TwoSliceDBN`."""

    @property
    def parents_now(self) -> Parents:
        """[a][i]: parents in slice t."""
        ...

    @property
    def parents_next(self) -> Parents:
        """[a][i]: parents in slice t+1."""
        ...

    @property
    def order(self) -> tuple[int, ...]:
        """The order in which the factors of slice t+1 are decided."""
        ...


@runtime_checkable
class Conditionals(Protocol):
    """A network that decides each next factor from few parents."""

    def structure(self) -> Structure:
        """Who depends on whom."""
        ...

    def conditional(self, action: int, factor: int) -> np.ndarray:
        """One conditional, float64 [rows, K]: parents of slice t first, first parent most significant."""
        ...


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


def with_counts(
    dbn: TwoSliceDBN,
    codes: np.ndarray,
    actions: np.ndarray,
    next_codes: np.ndarray,
    weights: np.ndarray | None = None,
) -> TwoSliceDBN:
    """The same model with the number of the given transitions behind every row.

    Also sets the tables `codes` [C, N] (of `code_type`), the distinct codes met, `taken` int64 [A], how often each
    action was taken, and `changed` int64 [A, N], in how many of its transitions each factor changed its value.

    Raises:
        UserError: the transitions are none of this model.
    """
    steps = Steps.of(codes, actions, next_codes, weights, num_values=dbn.num_values, action_names=dbn.action_names)
    if steps.codes.shape[1] != dbn.num_factors:
        raise UserError(f"a code of this model has {dbn.num_factors} factors, not {steps.codes.shape[1]}")
    counts = np.zeros(len(dbn.probabilities), dtype=np.int64)
    taken = np.zeros(dbn.num_actions, dtype=np.int64)
    changed = np.zeros((dbn.num_actions, dbn.num_factors), dtype=np.int64)
    for a in range(dbn.num_actions):
        before, after, often = steps.under(a)
        now, later = before.astype(np.int64), after.astype(np.int64)
        taken[a] = often.sum()
        changed[a] = often @ (now != later)
        for i in range(dbn.num_factors):
            start = dbn.offsets[a, i]
            rows = dbn.num_rows(a, i)
            # weights are far below 2^53, so the floats that bincount adds up are exact
            counts[start : start + rows] = np.bincount(dbn.rows(a, i, now, later), weights=often, minlength=rows)
    every = np.concatenate([steps.codes, steps.next_codes])
    met = every[unique_rows(every)[0]]
    tables = {**dbn.tables, "codes": met, "taken": taken, "changed": changed}
    return replace(dbn, row_counts=counts, tables=tables)


def marginals(codes: ArrayLike, num_values: int, num_factors: int) -> np.ndarray:
    """The marginal distribution of every factor over some codes [m, N]: float64 [N, K]."""
    known = integers(codes, "initial codes", (None, num_factors), num_values)
    if not len(known):
        raise UserError("no codes to take an initial distribution from")
    return np.stack([np.bincount(column, minlength=num_values) / len(known) for column in known.T])


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


class Transitions:
    """Experience in codes.

    Attributes: `codes`, `next_codes` uint8 [n, N]; `actions` int64 [n]; `views` uint8 [V, v, v] distinct
    views met, `view_codes` uint8 [V, N], `view_counts` int64 [V]; `view_index`, `next_view_index` int64 [n].
    """

    def __init__(self, views: np.ndarray, actions: np.ndarray, next_views: np.ndarray, encode_views: Any) -> None:
        both = np.concatenate([views, next_views])
        self.views, index, self.view_counts = distinct_views(both)
        self.view_codes = np.asarray(encode_views(self.views), dtype=np.uint8)
        self.view_index, self.next_view_index = index[: len(views)], index[len(views) :]
        self.codes = self.view_codes[self.view_index]
        self.next_codes = self.view_codes[self.next_view_index]
        self.actions = np.asarray(actions, dtype=np.int64)

    def distinct(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Distinct transitions: codes uint8 [D, N], actions int64 [D], next codes uint8 [D, N], counts int64 [D]."""
        codes, actions, next_codes, index = self.numbered()
        return codes, actions, next_codes, np.bincount(index)

    def numbered(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Distinct transitions as in `distinct`, and which of them every transition is, int64 [n]."""
        first, code_of_view, _ = unique_rows(self.view_codes)
        codes, number = self.view_codes[first], len(first)
        base = int(self.actions.max(initial=0)) + 1
        key = (code_of_view[self.view_index] * base + self.actions) * number + code_of_view[self.next_view_index]
        kinds, index = _numbered(key, number * base * number)
        before, after = kinds // number, kinds % number
        return codes[before // base], before % base, codes[after], index


def _numbered(keys: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Distinct keys in order, and the number of each; without sorting where their limit allows it."""
    if limit > 1 << 24:
        kinds, index = np.unique(keys, return_inverse=True)
        return kinds, index.reshape(-1)
    met = np.zeros(limit, dtype=bool)
    met[keys] = True
    kinds = np.flatnonzero(met)
    rank = np.zeros(limit, dtype=np.int64)
    rank[kinds] = np.arange(len(kinds))
    return kinds, rank[keys]


def encode(experience: Mapping[str, np.ndarray], codec: Any) -> Transitions:
    """Every transition of some columns of experience in the codes of `codec`."""
    return Transitions(experience["view"], experience["action"], experience["next_view"], codec.codes)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
