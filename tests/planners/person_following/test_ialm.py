from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nesy.errors import UserError
from nesy.perspective.influence import INFLUENCE_MODES
from nesy.run_folder import RunFolder
from planners.comparison.model_store import ModelStore
from planners.person_following import ialm, kernels
from planners.person_following.beliefs import ParticleBelief
from planners.person_following.ialm import IALM, SCALARS
from planners.search.random_bits import stream
from tests.planners.person_following.models import K, N, small_ialm

CODES = [np.array(code) for code in itertools.product(range(K), repeat=N)]


def _variables(model: IALM, x: np.ndarray, y: np.ndarray, then: np.ndarray, **scalars: int) -> np.ndarray:
    v = np.zeros((1, 3 * N + len(SCALARS)), np.int32)
    v[0, :N], v[0, N : 2 * N], v[0, 2 * N : 3 * N] = x, then, y
    for name, value in scalars.items():
        v[0, 3 * N + SCALARS.index(name)] = value
    return v


def _chance(model: IALM, table: str, variables: np.ndarray) -> np.ndarray:
    found = model.tables[table]
    return found.estimates()[found.locate(variables)[0]]


def _brute_force(model: IALM, state: np.ndarray, action: int) -> dict[tuple[int, ...], float]:
    """P(x', c', y' | state, action) by enumeration of motions, persons' actions and codes."""
    x, y = state[:N].astype(int), state[N : 2 * N].astype(int)
    pose = state[2 * N : 2 * N + 3].astype(int) - np.array([2, 2, 0])
    out: dict[tuple[int, ...], float] = {}
    blank = np.zeros(N, int)
    moved = _chance(model, "moved", _variables(model, x, y, blank)) if action != 3 else np.array([0.0, 1.0])
    for motion, share in ((action, moved[1]), (3, moved[0])):
        for then in CODES:
            here = share * np.exp(model.dbn.log_prob(x, motion, then))
            waits = _chance(model, "waits", _variables(model, x, y, then))[1]
            influence = _chance(model, "influence", _variables(model, x, y, then))
            for person, chance in enumerate([*((1 - waits) * influence), waits]):
                after = model.motion.apply(pose[None], np.array([motion]), np.array([person]))
                place = tuple(model.motion.shifted(after)[0].tolist())
                for seen in CODES:
                    weight = here * chance * np.exp(model.dbn.log_prob(y, person, seen))
                    key = (*then.tolist(), *place, *seen.tolist())
                    out[key] = out.get(key, 0.0) + float(weight)
    return out


@pytest.mark.parametrize("action", range(4))
def test_sampled_steps_have_the_distribution_that_the_tables_say(action: int) -> None:
    model = small_ialm(1)
    compiled = kernels.compile_model(model)
    state = np.array([1, 0, 0, 1, 2, 2, 3, 0, 0], np.int16)
    after, v = np.zeros_like(state), np.zeros(3 * N + len(SCALARS), np.int16)
    bits = stream(np.random.default_rng(action))
    exact = _brute_force(model, state, action)
    assert sum(exact.values()) == pytest.approx(1.0)
    draws = 20_000
    counts: Counter[tuple[int, ...]] = Counter()
    for _ in range(draws):
        kernels.step(compiled, state, action, after, v, bits)
        order = np.concatenate([after[:N], after[2 * N : 2 * N + 3], after[N : 2 * N]])
        counts[tuple(order.tolist())] += 1
    assert set(counts) <= {key for key, p in exact.items() if p > 0}
    for key, p in exact.items():
        assert counts[key] / draws == pytest.approx(p, abs=5 * np.sqrt(p * (1 - p) / draws) + 1e-4)


def _believing(model: IALM, mode: str, prior: np.ndarray, particles: int = 2000) -> ParticleBelief:
    belief = ParticleBelief(model, kernels.compile_model(model), particles, np.random.default_rng(0), mode=mode)
    belief.reset(np.array([0, 1]), np.array([0, 0, 3]), prior)
    return belief


