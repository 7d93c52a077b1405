"""Building the agent of one cell of the comparison from a run folder; training it first, if it learns."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from domains.core import Domain
from nesy.progress import SILENT, Progress
from nesy.run_folder import RunFolder
from planners import config as settings
from planners.agents import Agent, DQNAgent, PlanningAgent
from planners.baselines import LastSeenFollower, OptimalAgent, OracleFollower, RandomAgent
from planners.config import CompareConfig
from planners.evaluation import Columns
from planners.perception import Perception

if TYPE_CHECKING:
    from planners.compare import Cell


def build_agent(
    cell: Cell,
    run: RunFolder,
    domain: Domain,
    config: CompareConfig,
    seed: int,
    progress: Progress,
    advance: Callable[[int], None],
) -> tuple[Agent, Perception | None, Columns | None]:
    """The cell's agent, its perception (if it needs one), and its training episodes (if it learns)."""
    own_seed = cell_seed(cell, seed)
    if cell.agent in settings.REFERENCE_AGENTS:
        return _reference(cell, domain, own_seed), None, None
    from nesy.world_model import SymbolicCodec, load_world_model

    codec = SymbolicCodec(load_world_model(run.world_model))
    perception = Perception(codec, cell.influence, np.random.default_rng([own_seed, 1]))
    if cell.agent in settings.PLANNING_AGENTS:
        from planners.ialm import IALM

        model = IALM.load(run.ialm)
        return PlanningAgent(cell.agent, model, config.search, domain.spec.geometry, own_seed), perception, None
    from planners.dqn import train

    # Learning starts from the same weights and explores alike under every influence mode: only b~ differs.
    learning_seed = int(np.random.SeedSequence([seed, cell.seed]).generate_state(1)[0])
    policy, training = train(
        domain, codec, cell.inputs, cell.influence, cell.variant, config.dqn, learning_seed, progress
    )
    policy.save(run.policies / f"{cell.name}.safetensors")
    return DQNAgent(policy), perception, training


def restored_agent(
    cell: Cell, run: RunFolder, domain: Domain, config: CompareConfig, seed: int
) -> tuple[Agent, Perception | None]:
    """The agent of a finished cell as it was when it was evaluated: a learner with its stored policy.

    Raises:
        UserError: the policy is missing or damaged.
    """
    if cell.agent not in settings.LEARNING_AGENTS:
        agent, perception, _ = build_agent(cell, run, domain, config, seed, SILENT, lambda count: None)
        return agent, perception
    from nesy.world_model import SymbolicCodec, load_world_model
    from planners.dqn import DQNPolicy

    codec = SymbolicCodec(load_world_model(run.world_model))
    perception = Perception(codec, cell.influence, np.random.default_rng([cell_seed(cell, seed), 1]))
    return DQNAgent(DQNPolicy.load(run.policies / f"{cell.name}.safetensors")), perception


def cell_seed(cell: Cell, seed: int) -> int:
    """Seed of everything random in a cell but learning, from that of the run."""
    return int(np.random.SeedSequence([seed, cell.seed, *cell.name.encode()]).generate_state(1)[0])


def _reference(cell: Cell, domain: Domain, seed: int) -> Agent:
    if cell.agent == "random":
        return RandomAgent(len(domain.spec.action_names), seed)
    if cell.agent == "greedy-follower":
        return OracleFollower()
    if cell.agent == "greedy-last-seen":
        return LastSeenFollower(domain.spec.geometry)
    return OptimalAgent(domain.optimum(cell.variant).policy)
