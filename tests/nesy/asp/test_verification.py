"""Every yes and no of the verification, against enumeration of all codes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nesy.asp.verification import verify
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from tests.nesy.dbn.models import all_codes, random_dbn, transition_matrix
from tests.nesy.dbn.toy import toy


def literal(rng, names, values, conclusion):
    if conclusion and rng.random() < 0.15:
        return "same"
    relation = "!=" if rng.random() < 0.5 else "="
    return f"{names[rng.integers(len(names))]}{relation}{rng.integers(values)}"


def holds(text, code, before, names):
    for part in filter(None, text.split(",")):
        if part == "same":
            if not (code == before).all():
                return False
            continue
        name, value = part.split("!=") if "!=" in part else part.split("=")
        if (code[names.index(name)] == int(value)) == ("!=" in part):
            return False
    return True


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_verdicts_are_those_of_enumeration(seed):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng, num_factors=3, num_values=3, zeros=True, max_parents=int(rng.integers(1, 4)))
    names = list(dbn.factor_names)
    premise = ",".join(literal(rng, names, 3, False) for _ in range(rng.integers(0, 3)))
    conclusion = ",".join(literal(rng, names, 3, True) for _ in range(rng.integers(1, 3)))
    action = int(rng.integers(2))
    verdict = verify(dbn, None, action, premise, conclusion)
    codes, matrix = all_codes(dbn), transition_matrix(dbn, action)
    breaks = [
        (tuple(codes[x]), tuple(codes[y]))
        for x, y in zip(*np.nonzero(matrix), strict=True)
        if holds(premise, codes[x], None, names) and not holds(conclusion, codes[y], codes[x], names)
    ]
    assert verdict.holds == (not breaks)
    assert verdict.dropped == 0
    if breaks:
        # factors of slice t+1 that do not matter are -1 in the counterexample
        first, later = verdict.code, verdict.next_code
        assert any(a == first and all(v in (-1, w) for v, w in zip(later, b, strict=True)) for a, b in breaks)


def test_predicates_are_read_off_the_codes():
    dbn, codebook = toy()
    # swapping front and side: a wall ahead stays only if there is one at the side
    verdict = verify(dbn, codebook, 0, "wall_ahead", "wall_ahead", codes="met")
    assert not verdict.holds
    assert verdict.code[0] == 1 and verdict.next_code[0] != 1
    assert verify(dbn, codebook, 0, "wall_ahead, side=1", "wall_ahead", codes="met").holds
    assert verify(dbn, codebook, 1, "wall_ahead", "same", codes="met").holds
    assert not verify(dbn, codebook, 1, "not wall_ahead", "same", codes="met").holds
    assert verify(dbn, codebook, 1, "", "not all_free").holds is False


def test_improbable_values_are_dropped_and_the_mass_is_stated():
    table = np.array([[0.9999, 0.0001], [0.0, 1.0]])
    dbn = TwoSliceDBN.from_tables([[table]], [[[0]]])
    verdict = verify(dbn, None, 0, "X0=0", "X0=0")
    assert verdict.holds and verdict.dropped == pytest.approx(1e-4)
    assert not verify(dbn, None, 0, "X0=0", "X0=0", least=1e-6).holds


@pytest.mark.parametrize("text", ["X9=0", "X0=7", "dragon", "X0<3", "X0=", "same", "not X0=1"])
def test_wrong_conditions_are_explained(text):
    dbn = random_dbn(np.random.default_rng(0))
    with pytest.raises(UserError):
        verify(dbn, None, 0, text, "X0=1")
    with pytest.raises(UserError, match="conclusion"):
        verify(dbn, None, 0, "X0=1", "")