def test_the_filter_predicts_by_the_influence() -> None:
    """P(the person goes ahead, x' | l, stay) has I(forward | l) as its factor, and no other share of the belief."""
    model, action, then = small_ialm(2), 3, np.array([1, 1])
    belief = _believing(model, "perspective-shift", np.array([[0.3, 0.7], [0.9, 0.1]]))
    codes = belief.states[:, N : 2 * N]
    brute = sum(model.influence_of(code[None].astype(np.uint8))[0] * (codes == code).all(1).mean() for code in CODES)
    assert np.allclose(belief.influence(), brute)
    waits = _chance(model, "waits", _variables(model, then, then, then))[1]
    variables = _variables(model, then, then, then, next_ahead=3)
    sight = _chance(model, "visible", variables)[1] * _chance(model, "outcome", variables)[0]
    wanted = np.exp(model.dbn.log_prob(np.array([0, 1]), action, then)) * (1 - waits) * brute[2] * sight
    found = np.exp(belief.update(action, then, np.array([0, 1, 3]), np.full((N, K), 0.5)))
    assert found == pytest.approx(float(wanted))


@pytest.mark.parametrize("mode", INFLUENCE_MODES)
def test_a_search_begins_with_the_influence(mode: str) -> None:
    """What the person does in the first step of walks from the belief's particles is I(u | l)."""
    model = small_ialm(2)
    belief = _believing(model, mode, np.eye(K)[[1, 0]])
    compiled, bits = kernels.compile_model(model), stream(np.random.default_rng(1))
    after, v = np.zeros(model.state_size, np.int16), np.zeros(3 * N + len(SCALARS), np.int16)
    counts = np.zeros(4)
    for state in np.tile(belief.states, (10, 1)):
        kernels.step(compiled, state, 3, after, v, bits)
        counts[v[3 * N + ialm.PERSON]] += 1
    assert counts[:3] / counts[:3].sum() == pytest.approx(belief.influence(), abs=0.02)


def test_modes_put_other_codes_in_the_persons_place() -> None:
    model = replace(small_ialm(2), person_counts=np.array([1.0, 2.0, 3.0, 4.0]))
    told = np.eye(K)[[1, 0]]
    shares: dict[str, list[np.ndarray]] = {}
    for mode in INFLUENCE_MODES:
        belief = _believing(model, mode, told)
        rows = []
        for _ in range(12):
            rows.append(np.array([(belief.states[:, N : 2 * N] == code).all(axis=1).mean() for code in CODES]))
            belief.update(3, np.array([0, 1]), np.array([0, 0, 3]), told)
        shares[mode] = rows
    for row in (*shares["egocentric"], *shares["perfect-information"]):
        assert row.tolist() == [0.0, 0.0, 1.0, 0.0]
    for row in shares["zero"]:  # whatever it is told and sees
        assert row == pytest.approx(model.person_chances, abs=0.04)
    drawn = [int(row.argmax()) for row in shares["random"]]
    assert all(row.max() == 1.0 for row in shares["random"]) and len(set(drawn)) > 1
    assert 0.5 < shares["perspective-shift"][-1][2] < 1.0


def test_next_local_state_given_the_influence() -> None:
    """P(x', c' | l, a) = sum_u T(x', c' | x, c, u, a) I(u | l), against enumeration over y."""
    model, action = small_ialm(3), 2
    prior = np.array([[0.25, 0.75], [0.6, 0.4]])
    x = np.array([1, 1])
    by_codes: dict[tuple[int, ...], float] = {}
    for y in CODES:
        weight = prior[0, y[0]] * prior[1, y[1]]
        for key, p in _brute_force(model, np.array([*x, *y, 2, 2, 3, 0, 0]), action).items():
            by_codes[key[: N + 3]] = by_codes.get(key[: N + 3], 0.0) + weight * p
    influence = sum(prior[0, y[0]] * prior[1, y[1]] * model.influence_of(y[None].astype(np.uint8))[0] for y in CODES)
    by_influence: dict[tuple[int, ...], float] = {}
    moved = _chance(model, "moved", _variables(model, x, x, x))
    for motion, share in ((action, moved[1]), (3, moved[0])):
        for then in CODES:
            here = share * np.exp(model.dbn.log_prob(x, motion, then))
            waits = _chance(model, "waits", _variables(model, x, x, then))[1]
            for person, chance in enumerate([*((1 - waits) * influence), waits]):
                after = model.motion.apply(np.array([[0, 0, 3]]), np.array([motion]), np.array([person]))
                key = (*then.tolist(), *model.motion.shifted(after)[0].tolist())
                by_influence[key] = by_influence.get(key, 0.0) + float(here * chance)
    assert by_codes.keys() == by_influence.keys()
    for key, p in by_codes.items():
        assert by_influence[key] == pytest.approx(p, abs=1e-12)


