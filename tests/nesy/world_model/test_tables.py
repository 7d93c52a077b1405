"""Conditional tables: proper distributions, exact counts, back-off, and agreement of every way to use them."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nesy.world_model import Structure, SymbolicCodec, SymbolicWorldModel
from nesy.world_model.codes.refinement import Refiner, separate
from nesy.world_model.rolling import Rollout
from nesy.world_model.structure import Limits, search
from nesy.world_model.successors import most_probable, pack, successors
from nesy.world_model.tables import all_tables, conditional_table, log_probability, row_index


def random_structure(rng: np.random.Generator, factors: int, actions: int) -> Structure:
    """Random parents; two in slice t+1 only where one is a parent of the other."""
    now, then = [], []
    for _ in range(actions):
        now_of, then_of, edges = [], [], []
        for i in range(factors):
            now_of.append(tuple(int(j) for j in rng.permutation(factors)[: rng.integers(0, 3)]))
            kind = rng.integers(3)
            if kind == 2 and edges:
                then_of.append(edges[rng.integers(len(edges))])
            elif kind and i:
                then_of.append((int(rng.integers(i)),))
            else:
                then_of.append(())
            edges += [(j, i) for j in then_of[-1]]
        now.append(tuple(now_of))
        then.append(tuple(then_of))
    return Structure(tuple(now), tuple(then), tuple(range(factors)))


def random_model(seed: int, factors: int = 4, values: int = 3, actions: int = 2) -> SymbolicWorldModel:
    rng = np.random.default_rng(seed)
    model = SymbolicWorldModel(hidden=8, num_factors=factors, num_values=values, num_actions=actions, view_size=3)
    edges = int(rng.integers(1, 60))
    model.set_transitions(
        random_structure(rng, factors, actions),
        rng.integers(0, values, (edges, factors)),
        rng.integers(0, actions, edges),
        rng.integers(0, values, (edges, factors)),
        rng.integers(1, 5, edges),
    )
    return model


def joint(model: SymbolicWorldModel, code: np.ndarray, action: int) -> dict[tuple[int, ...], float]:
    """T(. | code, action) by brute force, from the definition."""
    structure = model.structure()
    result: dict[tuple[int, ...], float] = {}
    for then in np.ndindex(*[model.num_values] * model.num_factors):
        mass = 1.0
        for i in range(model.num_factors):
            parents = [code[j] for j in structure.parents_now[action][i]]
            parents += [then[j] for j in structure.parents_next[action][i]]
            row = 0
            for value in parents:
                row = row * model.num_values + int(value)
            mass *= model.conditional(action, i)[row, then[i]]
        result[then] = mass
    return result


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_every_row_is_a_proper_distribution(seed: int) -> None:
    model = random_model(seed)
    for action in range(model.num_actions):
        for factor in range(model.num_factors):
            table = model.conditional(action, factor)
            structure = model.structure()
            parents = len(structure.parents_now[action][factor]) + len(structure.parents_next[action][factor])
            assert table.shape == (model.num_values**parents, model.num_values)
            assert (table > 0).all()
            np.testing.assert_allclose(table.sum(1), 1.0, atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_transition_equals_the_tables_on_codes(seed: int) -> None:
    """The network's marginals are those of the joint distribution that the tables define."""
    model = random_model(seed)
    rng = np.random.default_rng(seed)
    code, action = rng.integers(0, model.num_values, model.num_factors), int(rng.integers(model.num_actions))
    distribution = joint(model, code, action)
    assert sum(distribution.values()) == pytest.approx(1.0)
    expected = np.zeros((model.num_factors, model.num_values))
    for then, mass in distribution.items():
        expected[np.arange(model.num_factors), list(then)] += mass
    got = model.transition(model.one_hot(torch.as_tensor(code)[None]), torch.tensor([action]))[0]
    np.testing.assert_allclose(got.numpy(), expected, atol=1e-5)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_successors_and_log_probability_equal_the_tables(seed: int) -> None:
    model = random_model(seed)
    rng = np.random.default_rng(seed)
    code, action = rng.integers(0, model.num_values, model.num_factors), int(rng.integers(model.num_actions))
    distribution = joint(model, code, action)
    packed = pack(model.structure(), model.tables())
    ends, then, mass = successors(packed, code[None], np.array([action]), threshold=0.0)
    assert ends.tolist() == [0, len(distribution)]
    assert {tuple(map(int, c)): pytest.approx(m) for c, m in zip(then, mass, strict=True)} == distribution
    best = max(distribution, key=lambda c: distribution[c])
    assert distribution[tuple(map(int, most_probable(packed, code[None], np.array([action]))[0]))] == pytest.approx(
        distribution[best]
    )
    every = np.array(list(distribution))
    logs = log_probability(
        model.structure(), model.tables(), np.repeat(code[None], len(every), 0),
        np.full(len(every), action), every, model.num_values,
    )  # fmt: skip
    np.testing.assert_allclose(np.exp(logs), list(distribution.values()), rtol=1e-9)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6))
