"""Reported beliefs are those that the agents acted on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from domains.core import load_domain
from nesy.cli import configuration
from nesy.run_folder import RunFolder
from planners.agents import Situation, says_something
from planners.baselines import OracleFollower
from planners.comparison.evaluation import Player, evaluate
from planners.comparison.grid import EVALUATION_SEED, Cell
from planners.comparison.model_store import ModelStore
from planners.comparison.players import build_player, restored_player
from planners.comparison.replay.why import explain_choice

DOMAIN = load_domain()
SEARCH = Cell("search", "full", "zero", "paper", 0)


class Believer:
    """Follows by the full state, and says that it believes what it is made to."""

    algorithm, model = "told", "none"

    def __init__(self, believe: Any) -> None:
        self.follower, self.believe = OracleFollower(), believe
        self.believed: np.ndarray | None = None

    def actions(self, situation: Situation) -> np.ndarray:
        """The expert's actions."""
        self.believed = self.believe(situation)
        return self.follower.actions(situation)

    def person_belief(self) -> np.ndarray | None:
        """What it was made to believe."""
        return self.believed


def test_what_says_something() -> None:
    uniform = np.full((4, 2, 4), 0.25)
    uniform[1] = 0.0
    uniform[2] = np.nan  # an agent that did not act
    uniform[3, 1] = [0.3, 0.2, 0.25, 0.25]
    assert says_something(uniform).tolist() == [False, False, False, True]


def test_metrics_are_of_the_belief_that_the_agent_has(tiny_run: Path) -> None:
    codec: Any = ModelStore(RunFolder(tiny_run)).codec
    told = {
        "truth": lambda s: np.eye(codec.num_values)[codec.codes(s.env.person_views())],
        "nothing": lambda s: np.full((len(s.active), codec.num_factors, codec.num_values), 1 / codec.num_values),
        "none": lambda s: None,
    }
    found = {
        name: evaluate(DOMAIN, "paper", Player(Believer(believe), codec=codec), 4, EVALUATION_SEED)
        for name, believe in told.items()
    }
    assert found["truth"]["kl"] == pytest.approx(0.0) and (found["truth"]["factor_accuracy"] == 1.0).all()
    assert found["nothing"]["kl"] == pytest.approx(codec.num_factors * np.log(codec.num_values))
    for name in ("factor_accuracy", "exact_view"):  # no most likely code: not code (0, ..., 0)
        assert np.isnan(found["nothing"].get(name, np.array(np.nan))).all()
    assert np.isnan(found["none"].get("kl", np.array(np.nan))).all()


@pytest.mark.parametrize("kind", ["search", "pomdp"])
def test_a_planner_reports_the_particles_that_it_plans_in(tiny_run: Path, kind: str) -> None:
    run = RunFolder(tiny_run)
    config = configuration.load(run.config).compare
    player = build_player(replace(SEARCH, agent=kind), run, DOMAIN, config, 0).player
    assert player.agent.person_belief() is None
    env: Any = DOMAIN.make("following", 3, variant="paper", seed=1)
    observation, _ = env.reset(seed=1)
    _, percepts = player.decide(env, observation, np.array([True, False, True]), None)
    believed = player.agent.person_belief()
    assert believed is not None and percepts is not None
    assert np.isnan(believed[1]).all()
    agent: Any = player.agent
    for i in (0, 2):
        n = agent.local_model.num_factors
        codes = agent.beliefs[i].states[:, n : 2 * n]
        np.testing.assert_allclose(believed[i], (codes[..., None] == np.arange(agent.local_model.num_values)).mean(0))
    # under `zero` b~ says nothing, but particles are of codes that persons have
    assert not says_something(percepts.shifted).any() and says_something(believed)[[0, 2]].all()


def test_a_learner_reports_what_it_is_given(tiny_run: Path) -> None:
    run = RunFolder(tiny_run)
    config = configuration.load(run.config).compare
    cell = Cell("dqn", "full", "perspective-shift", "paper", 0)
    player = restored_player(cell, run, DOMAIN, config, 0)
    env: Any = DOMAIN.make("following", 8, variant="paper", seed=1)
    observation, _ = env.reset(seed=1)
    _, percepts = player.decide(env, observation, np.ones(8, np.bool_), None)
    assert percepts is not None
    np.testing.assert_array_equal(player.agent.person_belief(), percepts.shifted)


def test_explanations_say_what_the_agent_believed_or_that_it_does_not_know(tiny_run: Path) -> None:
    run = RunFolder(tiny_run)
    config = configuration.load(run.config).compare
    env: Any = DOMAIN.make("following", 1, variant="paper", seed=1)
    view = env.reset(seed=1)[0]["view"][0]
    for agent, configuration_seen, knows in (("search", 0, True), ("dqn", 0, False)):
        cell = Cell(agent, "full", "perspective-shift", "paper", 0)
        choice = explain_choice(run, DOMAIN, config, cell, view, configuration_seen, 0)
        assert (choice.shifted is not None) == knows
        assert ("does not know what the person sees" in choice.text) == (not knows)
        assert ("it expects of it" in choice.text) == (agent == "search")
        assert sum(choice.influence.values()) == pytest.approx(float(agent == "search"))
