"""What people look at: text, trees, pictures, and figures of fidelity."""

from dataclasses import replace

import networkx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nesy.dbn import describe
from nesy.dbn.evaluation.measures import row_differences, unknown_code_rate
from nesy.dbn.evaluation.rollouts import rollout_drift
from nesy.dbn.graph import arc_strength
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.reading.drawing import draw_factor, draw_graph, mean_view
from nesy.dbn.reading.step_text import describe_step_table
from nesy.dbn.reading.trees import conditional_tree, describe_tree, look_up
from nesy.errors import UserError
from tests.nesy.dbn.models import all_codes, random_dbn
from tests.nesy.dbn.steps import with_steps
from tests.nesy.dbn.toy import experience, toy


def test_a_table_as_text():
    text = describe(toy()[0], factor=1, action=1)
    assert "P(side' | side, front) under go: 9 rows, 4 met in experience" in text
    lines = [line.split() for line in text.splitlines()]
    assert ["1", "0", "2", "0:", "1.000"] in lines
    assert ["1", "1", "2", "1:", "1.000"] in lines
    assert "= 1  not all_free" in text or "= 2  not met" in text


def test_an_overview_and_wrong_names():
    text = describe(toy()[0])
    assert "swap:" in text and "go:" in text and "front' <- side 1.00" in text
    with pytest.raises(UserError, match="factors are 0 to 2"):
        describe(toy()[0], factor=3)
    with pytest.raises(UserError, match="swap, go"):
        describe(toy()[0], action=2)


def test_step_tables_as_text():
    rng = np.random.default_rng(0)
    dbn = with_steps(random_dbn(rng), rng)
    text = describe_step_table(dbn, "reward")
    for a, action in enumerate(dbn.action_names):
        parent = dbn.factor_names[dbn.step_tables["reward"].parents(a, 0)[0][1]]
        assert f"{action}:\n  reward <- {parent}   (3 rows, 3 met)" in text
    counts = dbn.step_tables["reward"].counts(0, 0)
    value = dbn.step_tables["reward"].table(0, 0)[counts.argmax(), 0]
    first = text.split("count\n")[1].splitlines()[0].split()
    assert first == [str(counts.argmax()), str(counts.max()), f"{value:.4g}"]
    assert describe_step_table(dbn, "observation", target="cell_0_1").count("wall:") == 3
    assert "goes_on" in describe_step_table(dbn, "termination", action=1)
    with pytest.raises(UserError, match="no target 'cell_9_9'; it has cell_0_0, cell_0_1"):
        describe_step_table(dbn, "observation", target="cell_9_9")
    with pytest.raises(UserError, match="no reward table; it has none"):
        describe_step_table(random_dbn(rng), "reward")


def test_the_graph_has_an_edge_per_parent():
    dbn = toy()[0]
    graph = dbn.to_networkx()
    assert set(graph.successors("side")) == {"front'", "side'"}
    assert graph.edges["front'", "goal'", "go"]["strength"] == 0
    assert graph.edges["side", "front'", "swap"]["strength"] == 1
    assert networkx.is_directed_acyclic_graph(graph)
    assert dbn.to_networkx(0).number_of_edges() == 3


def test_strength_is_the_mean_change_among_rows_met():
    table = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0], [0.0, 1.0]])
    dbn = TwoSliceDBN.from_tables([[table, np.eye(2)]], [[[0, 1], [1]]], counts=[[np.array([1, 1, 1, 0]), np.ones(2)]])
    assert arc_strength(dbn, 0, 0) == [1.0, 0.5]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_trees_are_exact_and_never_larger_than_the_table(seed):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng, max_parents=3, num_values=3)
    # repeated rows, so that there is something to merge
    table = dbn.probabilities[rng.integers(3, size=len(dbn.probabilities))]
    dbn = replace(dbn, probabilities=table)
    for action in range(2):
        for factor in range(3):
            for met_only in (False, True):
                tree = conditional_tree(dbn, action, factor, met_only=met_only)
                assert tree.error == 0
                rows = dbn.counts(action, factor) > 0 if tree.met_only else np.ones(dbn.num_rows(action, factor), bool)
                assert tree.leaves <= max(1, rows.sum())
                shape = (3,) * len(dbn.parents(action, factor))
                for row in np.flatnonzero(rows):
                    leaf = look_up(tree.tree, np.array(np.unravel_index(row, shape) if shape else ()))
                    np.testing.assert_array_equal(leaf.distribution, dbn.cpt(action, factor)[row])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 0.02, 0.1, 0.4]))