def test_filter_agrees_with_bayes_by_enumeration() -> None:
    """After two observed steps the particles' person codes have the exact posterior."""
    model = small_ialm(4)
    compiled = kernels.compile_model(model)
    prior = np.full((N, K), 1.0 / K)
    start = np.array([0, 1])
    steps = [(2, np.array([1, 1]), (0, 1, 3)), (3, np.array([0, 1]), (0, 2, 3))]
    exact = {(*start, *y, 2, 2, 3, 0, 0): 0.25 for y in CODES}
    for action, then, pose in steps:
        following: dict[tuple[int, ...], float] = {}
        seen = tuple(model.motion.shifted(np.array([pose]))[0].tolist())
        for state, weight in exact.items():
            for key, p in _brute_force(model, np.array(state), action).items():
                if key[:N] == tuple(then) and key[N : N + 3] == seen:
                    v = _variables(model, then, then, then, next_ahead=key[N + 1])
                    visible = _chance(model, "visible", v)[1] * _chance(model, "outcome", v)[0]
                    after = (*then, *key[N + 3 :], *seen, 0, 0)
                    following[after] = following.get(after, 0.0) + weight * p * visible
        total = sum(following.values())
        exact = {state: weight / total for state, weight in following.items()}
    belief = ParticleBelief(model, compiled, 40_000, np.random.default_rng(0), renewal=0.0)
    belief.reset(start, np.array([0, 0, 3]), prior)
    for action, then, pose in steps:
        belief.update(action, then, np.array(pose), prior)
    assert belief.resets == 0
    for y in CODES:
        share = (belief.states[:, N : 2 * N] == y).all(axis=1).mean()
        wanted = sum(weight for state, weight in exact.items() if state[N : 2 * N] == tuple(y))
        assert share == pytest.approx(wanted, abs=0.015)


def test_renewal_brings_back_codes_that_no_particle_holds() -> None:
    """Of a belief that holds one wrong code, a share `renewal` comes anew from the prior each step."""
    model = small_ialm(4)
    prior = np.array([[0.1, 0.9], [0.9, 0.1]])
    shares = {}
    for renewal in (0.0, 0.25, 1.0):
        belief = ParticleBelief(model, kernels.compile_model(model), 20_000, np.random.default_rng(0), renewal)
        belief.reset(np.array([0, 1]), np.array([0, 0, 3]), prior)
        belief.states[:, N : 2 * N] = 0, 1
        belief.update(2, np.array([1, 1]), np.array([0, 1, 3]), prior)
        shares[renewal] = (belief.states[:, N : 2 * N] == [1, 0]).all(axis=1).mean()
    wanted = model.code_chances(prior)[2]
    assert shares[1.0] == pytest.approx(wanted, abs=0.015)
    assert abs(shares[0.0] - wanted) > 0.05
    assert shares[0.25] == pytest.approx(0.75 * shares[0.0] + 0.25 * wanted, abs=0.015)


