from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest

from domains.core import load_domain
from domains.person_following.metrics import BELIEF_METRICS, METRICS
from nesy.errors import UserError
from nesy.run_folder import RunFolder, read_json
from planners.baselines import LastSeenFollower, OracleFollower
from planners.comparison.compare import compare
from planners.comparison.evaluation import Player, evaluate, evaluation_maps
from planners.comparison.grid import EVALUATION_SEED, grid
from planners.comparison.replay.why import find_cell
from planners.comparison.results import _interval
from planners.config import CompareConfig, DQNConfig, SearchConfig

DOCUMENTED = Path(__file__).parents[3] / "docs" / "metrics.md"
REFERENCES = CompareConfig(agents=("greedy-follower", "random", "greedy-last-seen"), episodes=42)


@pytest.fixture(autouse=True)
def _no_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """The exact optimum takes seconds and has tests of its own."""
    monkeypatch.setattr(
        "planners.comparison.compare.map_optimum", lambda *_: {"mean_return": 90.0, "success": 0.8, "maps": []}
    )


def _rows(run: RunFolder) -> dict[str, list[object]]:
    columns = pq.read_table(run.results / "episodes.parquet").to_pydict()
    del columns["ms_per_decision"]
    return columns


def test_results_do_not_depend_on_the_number_of_processes(tmp_path: Path) -> None:
    one, two = RunFolder(tmp_path / "one"), RunFolder(tmp_path / "two")
    first = compare(one, REFERENCES, jobs=1)
    second = compare(two, REFERENCES, jobs=2)
    assert _rows(one) == _rows(two)
    assert [cell["return"] for cell in first] == [cell["return"] for cell in second]
    assert [cell["agent"] for cell in first] == list(REFERENCES.agents)
    assert first[0]["share_of_optimum"] == pytest.approx(first[0]["return"]["mean"] / 90.0)


