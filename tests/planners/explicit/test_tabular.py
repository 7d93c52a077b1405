"""Explicit models as they are built, and certificates at discounts near 1, early and late."""

from __future__ import annotations

import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from domains.classic import tiger
from nesy.errors import UserError
from planners.explicit.point_based import solve
from planners.explicit.pomdp import TabularPOMDP
from planners.search.tree_search import TreeSearch


@pytest.mark.parametrize("discount", [0.0, 0.9, 0.999, 0.9999, 0.99999, 1 - 1e-9])
@pytest.mark.parametrize("reward", [1.0, -1.0, 1e9, -1e-9])
def test_one_state_is_worth_its_reward_for_ever(discount: float, reward: float) -> None:
    model = TabularPOMDP(["s"], ["a"], ["o"], [[[1.0]]], [[[1.0]]], [[reward]], discount, [1.0], [False])
    found, value = solve(model), reward / (1 - discount)
    assert found.lower <= value <= found.upper
    decimal = reward / float(Fraction(1) - Fraction(str(discount)))  # what 0.9999 means to the one who writes it
    assert found.lower <= decimal <= found.upper
    wide = 5e-9 if discount < 0.999999 else 1e-5
    assert max(abs(found.lower / value - 1), abs(found.upper / value - 1)) <= wide
    assert model.fully_observed[0, 0] == pytest.approx(value, rel=wide)


def _accepted(**changes: Any) -> TabularPOMDP:
    arrays: dict[str, Any] = {
        "states": ["wet", "dry"], "actions": ["go"], "observations": ["x", "y"], "transition": [[[0.5, 0.5], [0, 1]]],
        "observation": [[[0.3, 0.7], [1, 0]]], "reward": [[1, 2]], "discount": 0.9, "start": [0.5, 0.5],
        "terminal": [False, False],
    }  # fmt: skip
    return TabularPOMDP(**{**arrays, **changes})


def test_lists_make_a_model_and_its_arrays_are_its_own() -> None:
    assert _accepted().fully_observed.tolist() == [[pytest.approx(1 / 0.55 + 0.45 * 20 / 0.55), pytest.approx(20.0)]]
    assert repr(_accepted()) == "TabularPOMDP(2 states, 1 actions, 2 observations, discount 0.9)"
    arrays = tiger()
    model = TabularPOMDP(**arrays)
    arrays["reward"][:] = 0
    assert model.reward.any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": ["wet", "wet"]}, "states: the name 'wet' is given twice"),
        ({"actions": []}, "actions: a list of one or more names is needed"),
        ({"observations": "xy"}, "observations: a list of one or more names is needed, got 'xy'"),
        ({"observations": ["x", 3]}, "observations: names are strings, got 3"),
        ({"transition": 5}, "transition: one matrix of numbers"),
        ({"transition": [[0.5, 0.5]]}, "transition: one matrix of numbers"),
        ({"transition": [[[0.5, 0.50003], [0, 1]]]}, "transitions of action 'go' in state 'wet' sum to 1.00003, not 1"),
        ({"observation": [[[0.3, 0.7], [1, 1]]]}, "observations of action 'go' in state 'dry' sum to 2, not 1"),
        ({"transition": [[[1.5, -0.5], [0, 1]]]}, "a probability is negative"),
        ({"reward": [[1, 2], [3]]}, "reward: numbers are needed"),
        ({"reward": [[1, np.nan]]}, "a reward is not a number"),
        ({"reward": [[1e308, 1]]}, "too large"),
        ({"reward": [1, 2]}, r"reward: shape \(2,\), expected \(1, 2\)"),
        ({"discount": "high"}, "discount: numbers are needed"),
        ({"discount": [0.9]}, "discount must be in"),
        ({"start": [0.2, 0.2]}, "start probabilities sum to 0.4"),
        ({"terminal": [0, 2]}, "terminal: true or false per state"),
        ({"terminal": [False, True]}, "action 'go' leaves a terminal state or earns something there \\('dry'\\)"),
    ],
)
def test_tables_that_make_no_model_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        _accepted(**changes)