def test_filter_falls_back_when_nothing_explains_the_observation() -> None:
    model = small_ialm(5)
    belief = ParticleBelief(model, kernels.compile_model(model), 50, np.random.default_rng(0))
    prior = np.full((N, K), 1.0 / K)
    belief.reset(np.array([0, 0]), np.array([0, 0, 3]), prior)
    assert belief.update(0, np.array([1, 0]), np.array([2, -2, 1]), prior) == -np.inf
    assert belief.resets == 1
    assert (belief.states[:, 2 * N : 2 * N + 3] == [4, 0, 1]).all()
    assert (belief.states[:, :N] == [1, 0]).all()
    assert belief.pose_marginal().sum() == pytest.approx(1.0)
    assert np.allclose(belief.person_marginals().sum(axis=1), 1.0)


def test_the_filter_takes_no_arrays_that_do_not_fit() -> None:
    """An action that there is not ended in a segmentation fault."""
    model = small_ialm(5)
    belief = ParticleBelief(model, kernels.compile_model(model), 5, np.random.default_rng(0))
    code, pose, prior = np.array([0, 0]), np.array([0, 0, 3]), np.full((N, K), 1.0 / K)
    belief.reset(code, pose, prior)
    for arguments in (
        (9, code, pose, prior),
        (0, code + K, pose, prior),
        (0, code[:1], pose, prior),
        (0, code, np.array([0, 0, 4]), prior),
        (0, code, pose, prior[:, :1]),
        (0, code, pose, -prior),
    ):
        with pytest.raises(UserError):
            belief.update(*arguments)


def test_known_codes_are_preferred_by_how_well_they_fit() -> None:
    model = small_ialm(6)
    chances = model.code_chances(np.array([[1.0, 0.0], [0.0, 1.0]]))
    assert chances.sum() == pytest.approx(1.0)
    assert model.known_codes[chances.argmax()].tolist() == [0, 1]
    often = replace(model, person_counts=np.array([0.0, 0.0, 1.0, 8.0]))
    nothing = np.full((N, K), 1.0 / K)
    assert often.code_chances(nothing) == pytest.approx([0.025, 0.025, 0.125, 0.825])
    unmet = replace(model, person_counts=np.zeros(4))
    assert unmet.code_chances(nothing) == pytest.approx(model.code_chances(nothing))
    assert unmet.code_chances(nothing) == pytest.approx([0.25] * 4)


def test_saved_and_loaded(tmp_path: Path) -> None:
    model = small_ialm(7)
    model.save(tmp_path / "ialm")
    again = IALM.load(tmp_path / "ialm", model.dbn)
    for name in ialm.TABLES:
        assert np.array_equal(again.tables[name].moments, model.tables[name].moments)
        assert again.tables[name].names == model.tables[name].names
    assert np.array_equal(again.motion.coefficients, model.motion.coefficients)
    assert again.provenance == {"test": True}


def test_a_run_holds_models_of_several_variants(tmp_path: Path) -> None:
    run, first, second = RunFolder(tmp_path), small_ialm(7), small_ialm(8)
    first.dbn.save(run.dbn)
    for variant, model in (("paper", first), ("intent", second)):
        replace(model, dbn=first.dbn, provenance={"variant": variant}).save(ModelStore(run).folder(variant))
    for variant in ("paper", "intent"):
        assert ModelStore(run).local_model(variant).provenance == {"variant": variant}


def test_tables_of_another_version_are_refused(tmp_path: Path) -> None:
    """In version 2 `moved` was of `forward` alone, and would say of turns what it says of `forward`."""
    model = small_ialm(8)
    model.save(tmp_path / "ialm")
    path = tmp_path / "ialm" / "model.json"
    path.write_text(path.read_text().replace('"version": 3', '"version": 2'))
    with pytest.raises(UserError, match="version 2, this program has 3"):
        IALM.load(tmp_path / "ialm", model.dbn)


def test_damaged_files_are_named(tmp_path: Path) -> None:
    model = small_ialm(8)
    model.save(tmp_path / "ialm")
    (tmp_path / "ialm" / "tables.npz").write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(UserError, match=r"tables\.npz"):
        IALM.load(tmp_path / "ialm", model.dbn)
    (tmp_path / "ialm" / "tables.npz").unlink()
    with pytest.raises(UserError, match="no such file"):
        IALM.load(tmp_path / "ialm", model.dbn)