def test_a_finished_cell_is_not_run_again_and_a_damaged_one_is(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    compare(run, REFERENCES)
    files = sorted((run.results / "cells").iterdir())
    before = _rows(run)
    files[0].write_bytes(files[0].read_bytes()[:100])
    untouched = files[1].stat().st_mtime_ns
    compare(run, REFERENCES)
    assert files[1].stat().st_mtime_ns == untouched
    assert files[0].stat().st_size > 100
    assert _rows(run) == before


def test_the_first_episodes_of_more_are_those_of_fewer() -> None:
    """Agents that play fewer episodes play the first ones of the others, also where maps differ in probability."""
    domain = load_domain()
    for variant in ("paper", "occluded"):
        few, many = (evaluation_maps(domain, variant, count) for count in (5, 60))
        assert few is not None and many is not None and np.array_equal(many[:5], few)
    few, many = (evaluate(domain, "intent", Player(OracleFollower()), count, EVALUATION_SEED) for count in (3, 50))
    assert np.array_equal(few["return"], many["return"][:3]) and np.array_equal(few["map_id"], many["map_id"][:3])


def test_maps_are_met_in_proportion_to_their_probability() -> None:
    weights = np.array([0.5, 0.05, 0.3, 0.15])
    domain = SimpleNamespace(maps=lambda variant: (np.arange(4), weights))
    for count in (20, 100, 997):
        met = np.bincount(evaluation_maps(domain, "any", count), minlength=4)  # type: ignore[arg-type]
        assert met == pytest.approx(count * weights, abs=2)


def test_one_discount_per_variant(tmp_path: Path) -> None:
    spec = load_domain().spec
    assert [spec.discount(variant) for variant in ("paper", "clean", "occluded", "intent", "false_belief")] == [
        *(0.9, 0.9, 0.99, 0.99, 0.99)
    ]
    told = CompareConfig(search=SearchConfig(discount=0.5)).at(spec.discount("intent"))
    assert (told.dqn.per_step, told.search.per_step) == (0.99, 0.5)  # a discount that is given holds
    env = load_domain()
    played = evaluate(env, "intent", Player(OracleFollower()), 1, EVALUATION_SEED)
    short = played["length"][0]
    assert played["discounted_return"][0] >= played["return"][0] * 0.99**short
    with pytest.raises(UserError, match=r"discount must be in \[0, 1\)"):
        SearchConfig(discount=1.0)


def test_followers_reach_the_known_figures() -> None:
    domain = load_domain()
    follower = evaluate(domain, "paper", Player(OracleFollower()), 42, EVALUATION_SEED)
    assert follower["return"].mean() == pytest.approx(90.3, abs=0.7)
    assert (follower["outcome"] == 1).mean() == pytest.approx(0.807, abs=0.01)
    last_seen = evaluate(domain, "paper", Player(LastSeenFollower(domain, "paper")), 42, EVALUATION_SEED)
    assert last_seen["return"].mean() > 88
    assert np.unique(follower["map_id"]).size == 42


def test_mistakes_are_named() -> None:
    for change, message in (
        ({"agents": ("dqm",)}, "unknown agent 'dqm'"),
        ({"inputs": ("all",)}, "unknown input set 'all'"),
        ({"influences": ("telepathy",)}, "unknown influence mode 'telepathy'"),
        ({"agents": ()}, "list of agents is empty"),
        ({"episodes": 0}, "episodes must be at least 1"),
    ):
        with pytest.raises(UserError, match=message):
            grid(CompareConfig(**change))


def test_grid_has_every_cell_once() -> None:
    config = CompareConfig(
        agents=("dqn", "search", "random"), inputs=("paper", "full"), influences=("zero", "random"), seeds=(0, 1)
    )
    cells = grid(config)
    assert len(cells) == len({cell.name for cell in cells}) == 2 * 2 * 2 + 2 * 2 + 2


def test_rules_hold_for_every_agent_and_policies_come_from_files(tiny_run: Path, tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    run.path.mkdir()
    run.world_model.symlink_to((tiny_run / "world_model").resolve())
    rules = tmp_path / "still.lp"
    rules.write_text("forbidden(forward). forbidden(left) :- now(wall_ahead).\n")
    policy = next((tiny_run / "policies").glob("*.safetensors"))
    config = CompareConfig(
        agents=("greedy-follower", "random"), episodes=42, rules=(str(rules),), policies=(str(policy),)
    )
    records = compare(run, config)
    rows = _rows(run)
    assert len(records) == 3
    assert records[2]["agent"] == f"file {policy.stem}"
    assert set(rows["path_length"]) == {0.0}
    before = rows["return"]
    rules.write_text("forbidden(stay).\n")
    compare(run, config)
    assert _rows(run)["return"] != before  # other rules, other results, under the same file name
    with pytest.raises(UserError, match=r"none\.lp: not readable"):
        compare(run, CompareConfig(agents=("random",), rules=(str(tmp_path / "none.lp"),)))


def test_every_metric_is_a_column_and_every_table_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = RunFolder(tmp_path)
    domain = load_domain()
    seen = evaluate(domain, "paper", Player(OracleFollower()), 42, EVALUATION_SEED)
    maps = [{"map_id": int(name), "return": 100.0, "success": 1.0} for name in seen["map_id"]]
    monkeypatch.setattr(
        "planners.comparison.compare.map_optimum", lambda *_: {"mean_return": 100.0, "success": 1.0, "maps": maps}
    )
    (record,) = compare(run, CompareConfig(agents=("greedy-follower",), episodes=84))
    columns = pq.read_table(run.results / "episodes.parquet").column_names
    assert set(METRICS) | set(BELIEF_METRICS) <= set(re.findall(r"^\| `(\w+)`", DOCUMENTED.read_text(), re.MULTILINE))
    measures = (run.results / "measures.md").read_text()
    for name in METRICS:
        assert name in record["metrics"]
        low, high = record["metric_intervals"][name]
        assert low - 1e-9 <= record["metrics"][name] <= high + 1e-9
        assert f" {name} |" in measures
    header = (run.results / "comparison.csv").read_text().splitlines()[0].split(",")
    assert {"metrics.spl", "metrics.spl.low", "metrics.spl.high"} < set(header)
    assert r"interquartile\_mean" in (run.results / "measures.tex").read_text()
    assert {"spl", "psc", "recovery_time", "person_delay", "experience_steps", "ms_per_decision"} <= set(columns)
    assert record["regret"]["mean"] == pytest.approx(100 - record["return"]["mean"])
    assert record["interquartile_mean"]["mean"] > record["return"]["mean"]  # a fifth of the maps is out of reach
    assert record["metrics"]["success"] == pytest.approx(record["success"]["mean"])
    (record,) = compare(run, CompareConfig(agents=("greedy-follower",), episodes=84))
    regret = pq.read_table(run.results / "regret.parquet").to_pydict()
    assert len(set(regret["map_id"])) == 42
    assert set(regret["episodes"]) == {2}
    for name in ("comparison.csv", "comparison.md", "comparison.tex", "regret.csv", "statistics.json"):
        assert (run.results / name).stat().st_size > 0
    assert r"100 \%" not in (run.results / "comparison.tex").read_text()
    assert r"\%" in (run.results / "comparison.tex").read_text()
    for name in ("returns", "profiles"):
        assert (run.results / "plots" / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
        assert "<svg" in (run.results / "plots" / f"{name}.svg").read_text()


def test_trainings_are_resampled_and_planners_seeds_are_not() -> None:
    """Seeds of a planner share their model: what differs is luck within the same maps."""
    rows = {"seed": np.repeat([0, 1, 2], 84), "experience_steps": np.full(252, 1000), "map_id": np.arange(252) % 42}
    values = np.repeat([0.0, 10.0, 20.0], 84)
    for agent, widest in (("dqn", 20.0), ("file mine", 20.0), ("search", 2.0), ("pomdp", 2.0)):
        found = _interval(values, rows | {"agent": np.full(252, agent)}, CompareConfig())
        assert found.high - found.low == pytest.approx(widest, abs=0.5)


def test_figures_of_several_variants_say_how_much_is_in_them(tmp_path: Path) -> None:
    compare(RunFolder(tmp_path), CompareConfig(agents=("greedy-follower", "random"), variants=("paper", "clean")))
    drawn = (tmp_path / "results" / "plots" / "improvement.svg").read_text()
    assert drawn.count("greedy-follower  (1 seed, 168 episodes)  1") == 2  # comments of matplotlib's SVG hold the text
    pairs = read_json(tmp_path / "results" / "statistics.json")["improvement"]
    assert [(pair["ours"], pair["theirs"]) for pair in pairs[:2]] == [
        ("greedy-follower / paper", "random / paper"),
        ("random / paper", "greedy-follower / paper"),
    ]
    assert pairs[0]["maps"] == 42
    assert pairs[0]["mean"] == pytest.approx(1 - pairs[1]["mean"])
    assert pairs[0]["mean"] > 0.9  # on the same map; regardless of maps a fifth of them would weigh it down


def test_agents_can_be_given_the_same_experience(tiny_run: Path, tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    run.path.mkdir()
    for name in ("world_model", "dbn", "experience", "config.json"):
        (run.path / name).symlink_to((tiny_run / name).resolve())
    practising = SearchConfig(simulations=4, particles=20, practice_episodes=100)
    learning = DQNConfig(hidden=(8,), warm_up=64, batch_size=8)
    config = CompareConfig(
        agents=("dqn", "search"), influences=("zero",), episodes=42, planner_episodes=1, learning_steps=256
    )
    config = replace(config, dqn=learning, search=practising)
    records = compare(run, config)
    assert [record["experience_steps"] for record in records] == [256, 256]
    practice = sorted((run.ialm / "practice").iterdir())
    collected = [path.stat().st_mtime_ns for path in practice]
    with pytest.raises(UserError, match=r"steps, fewer than the 1,000,000 to learn from; raise --search\.practice"):
        compare(run, replace(config, agents=("search",), learning_steps=1_000_000))
    assert [path.stat().st_mtime_ns for path in practice] == collected  # of the same episodes, more or fewer steps


def test_an_oracle_out_of_reach_is_left_out_with_its_reason(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    config = CompareConfig(agents=("greedy-follower", "optimum"), variants=("occluded",), episodes=2)
    (record,) = compare(run, config)
    assert record["agent"] == "greedy-follower"
    (reason,) = read_json(run.results / "statistics.json")["left_out"].items()
    assert reason[0] == "optimum / occluded"
    assert "too many for an exact optimum" in reason[1]


def test_with_every_map_once_what_is_uncertain_is_what_the_optimum_does_not_explain() -> None:
    best = np.repeat([0.0, 110.0], 21)
    rows = {"seed": np.zeros(42), "experience_steps": np.zeros(42), "map_id": np.arange(42)}
    rows["agent"] = np.full(42, "random")
    noise = np.random.default_rng(0).normal(size=42)
    against = noise + 50 - best / 2  # bad where the optimum is good: nothing of it is explained
    for values, doubt in ((best - 3, 0 * noise), (best - 3 + noise, noise), (noise, noise), (against, against)):
        found = _interval(values, rows, CompareConfig(), best=best)
        assert found.low <= values.mean() <= found.high
        assert found.high - found.low == pytest.approx(2 * 1.96 * doubt.std() / 42**0.5, rel=0.15, abs=1e-9)


def test_agents_of_earlier_comparisons_can_be_asked_too(tiny_run: Path) -> None:
    run, later = RunFolder(tiny_run), CompareConfig(agents=("random",))
    assert find_cell(run, later, "dqn").influence == "perspective-shift"
    assert find_cell(run, later, "pomdp-full-random").name == "pomdp-full-random-paper-seed0"
    with pytest.raises(UserError, match="no agent 'greedy' with values of its own; there are dqn-full-"):
        find_cell(run, later, "greedy")
    with pytest.raises(UserError, match="there are none"):
        find_cell(RunFolder(tiny_run / "nowhere"), later, "dqn")


def test_the_share_of_the_optimum_is_of_the_same_episodes_where_maps_say_too_little(tmp_path: Path) -> None:
    """In `intent` the goal of each episode is drawn: some draws are luckier than the mean over all worlds."""
    follower, optimum = compare(
        RunFolder(tmp_path), CompareConfig(agents=("greedy-follower", "optimum"), variants=("intent",), episodes=42)
    )
    rows = pq.read_table(tmp_path / "results" / "episodes.parquet").to_pydict()
    played = {
        agent: np.mean([total for name, total in zip(rows["agent"], rows["return"], strict=True) if name == agent])
        for agent in ("greedy-follower", "optimum")
    }
    assert played["optimum"] != pytest.approx(90.0)  # what the fixture has for the mean over all worlds
    assert follower["share_of_optimum"] == pytest.approx(played["greedy-follower"] / played["optimum"])
    assert follower["regret"]["mean"] == pytest.approx(played["optimum"] - played["greedy-follower"])
    assert optimum["share_of_optimum"] == 1.0