def test_rows_rounded_to_six_digits_are_scaled() -> None:
    third = 0.333333
    model = _accepted(observations=list("xyz"), observation=[[[third] * 3, [third] * 3]], start=[third, 0.666666])
    assert model.observation.sum(axis=2).tolist() == [[pytest.approx(1, abs=1e-15)] * 2]
    assert model.start.sum() == pytest.approx(1, abs=1e-15)
    found, exact = solve(model, gap=0.0, time_limit=5), model.start @ [(1 + 0.45 * 20) / 0.55, 20]
    assert found.lower <= exact <= found.upper
    assert model.step(0, 0, np.random.default_rng(0))[1] in (0, 1, 2)
    many = np.round(np.full((1, 2, 870), 1 / 870), 6)  # off by 3e-4, as far as six digits can be
    assert _accepted(observations=[f"o{i}" for i in range(870)], observation=many).observation[
        0, 0, 0
    ] == pytest.approx(1 / 870)


def _wide_model(num_states: int, num_actions: int, num_observations: int, likely: int) -> TabularPOMDP:
    rng = np.random.default_rng(0)
    seen = np.zeros((num_actions, num_states, num_observations))
    for _ in range(likely):
        at = rng.integers(num_observations, size=(num_actions, num_states))
        np.add.at(seen, (np.arange(num_actions)[:, None], np.arange(num_states), at), 1 / likely)
    moves = [np.eye(num_states)[rng.permutation(num_states)] * 0.9 + 0.1 / num_states for _ in range(num_actions)]
    return TabularPOMDP(
        states=[f"s{i}" for i in range(num_states)],
        actions=[f"a{i}" for i in range(num_actions)],
        observations=[f"o{i}" for i in range(num_observations)],
        transition=moves,
        observation=seen,
        reward=rng.normal(0, 1, (num_actions, num_states)),
        discount=0.95,
        start=np.full(num_states, 1 / num_states),
        terminal=np.zeros(num_states, np.bool_),
    )


@pytest.mark.parametrize("limit", [0.0, 0.5])
def test_the_time_limit_covers_the_beginning_and_is_told_truly(limit: float) -> None:
    model = _wide_model(150, 6, 60, 3)
    began = time.perf_counter()
    found = solve(model, time_limit=limit)
    took = time.perf_counter() - began
    assert found.seconds == pytest.approx(took, abs=0.2)
    assert took < limit + 1.5
    assert found.lower <= found.upper
    assert found.upper >= solve(model, max_trials=0).lower


def test_a_tree_takes_the_room_that_its_nodes_take(monkeypatch: pytest.MonkeyPatch) -> None:
    model = _wide_model(30, 4, 3000, 1)
    search = TreeSearch(model, np.random.default_rng(0), trials=1)
    assert sum(array.nbytes for array in search._beliefs) < 100_000
    action, info = search.plan(model.start)
    assert sum(array.nbytes for array in search._beliefs) < 1000 * (info["nodes"] + 256)
    monkeypatch.setattr("planners.search.tree_search._FEW", 100_000)
    roomy = TreeSearch(model, np.random.default_rng(0), trials=1)
    assert roomy.plan(model.start) == (action, info)
    monkeypatch.setattr("planners.search.tree_search._FEW", 256)
    monkeypatch.setattr("planners.search.tree_search._MOST_NODES", 512)
    small = TreeSearch(model, np.random.default_rng(0), trials=1)
    _, less = small.plan(model.start)
    assert less["nodes"] <= 512
    assert less["lower"] <= info["lower"] <= info["upper"] <= less["upper"]


def test_a_folder_of_files_is_certified_by_a_command(tmp_path: Path) -> None:
    TabularPOMDP(**tiger()).to_file(tmp_path / "tiger.pomdp")
    (tmp_path / "bad.pomdp").write_text("states: 2\n")
    script = Path(__file__).parents[3] / "scripts" / "certify_planners.py"
    for bracket, verdict, status in (("19.3,19.4", "closed", 0), ("19.4,19.5", "EXCLUDES THE OTHER BRACKET", 1)):
        (tmp_path / "other.csv").write_text(f"tiger.pomdp,{bracket}\n")
        command = [sys.executable, script, "--files", tmp_path, "--brackets", tmp_path / "other.csv"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == status, done.stderr
        assert "| tiger.pomdp | 2, 3, 2 | 0.95 | 19.37" in done.stdout
        assert f"| {verdict} |" in done.stdout
        assert "| refused: " in done.stdout


def test_discounts_near_one_are_certified_by_a_command() -> None:
    script = Path(__file__).parents[3] / "scripts" / "certify_planners.py"
    command = [sys.executable, script, "--discounts", "0.9", "0.99999"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    widths = [float(line.split("|")[5]) for line in done.stdout.splitlines()[2:]]
    assert len(widths) == 4
    assert max(widths) <= 1e-6
