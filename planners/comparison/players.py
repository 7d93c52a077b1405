"""Building the player of one cell of the comparison from a run folder; training it first, if it learns."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from domains.core import Domain, DomainError
from nesy.progress import SILENT, Progress
from nesy.run_folder import RunFolder
from planners import config as settings
from planners.agents import Agent, DQNAgent
from planners.baselines import LastSeenFollower, OptimalAgent, OracleFollower, RandomAgent
from planners.comparison.evaluation import Columns, Player
from planners.comparison.grid import Cell
from planners.comparison.model_store import ModelStore
from planners.config import CompareConfig
from planners.perception import Codec, Perception
from planners.person_following.agent import PlanningAgent

if TYPE_CHECKING:
    from planners.person_following.ialm import IALM
    from planners.shielding import ActionMask


class Built(NamedTuple):
    """What a cell needs to be evaluated.

    Attributes:
        player: acts.
        training: the training episodes, if it learns.
        experience_steps: environment steps that it learned from, besides those of the world model.
    """

    player: Player
    training: Columns | None
    experience_steps: int


def build_player(
    cell: Cell,
    run: RunFolder,
    domain: Domain,
    config: CompareConfig,
    seed: int,
    progress: Progress = SILENT,
    checkpoint: Path | None = None,
) -> Built:
    """The cell's player; a learner is trained, from `checkpoint` on where that file is."""
    own_seed, store = cell_seed(cell, seed), ModelStore(run)
    config = config.at(domain.spec.discount(cell.variant))
    if cell.agent in settings.REFERENCE_AGENTS:
        agent = _reference(cell, domain, own_seed)
        if not config.rules:
            return Built(Player(agent), None, 0)
        codec: Codec = store.codec  # only to tell in which situation a rule applies
        return Built(Player(agent, None, action_mask(config, codec, domain), codec), None, 0)
    codec = store.codec
    mask = action_mask(config, codec, domain)
    if cell.agent in settings.PLANNING_AGENTS:
        perception = Perception(codec, cell.influence, np.random.default_rng([own_seed, 1]))
        planner = _planner(cell, store, domain, config, own_seed)
        return Built(
            Player(planner, perception, mask), None, store.practice_steps(cell.variant, config.search_of_cells)
        )
    if cell.policy:
        return _stored(cell, Path(cell.policy), codec, mask, own_seed)
    from planners.dqn.dqn import Training, train

    # Learning starts from the same weights and explores alike under every influence mode: only b~ differs.
    learning_seed = int(np.random.SeedSequence([seed, cell.seed]).generate_state(1)[0])
    dqn = config.dqn_of_cells
    learner = Training(domain, codec, cell.inputs, cell.influence, cell.variant, dqn, learning_seed, mask)
    policy, training = train(learner, progress, checkpoint)
    path = run.policies / f"{cell.name}.safetensors"
    policy.save(path)
    return _stored(cell, path, codec, mask, own_seed)._replace(training=training)


def restored_player(cell: Cell, run: RunFolder, domain: Domain, config: CompareConfig, seed: int) -> Player:
    """The player of a finished cell as it was when it was evaluated: a learner with its stored policy.

    Raises:
        UserError: the policy is missing or damaged.
    """
    if cell.agent in (*settings.REFERENCE_AGENTS, *settings.PLANNING_AGENTS):
        return build_player(cell, run, domain, config, seed).player
    codec = ModelStore(run).codec
    path = Path(cell.policy) if cell.policy else run.policies / f"{cell.name}.safetensors"
    return _stored(cell, path, codec, action_mask(config, codec, domain), cell_seed(cell, seed)).player