def test_rolling_a_belief_equals_summing_over_codes(seed: int) -> None:
    model = random_model(seed)
    rng = np.random.default_rng(seed)
    belief = rng.dirichlet(np.ones(model.num_values), size=model.num_factors)
    rollout = Rollout(pack(model.structure(), model.tables()), threshold=1e-13)
    start, code, mass = rollout.spread(belief[None])
    np.testing.assert_allclose(rollout.marginals(start, code, mass, 1)[0], belief, atol=1e-5)
    start, code, mass = rollout.step(start, code, mass, np.full(len(start), 1))
    expected = np.zeros_like(belief)
    for now in np.ndindex(*[model.num_values] * model.num_factors):
        chance = float(np.prod(belief[np.arange(model.num_factors), list(now)]))
        for then, part in joint(model, np.array(now), 1).items():
            expected[np.arange(model.num_factors), list(then)] += chance * part
    np.testing.assert_allclose(rollout.marginals(start, code, mass, 1)[0], expected, atol=1e-4)


def test_counts_and_back_off_by_hand() -> None:
    # Parent of slice t: values 0, 0, 1; child 1, 1, 0; weights 3, 1, 2. Value 2 of the parent was never met.
    table = conditional_table(
        np.array([[0], [0], [1]]), 1, np.array([1, 1, 0]), np.array([3.0, 1.0, 2.0]), 3, strength=0.5
    )
    marginal = (np.array([2.0, 4.0, 0.0]) + 1 / 3) / 7
    np.testing.assert_allclose(table[0], (np.array([0.0, 4.0, 0.0]) + 0.5 * marginal) / 4.5)
    np.testing.assert_allclose(table[1], (np.array([2.0, 0.0, 0.0]) + 0.5 * marginal) / 2.5)
    np.testing.assert_allclose(table[2], marginal)


def test_a_guess_keeps_the_arcs_inside_the_slice() -> None:
    """With the now-value never met, the row follows the parent in slice t+1, not the marginal."""
    parents = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    table = conditional_table(parents, 1, np.array([0, 1, 0, 1]), np.full(4, 10.0), 3, strength=0.01)
    row = row_index(np.array([[2, 1]]), 3)[0]
    assert table[row].argmax() == 1
    assert table[row, 1] > 0.9


def test_search_finds_the_parents_of_a_known_world() -> None:
    rng = np.random.default_rng(0)
    now = rng.integers(0, 4, (4000, 4))
    then = rng.integers(0, 4, (4000, 4))
    then[:, 1] = now[:, 3]
    then[:, 2] = np.maximum(now[:, 0], then[:, 0])
    action = np.zeros(4000, dtype=np.int64)
    limits = Limits(now=2, next=1, total=3, penalty=5.0)
    structure, nll = search(
        now, action, then, np.ones(4000, dtype=np.int64), num_values=4, num_actions=1, limits=limits
    )
    assert structure.parents_now[0] == ((), (3,), (0,), ())
    assert structure.parents_next[0] == ((), (), (0,), ())
    assert nll == pytest.approx(2 * np.log(4), abs=0.01)


@pytest.mark.parametrize(("arcs", "bound"), [(0, 1), (1, 2), (2, 3)])
def test_search_keeps_the_limits(arcs: int, bound: int) -> None:
    rng = np.random.default_rng(1)
    now, then = rng.integers(0, 3, (300, 6)), rng.integers(0, 3, (300, 6))
    limits = Limits(now=3, next=arcs, total=4)
    action = rng.integers(0, 2, 300)
    structure, _ = search(now, action, then, np.ones(300, int), num_values=3, num_actions=2, limits=limits)
    for a in range(2):
        edges = set()
        for i in structure.order:
            assert len(structure.parents_now[a][i]) <= 3
            assert len(structure.parents_next[a][i]) < bound
            assert len(structure.parents_now[a][i]) + len(structure.parents_next[a][i]) <= 4
            if len(structure.parents_next[a][i]) == 2:
                assert frozenset(structure.parents_next[a][i]) in edges
            edges |= {frozenset((i, j)) for j in structure.parents_next[a][i]}


def test_refinement_only_lowers_the_entropy_without_noise(codec: SymbolicCodec, toy) -> None:  # type: ignore[no-untyped-def]
    from nesy.world_model.distinct import transitions_of

    transitions = transitions_of(toy)
    rng = np.random.default_rng(0)
    logits = rng.normal(size=(transitions.num_views, 8, 8))
    codes = separate(logits)
    assert len(np.unique(codes, axis=0)) == transitions.num_views
    refiner = Refiner(transitions, 8, 4, Limits(now=2, next=1, total=3))
    book = refiner.search(codes)
    free = np.zeros_like(logits)
    for _ in range(3):
        better, moved = refiner.refine(book, free, 0.0, 1, rng, list(range(8)))
        assert better.nll <= book.nll + 1e-9
        assert len(np.unique(better.codes, axis=0)) == transitions.num_views
        assert moved > 0 or better.nll == pytest.approx(book.nll)
        book = better
    # The entropy it reports is the likelihood of tables that are counted, not smoothed.
    c, t = book.codes, transitions
    tables = all_tables(book.structure, c[t.source], t.action, c[t.target], t.weight, 8, strength=1e-9)
    logs = log_probability(book.structure, tables, c[t.source], t.action, c[t.target], 8)
    assert -(t.weight * logs).sum() / t.weight.sum() == pytest.approx(book.nll, abs=1e-6)
