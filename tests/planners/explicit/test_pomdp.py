from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from domains.classic import rocksample, tiger
from nesy.errors import UserError
from planners.explicit.point_based import solve
from planners.explicit.pomdp import CrossedBounds, TabularPOMDP
from planners.search.tree_search import Method, TreeSearch, closed_loop, exact_return

TIGER_FILE = """
# the tiger, in the compact form of the literature
discount: 0.95
values: reward
states: tiger-left tiger-right
actions: listen open-left open-right
observations: hear-left hear-right
start: uniform
T: listen
identity
T: open-left
uniform
T: open-right
uniform
O: listen
0.85 0.15
0.15 0.85
O: open-left
uniform
O: open-right
uniform
R: listen : * : * : * -1
R: open-left : tiger-left : * : * -100
R: open-left : tiger-right : * : * 10
R: open-right : tiger-left : * : * 10
R: open-right : tiger-right : * : * -100
"""


def _same(first: TabularPOMDP, second: TabularPOMDP) -> None:
    for ours, theirs in zip(first.transition, second.transition, strict=True):
        assert np.allclose(ours.toarray(), theirs.toarray())
    assert np.allclose(first.observation, second.observation)
    assert np.allclose(first.reward, second.reward)
    assert np.allclose(first.start, second.start)
    assert np.array_equal(first.terminal, second.terminal)
    assert first.discount == second.discount


def _random(seed: int) -> TabularPOMDP:
    rng = np.random.default_rng(seed)
    num_states, num_actions, num_observations = rng.integers(1, 5), rng.integers(1, 4), rng.integers(1, 4)
    return TabularPOMDP(
        states=[f"s{i}" for i in range(num_states)],
        actions=[f"a{i}" for i in range(num_actions)],
        observations=[f"o{i}" for i in range(num_observations)],
        transition=[rng.dirichlet(np.ones(num_states), num_states) for _ in range(num_actions)],
        observation=rng.dirichlet(np.ones(num_observations), (num_actions, num_states)),
        reward=rng.normal(0, 5, (num_actions, num_states)),
        discount=0.6,
        start=rng.dirichlet(np.ones(num_states)),
        terminal=np.zeros(num_states, np.bool_),
    )


def test_tiger_is_certified() -> None:
    certificate = solve(TabularPOMDP(**tiger()), gap=1e-3, time_limit=60)
    assert certificate.lower == pytest.approx(19.371, abs=2e-3)
    assert certificate.lower <= 19.371368361 <= certificate.upper
    assert certificate.upper - certificate.lower <= 1e-3
    assert certificate.action(np.array([0.5, 0.5])) == 0
    assert certificate.action(np.array([0.99, 0.01])) == 2


def test_rocksample_is_that_of_the_literature() -> None:
    arrays = rocksample(4, 4)
    model = TabularPOMDP(**arrays)
    assert (len(model.states), len(model.actions), len(model.observations)) == (257, 9, 2)
    assert model.states[int(model.start.argmax())].startswith("s02")
    assert model.terminal.sum() == 1
    north, east, sample = (model.actions.index(name) for name in ("amn", "ame", "as"))
    rock, edge = model.states.index("s131111"), model.states.index("s301111")
    assert model.reward[sample, rock] == 10
    assert model.reward[sample, model.states.index("s131101")] == -10
    assert model.transition[sample][rock, model.states.index("s131101")] == 1
    assert model.reward[east, edge] == 10
    assert model.reward[north, rock] == model.reward[sample, edge] == -100
    check = model.observation[model.actions.index("ac2")]
    assert check[rock].tolist() == [1, 0]
    assert check[model.states.index("s121111"), 0] == pytest.approx((1 + np.exp(-1)) / 2)
    with pytest.raises(ValueError, match="layouts are known"):
        rocksample(3, 2)


@pytest.mark.parametrize(
    ("size", "rocks", "gap", "value"),
    # The bounds at the published instances; sources in domains/classic/rocksample.py.
    [(4, 4, 0.1, 17.925), (5, 5, 2.6, 19.237)],
)
def test_rocksample_is_bracketed(size: int, rocks: int, gap: float, value: float) -> None:
    certificate = solve(TabularPOMDP(**rocksample(size, rocks)), gap=gap, time_limit=60)
    assert certificate.lower - 1e-3 <= value <= certificate.upper + 1e-3
    assert certificate.lower >= 0.95 * value
    assert certificate.upper - certificate.lower <= gap


def test_compact_file_is_the_built_in_tiger(tmp_path: Path) -> None:
    path = tmp_path / "tiger.pomdp"
    path.write_text(TIGER_FILE)
    _same(TabularPOMDP.from_file(path), TabularPOMDP(**tiger()))


@pytest.mark.parametrize("seed", range(5))
def test_written_and_read_again(tmp_path: Path, seed: int) -> None:
    model = _random(seed)
    model.to_file(tmp_path / "m.pomdp")
    _same(TabularPOMDP.from_file(tmp_path / "m.pomdp"), model)