def test_rough_trees_state_their_error_and_are_no_larger_than_exact_ones(seed, tolerance):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng, max_parents=3, num_values=3)
    # few kinds of rows, each a little off: what is close to what is close need not be close
    kinds = dbn.probabilities[rng.integers(3, size=len(dbn.probabilities))]
    table = (1 - tolerance) * kinds + tolerance * rng.dirichlet(np.ones(3), size=len(kinds))
    dbn = replace(dbn, probabilities=table)
    for action in range(2):
        for factor in range(3):
            rough = conditional_tree(dbn, action, factor, tolerance)
            shape = (3,) * len(dbn.parents(action, factor))
            apart = [
                0.5 * np.abs(look_up(rough.tree, np.array(np.unravel_index(row, shape) if shape else ())).distribution
                             - dbn.cpt(action, factor)[row]).sum()
                for row in range(dbn.num_rows(action, factor))
            ]  # fmt: skip
            assert rough.error == pytest.approx(max(apart), abs=1e-15)
            assert rough.error <= 4 * tolerance
            assert rough.leaves <= conditional_tree(dbn, action, factor).leaves


def test_trees_put_values_together_and_state_their_error():
    dbn = toy()[0]
    tree = conditional_tree(dbn, 1, 1)
    # side' = 0 if front = 0 else side
    assert tree.leaves == 5
    assert "front in {1, 2}" in describe_tree(dbn, 1, 1, tree)
    rough = conditional_tree(random_dbn(np.random.default_rng(3), max_parents=3), 0, 0, tolerance=0.5)
    assert 0 <= rough.error <= 0.5


def test_row_differences_and_unknown_codes():
    dbn, taken = toy()[0], experience()
    assert row_differences(dbn, *taken.distinct()) == {"row_tv": 0.0, "row_kl": 0.0}
    assert unknown_code_rate(dbn, taken.view_codes) == 0
    # from (1, 0, goal) the swap leads to (0, 1, goal), which is not among these two
    known = np.array([[1, 0, 0], [0, 0, 0]], dtype=np.uint8)
    assert unknown_code_rate(dbn, known) == pytest.approx(0.25, abs=0.02)


def test_rollouts_of_marginals_drift_where_factors_are_correlated():
    half = np.full((1, 2), 0.5)
    copy = np.eye(2)
    different = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [1.0, 0.0]])
    # X1' is a copy of X0', and X2 becomes X0 xor X1: always 0, but not for a product of marginals
    dbn = TwoSliceDBN.from_tables([[half, copy, different]], [[[], [], [0, 1]]], [[[], [0], []]])
    drift = rollout_drift(dbn, all_codes(dbn), np.random.default_rng(0), steps=3, drop=0.0)
    assert drift["marginal_high"][0] == pytest.approx(0, abs=1e-9)
    assert drift["marginal_low"][1] == pytest.approx(0.5 / 3)
    # two equal coins as a product: half of the mass is elsewhere
    assert drift["joint_low"][0] == drift["joint_high"][0] == pytest.approx(0.5)
    assert drift["left_out"] == pytest.approx([0, 0, 0], abs=1e-12)


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_pictures_are_written(tmp_path, suffix):
    dbn, codebook = toy()
    draw_graph(dbn, tmp_path / f"graph.{suffix}")
    draw_factor(dbn, codebook, 0, tmp_path / f"factor.{suffix}")
    for name in ("graph", "factor"):
        content = (tmp_path / f"{name}.{suffix}").read_bytes()
        assert content.startswith(b"\x89PNG" if suffix == "png" else b"<?xml")
        assert len(content) > 2000


def test_pictures_that_cannot_be_drawn_are_explained(tmp_path):
    dbn, codebook = toy()
    with pytest.raises(UserError, match=r"\.png or \.svg"):
        draw_graph(dbn, tmp_path / "graph.doc")
    with pytest.raises(UserError, match="no factor"):
        draw_factor(dbn, codebook, 9, tmp_path / "f.png")
    with pytest.raises(UserError, match="no action"):
        draw_graph(dbn, tmp_path / "f.png", action=5)


def test_a_mean_view_mixes_colours():
    views = np.array([[[0]], [[1]]], dtype=np.uint8)
    both = mean_view(views)[0, 0]
    np.testing.assert_allclose(both, (mean_view(views[:1]) + mean_view(views[1:]))[0, 0] / 2)
