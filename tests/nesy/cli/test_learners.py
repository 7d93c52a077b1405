"""`nesy compare --learner`: the settings of the paper and of the published code by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from nesy.cli.commands import compare
from nesy.cli.main import main, parse
from planners.config import DQNConfig


def _parsed(*arguments: str) -> DQNConfig:
    options = parse(compare, "nesy compare", list(arguments))
    assert isinstance(options, compare.Arguments)
    return options.settings.dqn


def test_a_learner_is_where_the_other_options_start_from(run_copy: Path) -> None:
    run = ("--run", str(run_copy))
    own = _parsed(*run)
    assert own == DQNConfig.fast(64)
    assert _parsed(*run, "--learner", "paper") == DQNConfig.paper(64)
    changed = _parsed(*run, "--learner=published", "--dqn.episodes", "7", "--dqn.fallback", "uniform")
    assert changed.episodes == 7
    assert changed.fallback == "uniform"
    assert changed.published_terminals and changed.published_sampling
    assert changed.num_envs == 1


def test_the_published_learner_runs(run_copy: Path) -> None:
    arguments = ("--learner", "published", "--dqn.episodes", "3", "--agents", "dqn", "--episodes", "42", "--jobs", "1")
    assert main(["compare", "--run", str(run_copy), *arguments, "--influences", "perfect-information"]) == 0
    (policy,) = run_copy.glob("policies/dqn-*perfect-information*.safetensors")
    from planners.dqn.dqn import DQNPolicy

    stored = DQNPolicy.load(policy)
    assert stored.config == DQNConfig.published(3).at(0.9)  # the discount of `paper`
    assert _parsed("--run", str(run_copy)) == DQNConfig.published(3)  # the run remembers


def test_an_unknown_learner_is_a_mistake(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "--learner", "slow"]) == 2
    assert "slow" in capsys.readouterr().err