def test_rows_numbers_costs_and_start_forms(tmp_path: Path) -> None:
    base = "discount: 0.5\nvalues: cost\nstates: 3\nactions: go\nobservations: 2\n"
    tables = "T: * : * uniform\nT: go : 0 \n0 1 0\nT: 0 : 1 : 2 1.0\nT: 0 : 1 : 0 0\nT: 0 : 1 : 1 0\nO: * \nuniform\n"
    rewards = "R: go : 0\n 1 1\n 2 4\n 0 0\nR: go : 1 : 2\n 6 8\n"
    path = tmp_path / "m.pomdp"
    for start, wanted in (
        ("start: 1 0 0", [1, 0, 0]),
        ("start: 2", [0, 0, 1]),
        ("start include: 0 2", [0.5, 0, 0.5]),
        ("start exclude: 0", [0, 0.5, 0.5]),
        ("start: 0.25 0.5 0.25", [0.25, 0.5, 0.25]),
    ):
        path.write_text(f"{base}{start}\n{tables}{rewards}")
        model = TabularPOMDP.from_file(path)
        assert model.start.tolist() == wanted
        assert model.reward[0].tolist() == [-3.0, -7.0, 0.0]
        assert model.transition[0].toarray()[1].tolist() == [0, 0, 1]


def test_words_and_wildcards_for_rows(tmp_path: Path) -> None:
    path = tmp_path / "m.pomdp"
    path.write_text(
        "discount: 0.9\nstates: a b c\nactions: go back\nobservations: x y\nstart: b\n"
        "T: go identity\nT:go:a\nreset\nT: go : b uniform\nT: back : * : * 0\nT: back : * : a 1.0\n"
        "O: * : * : x 0.333333\nO: * : * : y 0.666667\nO: go : c uniform\n"
        "R: * : * : * : * 1\nR: go : b : c : y 7\nR: back : a : * : * -2\nR: back : c : a\n3 6\n"
    )
    model = TabularPOMDP.from_file(path)
    assert np.allclose(model.transition[0].toarray(), np.array([[0, 1, 0], [1 / 3, 1 / 3, 1 / 3], [0, 0, 1]]))
    assert np.allclose(model.transition[1].toarray(), [[1, 0, 0]] * 3)
    assert np.allclose(model.observation.sum(axis=2), 1.0)
    assert model.observation[0, 2].tolist() == [0.5, 0.5]
    wanted = np.array([[1.0, 1 + 6 / 3 * 0.5, 1.0], [-2.0, 1.0, 3 / 3 + 6 * 2 / 3]])
    assert np.allclose(model.reward, wanted, atol=1e-5)


def test_large_files_are_read_sparsely(tmp_path: Path) -> None:
    model = TabularPOMDP(**rocksample(5, 5))
    model.to_file(tmp_path / "rocks.pomdp")
    _same(TabularPOMDP.from_file(tmp_path / "rocks.pomdp"), model)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.integers(0, 2**31))
