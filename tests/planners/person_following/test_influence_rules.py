"""Rules about the person act on the influence, and on nothing else."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from domains.core import load_domain
from nesy.errors import UserError
from nesy.run_folder import RunFolder
from planners.comparison.compare import compare
from planners.config import CompareConfig, SearchConfig
from planners.person_following import ialm, kernels
from planners.person_following.beliefs import ParticleBelief
from planners.person_following.ialm import SCALARS
from planners.person_following.influence_rules import constrain_influence
from planners.search.random_bits import stream
from planners.shielding import ShieldMask
from tests.planners.person_following.models import N, small_ialm

WALL = "person_forbidden(forward) :- person_now(wall_ahead)."


class CellCodec:
    """Factor 0 says whether a wall is ahead, factor 1 whether the goal is in view."""

    num_factors, num_values = 2, 2

    def views(self, codes: np.ndarray) -> np.ndarray:
        views = np.zeros((len(codes), 5, 5), np.uint8)
        views[:, 2, 3] = codes[:, 0]
        views[:, 0, 0] = np.where(codes[:, 1] == 1, 2, 0)
        return views


def constrained(rules: str, seed: int = 0):
    model = small_ialm(seed)
    return model, *constrain_influence(model, [rules], CellCodec(), load_domain())


@pytest.mark.parametrize("seed", range(3))
def test_excluded_moves_get_no_probability_and_the_others_are_renormalised(seed: int) -> None:
    before, after, change = constrained(WALL + " person_forbidden(left) :- person_code(1,1), person_now(P).", seed)
    codes, old = before.known_codes, before.influence_of(before.known_codes)
    possible = np.ones((4, 3))
    possible[codes[:, 0] == 1, 2] = 0
    # of all predicates only wall_ahead is mentioned, so person_now(P) means that one
    possible[(codes[:, 1] == 1) & (codes[:, 0] == 1), 0] = 0
    expected = old * possible
    np.testing.assert_allclose(
        after.influence_of(codes), expected / expected.sum(axis=1, keepdims=True), rtol=0, atol=1e-15
    )
    assert change is not None and (change.codes, change.constrained, change.conflicts) == (4, 2, 0)
    assert change.removed == pytest.approx((old * (1 - possible)).sum(axis=1).mean())
    # a belief over the person's code mixes these rows
    belief = ParticleBelief(after, kernels.compile_model(after), 50, np.random.default_rng(seed))
    belief.reset(np.array([0, 1]), np.array([0, 0, 3]), np.full((2, 2), 0.5))
    mixed = after.influence_of(belief.states[:, N : 2 * N]).mean(axis=0)
    np.testing.assert_allclose(belief.influence(), mixed, atol=1e-12)


def test_kernels_keep_to_the_rules() -> None:
    before, after, _ = constrained(WALL)
    moves = {}
    for name, model in (("before", before), ("after", after)):
        compiled = kernels.compile_model(model)
        state = np.array([0, 0, 1, 0, 2, 2, 3, 0, 0], np.int16)  # the person's code is (1, 0): a wall ahead
        then, v, bits = np.zeros_like(state), np.zeros(3 * N + len(SCALARS), np.int16), stream(np.random.default_rng(0))
        seen = np.zeros(4, int)
        for _ in range(2000):
            kernels.step(compiled, state, 3, then, v, bits)
            seen[v[3 * N + ialm.PERSON]] += 1
        moves[name] = seen
    assert moves["before"][2] > 100 and moves["after"][2] == 0
    assert moves["after"][:2].min() > 0


def test_rules_about_the_robot_leave_the_influence_alone_and_the_other_way_round() -> None:
    before, after, change = constrained("forbidden(forward) :- now(wall_ahead).")
    assert after is before and change is None
    mask = ShieldMask([WALL], CellCodec(), load_domain())
    assert mask(np.array([[1, 1]], np.uint8), np.zeros(1, np.int64)).all()


def test_rules_that_exclude_every_move_are_not_followed_there_and_counted() -> None:
    before, after, change = constrained(
        "person_forbidden(A) :- action(A), A != stay, person_now(wall_ahead). person_forbidden(left)."
    )
    assert change is not None and (change.conflicts, change.constrained) == (2, 2)
    wall = before.known_codes[:, 0] == 1
    np.testing.assert_allclose(
        after.influence_of(before.known_codes)[wall], before.influence_of(before.known_codes)[wall]
    )
    assert (after.influence_of(before.known_codes)[~wall][:, 0] == 0).all()


def test_mistakes_are_named() -> None:
    with pytest.raises(UserError, match=r"program:1:29: U\+00A0 NO-BREAK SPACE"):
        constrained("person_forbidden(forward) :-\u00a0person_now(wall_ahead).")
    with pytest.raises(UserError, match="program:1:18: 2147483648 is too large"):
        constrained("person_forbidden(2147483648) :- person_now(wall_ahead).")
    with pytest.raises(UserError, match="its moves are left, right, forward"):
        constrained("person_forbidden(stay) :- person_now(wall_ahead).")
    with pytest.raises(UserError, match="syntax error"):
        constrained("person_forbidden(forward) :- person_now(wall_ahead)")


def test_compare_takes_them_and_says_what_they_changed(tiny_run: Path, tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    for part in ("world_model", "dbn", "ialm", "experience"):
        shutil.copytree(tiny_run / part, run.path / part)
    rules = tmp_path / "person.lp"
    rules.write_text(WALL)
    config = CompareConfig(
        agents=("search",), influences=("perspective-shift",), planner_episodes=1, rules=(str(rules),),
        search=SearchConfig(simulations=4, particles=8),
    )  # fmt: skip
    compare(run, config)
    said = json.loads((run.results / "influence_rules.json").read_text())
    assert said["paper"]["constrained"] > 0 and 0 <= said["paper"]["removed"] <= said["paper"]["most"] <= 1
    rules.write_text("forbidden(left) :- now(wall_ahead).")
    compare(run, config)
    assert json.loads((run.results / "influence_rules.json").read_text()) == {"paper": None}
