"""The fidelity report of an extracted model: how far it can be trusted, in figures and as one picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.dbn.codebook import Codebook
from nesy.dbn.evaluation.measures import FLOOR, nll, row_differences
from nesy.dbn.evaluation.recovery import recover
from nesy.dbn.evaluation.rollouts import rollout_drift
from nesy.dbn.evaluation.validity import (
    commonest_successors,
    impossible_steps,
    likeliest_successors,
    plan_validity,
)
from nesy.dbn.learning.extraction import network_marginals
from nesy.dbn.learning.transitions import Conditionals, Marginals, Transitions
from nesy.dbn.model import TwoSliceDBN

if TYPE_CHECKING:
    from domains.core import Domain
    from nesy.run_folder import RunFolder

HELD_OUT_SEED = 7_919
"""Added to the run's seed for episodes that neither training nor extraction has seen."""
SYNTHETIC = 2
"""Synthetic models whose parents are recovered; more in scripts/recovery.py."""


def fidelity_report(run: RunFolder, domain_name: str, variant: str, seed: int) -> dict[str, Any]:
    """The report on the 2DBN of a run, from its folder and new episodes of the domain.

    Returns:
        `held_out`: mean negative log-likelihood in nats of steps of new episodes under the `table`, the `network`
        and the empirical `limit` (which no model can pass on these steps), `impossible`, `row_tv` and `row_kl` there;
        `rollouts` (see rollouts); `plans` and `impossible` (see validity); `structure`:
        `precision` and `recall` of parents on synthetic models.

    Raises:
        UserError: a step of the run is missing or damaged.
    """
    from domains.core import load_domain
    from nesy.world_model import SymbolicCodec, load_world_model

    domain = load_domain(domain_name)
    dbn, codebook = TwoSliceDBN.load(run.dbn), Codebook.load(run.dbn)
    model = load_world_model(run.world_model)
    codec = SymbolicCodec(model)
    taken = new_steps(domain, variant, seed + HELD_OUT_SEED, codec)
    network = model if isinstance(model, Conditionals) else network_marginals(codec)
    known = np.unique(codebook.codes, axis=0)
    rng = np.random.default_rng(seed)
    synthetic = recover(range(seed, seed + SYNTHETIC))
    return {
        "held_out": held_out(dbn, network, taken),
        "rollouts": rollout_drift(dbn, known, rng),
        "plans": _plans(dbn, codebook, known, domain, variant, seed, codec, taken),
        "impossible": impossible_steps(dbn, domain, variant, codec.codes, seed),
        "structure": {
            "models": SYNTHETIC,
            "precision": synthetic.precision,
            "recall": synthetic.recall,
        },
    }


def new_steps(domain: Domain, variant: str, seed: int, codec: Any, envs: int = 128, steps: int = 200) -> Transitions:
    """Steps of new episodes: half of the environments act at random, half walk to the goal.

    Steps with another agent in the way are left out, as in training.
    """
    environment = domain.make(domain.spec.model_task, envs, variant=variant, seed=seed)
    from nesy.world_model.distinct import free_ahead

    rng = np.random.default_rng(seed)
    observation, _ = environment.reset(seed=seed)
    before, actions, after = [], [], []
    for _ in range(steps):
        action = rng.integers(len(domain.spec.action_names), size=envs)
        action[::2] = environment.expert_actions("goal")[::2]
        free = free_ahead(np.asarray(observation["configuration"]), domain.spec.geometry.view_size)
        before.append(observation["view"][free])
        actions.append(action[free])
        observation, _, _, _, infos = environment.step(action)
        after.append(infos["final_obs"]["view"][free])
    return Transitions(np.concatenate(before), np.concatenate(actions), np.concatenate(after), codec.codes)


def held_out(dbn: TwoSliceDBN, network: Conditionals | Marginals, taken: Transitions) -> dict[str, float]:
    """Likelihood of some steps under table and network, and how far the rows are from the frequencies in them."""
    distinct = taken.distinct()
    figures = nll(dbn, *distinct)
    return {
        "transitions": float(len(taken.actions)),
        "table": figures["nll"],
        "network": network_nll(network, *distinct),
        "limit": figures["nll_limit"],
        "impossible": figures["impossible"],
        **row_differences(dbn, *distinct),
    }


def network_nll(
    network: Conditionals | Marginals,
    codes: np.ndarray,
    actions: np.ndarray,
    next_codes: np.ndarray,
    counts: np.ndarray,
) -> float:
    """Mean negative log-likelihood of some steps under the network itself, in nats; the steps are distinct."""
    logs = np.zeros(len(codes))
    for a in np.unique(actions).tolist():
        chosen = actions == a
        now, later = codes[chosen].astype(np.int64), next_codes[chosen].astype(np.int64)
        for i, chances in enumerate(_chances(network, a, now, later)):
            logs[chosen] += np.log(np.maximum(chances[np.arange(len(now)), later[:, i]], FLOOR))
    # one impossible step must not hide the rest
    return float(-(counts * np.maximum(logs, np.log(FLOOR))).sum() / counts.sum())


def _chances(network: Conditionals | Marginals, action: int, now: np.ndarray, later: np.ndarray) -> list[np.ndarray]:
    """P(x'_i | ...) of every factor for some steps: N arrays [n, K]."""
    if not isinstance(network, Conditionals):
        marginals = network(now, action)
        return [marginals[:, i] for i in range(marginals.shape[1])]
    structure = network.structure()
    result = []
    for i, (before, inside) in enumerate(
        zip(structure.parents_now[action], structure.parents_next[action], strict=True)
    ):
        table = np.asarray(network.conditional(action, i), dtype=np.float64)
        shape = (table.shape[1],) * (len(before) + len(inside))
        index = tuple(now[:, p] for p in before) + tuple(later[:, p] for p in inside)
        result.append(table[np.ravel_multi_index(index, shape)] if index else table.repeat(len(now), axis=0))
    return result


def _plans(
    dbn: TwoSliceDBN,
    codebook: Codebook,
    known: np.ndarray,
    domain: Domain,
    variant: str,
    seed: int,
    codec: Any,
    taken: Transitions,
) -> dict[str, Any]:
    """Plan validity in the model, and with the commonest next views of experience in its place."""
    views = taken.views.reshape(len(taken.views), -1)
    frequent = commonest_successors(taken.view_index, taken.actions, taken.next_view_index, len(views), dbn.num_actions)
    planners = {
        "model": (likeliest_successors(dbn, known), lambda seen: _places(codec.codes(seen), known)),
        "commonest": (frequent, lambda seen: _places(seen.reshape(len(seen), -1), views)),
    }
    return plan_validity(domain, variant, seed + HELD_OUT_SEED + 1, planners)


def _places(rows: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The index of each row among distinct known ones: int64 [n]; -1 where it is none of them."""
    from nesy.dbn.rows import unique_rows

    _, index, _ = unique_rows(np.concatenate([known, rows]))
    place = np.full(int(index.max()) + 1, -1, dtype=np.int64)
    place[index[: len(known)]] = np.arange(len(known))
    return np.asarray(place[index[len(known) :]])