def agent_from_file(path: Path, run: RunFolder | None = None) -> tuple[DQNAgent, Perception]:
    """A trained policy ready to act, with its perception.

    Args:
        path: the policy; that of a run lies in its folder `policies`.
        run: holds the world model; by default the run that the policy lies in.

    Raises:
        UserError: no policy, or no world model.
    """
    from planners.dqn.dqn import DQNPolicy
    from planners.dqn.published import dqn_perception

    policy = DQNPolicy.load(path)
    codec = ModelStore(run or RunFolder(path.resolve().parent.parent)).codec
    influence = str(policy.trained.get("influence", "perspective-shift"))
    return DQNAgent(policy), dqn_perception(codec, influence, np.random.default_rng(0), policy.config)


def action_mask(config: CompareConfig, codec: Codec, domain: Domain) -> ActionMask | None:
    """The rules of the comparison as a mask over actions; None where there are none."""
    if not config.rules:
        return None
    from planners.shielding import ShieldMask

    return ShieldMask([Path(rule) for rule in config.rules], codec, domain)


def cell_seed(cell: Cell, seed: int) -> int:
    """Seed of everything random in a cell but learning, from that of the run."""
    return int(np.random.SeedSequence([seed, cell.seed, *cell.name.encode()]).generate_state(1)[0])


def _stored(cell: Cell, path: Path, codec: Codec, mask: ActionMask | None, own_seed: int) -> Built:
    """A trained policy from its file, perceiving as it did when it was trained."""
    from planners.dqn.dqn import DQNPolicy
    from planners.dqn.published import dqn_perception

    policy = DQNPolicy.load(path)
    perception = dqn_perception(codec, cell.influence, np.random.default_rng([own_seed, 1]), policy.config)
    return Built(Player(DQNAgent(policy), perception, mask), None, int(policy.trained.get("steps", 0)))


def _planner(cell: Cell, store: ModelStore, domain: Domain, config: CompareConfig, seed: int) -> Agent:
    codec, search, geometry = store.codec, config.search_of_cells, domain.spec.geometry
    model = plain = store.local_model(cell.variant)
    if config.rules:
        from planners.person_following.influence_rules import constrain_influence

        model, _ = constrain_influence(model, [Path(rule) for rule in config.rules], codec, domain)
    if cell.agent != "structured":
        return PlanningAgent(cell.agent, model, search, geometry, seed, cell.influence)
    from planners.person_following.structured.drawn_maps.mapped_agent import MappedAgent
    from planners.person_following.structured.known_maps.mind_agent import MindAgent
    from planners.person_following.structured.known_maps.minds import MindModel

    structured = store.structured_model(cell.variant)
    possible = None if model is plain else _possible(model, plain)

    if isinstance(structured, MindModel):
        agent = MindAgent(structured, codec, cell.influence, search, geometry, seed)
        if possible is not None:
            agent.ways.constrain(possible(agent.ways.codes))
        return agent
    return MappedAgent(structured, codec, cell.influence, search, geometry, seed, possible)


def _possible(model: IALM, plain: IALM) -> Callable[[np.ndarray], np.ndarray]:
    """Which moves rules leave to persons with codes [n, N], from the model with them and without: bool [n, moves]."""
    return lambda codes: (model.influence_of(codes) > 0) | (plain.influence_of(codes) <= 0)


def _reference(cell: Cell, domain: Domain, seed: int) -> Agent:
    if cell.agent.startswith("greedy") and not domain.spec.has_person:
        raise DomainError(f"world '{domain.spec.name}' has no person to follow")
    simple: dict[str, Callable[[], Agent]] = {
        "random": lambda: RandomAgent(len(domain.spec.action_names), seed),
        "greedy-follower": OracleFollower,
        "greedy-last-seen": lambda: LastSeenFollower(domain, cell.variant),
    }
    if cell.agent in simple:
        return simple[cell.agent]()
    oracles = {
        "optimum": (domain.optimum, "the world, full state"),
        "bayes-optimum": (domain.bayes_optimum, "the world, exact belief"),
        "egocentric-optimum": (domain.egocentric_optimum, "the world, egocentric belief"),
    }
    solve, model = oracles[cell.agent]
    return OptimalAgent(solve(cell.variant).policy, model)