def test_damaged_files_end_in_one_line(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    words = TIGER_FILE.split(" ")
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(len(words)))
        words[at] = str(
            rng.choice(["", ":", "*", "-1", "nan", "1e400", "99", "T:", "reset\n", "identity", words[at - 1]])
        )
    path = tmp_path_factory.getbasetemp() / "damaged.pomdp"
    path.write_text(" ".join(words))
    try:
        TabularPOMDP.from_file(path)
    except UserError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("0.85 0.15\n", "0.85 0.25\n"), "sum to 1.1, not 1"),
        (("T: listen\n", "T: lisen\n"), "line 9: unknown action 'lisen'"),
        (("discount: 0.95", "discount: high"), "line 3: expected a number, found 'high'"),
        (("states: tiger-left tiger-right\n", ""), "'start' comes before 'states:'"),
        ((": * -1\n", ":"), "unknown observation"),
    ],
)
def test_mistakes_in_files_are_named_with_their_line(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    path = tmp_path / "bad.pomdp"
    path.write_text(TIGER_FILE.replace(*change, 1))
    with pytest.raises(UserError, match=r"bad\.pomdp") as caught:
        TabularPOMDP.from_file(path)
    assert message in str(caught.value)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_bounds_hold_and_beliefs_are_bayes_on_random_models(seed: int) -> None:
    model = _random(seed)
    certificate = solve(model, gap=0.05, time_limit=5.0, max_trials=60)
    assert certificate.lower <= certificate.upper + 1e-6
    assert certificate.upper <= model.fully_observed.max(axis=0) @ model.start + 1e-6
    chances = model.observation_chances(model.start, 0)
    assert chances.sum() == pytest.approx(1.0)
    mixture = sum(p * model.update(model.start, 0, o) for o, p in enumerate(chances) if p > 1e-9)
    assert np.allclose(mixture, model.predict(model.start, 0), atol=1e-6)


def test_terminal_states_must_be_terminal() -> None:
    arrays = tiger()
    arrays["terminal"] = np.array([True, False])
    with pytest.raises(UserError, match="leaves a terminal state"):
        TabularPOMDP(**arrays)


@pytest.mark.parametrize("method", ["bounds", "po-uct"])
def test_search_plays_tiger_as_the_solver_does(method: Method) -> None:
    model = TabularPOMDP(**tiger())
    certificate = solve(model, gap=0.05, time_limit=30)
    search = TreeSearch(model, np.random.default_rng(0), simulations=20_000, depth=20, method=method)
    for hints in range(-3, 4):  # net number of times the tiger was heard on the left
        belief = model.start
        for _ in range(abs(hints)):
            belief = model.update(belief, 0, 0 if hints > 0 else 1)
        action, info = search.plan(belief)
        assert action == certificate.action(belief)
        assert max(info["values"]) <= certificate.at(belief)[1] + 1e-6
        assert info["lower"] <= certificate.at(belief)[1] + 1e-6
        assert info["upper"] >= certificate.at(belief)[0] - 1e-6


def test_closed_loop_of_the_search_is_worth_the_optimum() -> None:
    model = TabularPOMDP(**tiger())
    assert exact_return(TreeSearch(model, np.random.default_rng(0), simulations=100)) == pytest.approx(19.371, abs=2e-3)
    search = TreeSearch(model, np.random.default_rng(0), simulations=50)
    assert np.mean([closed_loop(search, 60, np.random.default_rng(seed)) for seed in range(8)]) > 0


def test_search_on_rocksample_lies_in_the_bracket() -> None:
    model = TabularPOMDP(**rocksample(4, 4))
    value = exact_return(TreeSearch(model, np.random.default_rng(0), simulations=30, reuse=False), least=1e-3)
    assert 0.95 * 17.925 <= value <= 17.93


@pytest.mark.parametrize("method", ["bounds", "po-uct"])
def test_search_repeats_and_respects_the_mask(method: Method) -> None:
    model = TabularPOMDP(**tiger())

    def search() -> TreeSearch:
        return TreeSearch(model, np.random.default_rng(4), simulations=500, method=method)

    plans = [search().plan(model.start) for _ in range(2)]
    assert plans[0] == plans[1]
    action, info = search().plan(model.start, np.array([False, True, True]))
    assert action != 0
    assert info["visits"][0] == 0
    with pytest.raises(ValueError, match="at least one allowed action"):
        search().plan(model.start, np.zeros(3, np.bool_))


@pytest.mark.parametrize("method", ["bounds", "po-uct"])
def test_the_tree_below_what_happened_is_kept_and_can_be_drawn(method: Method) -> None:
    model = TabularPOMDP(**rocksample(4, 4))
    search = TreeSearch(model, np.random.default_rng(0), simulations=60, method=method, exploration=20.0)
    action, _ = search.plan(model.start)
    seen = int(model.observation_chances(model.start, action).argmax())
    belief = model.update(model.start, action, seen)
    fresh = TreeSearch(model, np.random.default_rng(0), simulations=60, method=method, exploration=20.0)
    assert search.update(action, seen)
    _, kept = search.plan(belief)
    _, alone = fresh.plan(belief)
    assert sum(kept["visits"]) > sum(alone["visits"])
    assert not fresh.update(action, 1 - seen)  # a move is always followed by "ogood"
    dot, svg = search.draw(2), search.draw(2, "svg")
    assert dot.startswith("digraph")
    assert " / ogood" in dot
    assert ElementTree.fromstring(svg).tag.endswith("svg")


def test_bounds_that_cross_are_an_error() -> None:
    model = TabularPOMDP(**tiger())
    search = TreeSearch(model, np.random.default_rng(0), simulations=5)
    search._bounds.arrays.blind[:] = 1e6
    with pytest.raises(CrossedBounds, match="above the upper bound"):
        search.plan(model.start)
    certificate = solve(model, max_trials=1)
    certificate.bounds.arrays.blind[:] = certificate.upper + 1e-3
    with pytest.raises(CrossedBounds, match="above the upper bound"):
        certificate.at(model.start)


def test_arguments_that_cannot_be_are_named() -> None:
    """A belief of another length went into the kernels and corrupted memory."""
    model = TabularPOMDP(**tiger())
    rng = np.random.default_rng(0)
    search, certificate = TreeSearch(model, rng, simulations=5), solve(model, max_trials=1)
    for belief, message in ((np.full(5, 0.2), r"shape \[2\], found \[5\]"), (np.ones(2), "sum to 1"),
                            (np.array([1.5, -0.5]), "distribution"), (np.full(2, np.nan), "distribution")):  # fmt: skip
        for use in (search.plan, certificate.at, certificate.action):
            with pytest.raises(UserError, match=message):
                use(belief)
    for options in ({"simulations": 0}, {"depth": 0}, {"method": "best"}, {"leaf": "none"}, {"time_limit": -1.0}):
        with pytest.raises(UserError, match="search"):
            TreeSearch(model, rng, **options)
    with pytest.raises(UserError, match=r"TabularPOMDP\(\*\*tiger\(\)\)"):
        TreeSearch(tiger(), rng)  # type: ignore[arg-type]
