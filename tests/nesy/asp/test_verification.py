"""Every yes and no of the verification, against enumeration of all codes."""

from types import MappingProxyType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nesy.asp.questions.verification import verify
from nesy.dbn.codebook import Codebook
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
    with pytest.MonkeyPatch.context() as patch:
        if seed % 2:
            patch.setattr("nesy.asp.questions.verification.try_steps", lambda *arguments: None)
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
        assert (verdict.code, verdict.next_code) in breaks


class Properties:
    """Two predicates of a view of three cells, as a vocabulary."""

    names = ("high", "equal")
    meanings = MappingProxyType({"high": "the first cell is at least 2", "equal": "the first two cells are equal"})

    def evaluate(self, views):
        cells = views[:, 0]
        return np.stack([cells[:, 0] >= 2, cells[:, 0] == cells[:, 1]], axis=1)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["all", "met"]), st.booleans())
def test_verdicts_about_predicates_are_those_of_enumeration(seed, over, without_tries):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng, num_factors=3, num_values=3, zeros=True, max_parents=int(rng.integers(1, 4)))
    codes, matrix = all_codes(dbn), transition_matrix(dbn, 0)
    met = codes[rng.random(27) < 0.6] if rng.random() < 0.9 else codes[:1]
    met = met if len(met) else codes[:1]
    book = Codebook.build(met[:, None].astype(np.uint8), met.astype(np.uint8), np.ones(len(met)), Properties())

    def some(conclusion):
        names = ["high", "not high", "equal", "not equal", "X2=1", "X1!=0", *(["same"] if conclusion else [])]
        return [names[j] for j in rng.choice(len(names), size=rng.integers(conclusion, 3), replace=False)]

    premise, conclusion = some(False), some(True)
    with pytest.MonkeyPatch.context() as patch:
        if without_tries:
            patch.setattr("nesy.asp.questions.verification.try_steps", lambda *arguments: None)
        verdict = verify(dbn, book, 0, ", ".join(premise), ", ".join(conclusion), codes=over)
    rules = {found.target: found for found in verdict.rules}

    def truth(part, code, before):
        name = part.removeprefix("not ")
        if name in rules:
            return bool(rules[name].applies(code[None])[0]) != part.startswith("not ")
        return holds(part, code, before, list(dbn.factor_names))

    starts = {tuple(code) for code in (met if over == "met" else codes)}
    breaks = {
        (tuple(codes[x]), tuple(codes[y]))
        for x, y in zip(*np.nonzero(matrix), strict=True)
        if tuple(codes[x]) in starts
        and all(truth(part, codes[x], None) for part in premise)
        and not all(truth(part, codes[y], codes[x]) for part in conclusion)
    }
    assert verdict.holds == (not breaks)
    assert verdict.holds or (verdict.code, verdict.next_code) in breaks


def test_a_proof_may_need_what_two_factors_have_in_common():
    # X1' and X2' have the parity of X0; X3' is 3 only where their parities differ
    parity = np.arange(4) % 2
    copy = (parity[:, None] == parity) / 2.0
    differ = parity[:, None] != parity
    last = np.where(differ[..., None], np.eye(4)[3], np.eye(4)[0]).reshape(16, 4)
    dbn = TwoSliceDBN.from_tables([[np.eye(4), copy, copy, last]], [[[0], [0], [0], []]], [[[], [], [], [1, 2]]])
    assert verify(dbn, None, 0, "", "X3!=3").holds
    assert verify(dbn, None, 0, "X0=1", "X3=0, X1!=2, X2!=0").holds
    assert not verify(dbn, None, 0, "X0=1", "X1=1").holds


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


def test_codes_met_are_known_without_a_codebook_too():
    dbn, codebook = toy()
    assert "codes" in dbn.tables
    for premise, conclusion in (("front=1", "same"), ("front=0", "same"), ("", "goal!=2")):
        plain = [verify(dbn, book, 1, premise, conclusion, codes="met") for book in (None, codebook)]
        assert plain[0].holds == plain[1].holds and plain[0].code == plain[1].code
    without = TwoSliceDBN.from_tables([[np.eye(2)]], [[[0]]])
    with pytest.raises(UserError, match="no table of the codes met"):
        verify(without, None, 0, "", "same", codes="met")
