"""The fidelity report on an extracted model, its picture and its section, and what `nesy show` prints."""

import numpy as np
import pytest

from nesy.dbn.evaluation.fidelity import held_out, network_nll
from nesy.dbn.evaluation.recovery import Recovery
from nesy.dbn.evaluation.validity import commonest_successors, likeliest_successors, shortest_plan
from nesy.dbn.reading.fidelity_drawing import draw_fidelity
from nesy.dbn.reading.thumbnails import thumbnails
from nesy.errors import UserError
from tests.nesy.dbn.toy import Network, experience, toy

REPORT = {
    "held_out": {
        "transitions": 10.0,
        "table": 0.8,
        "network": 0.8,
        "limit": 0.5,
        "impossible": 0.0,
        "row_tv": 0.1,
        "row_kl": 0.1,
    },
    "rollouts": {
        "steps": [1, 2],
        "joint_low": [0.2, 0.5],
        "joint_high": [0.2, 0.6],
        "marginal_low": [0.0, 0.1],
        "marginal_high": [0.0, 0.1],
        "left_out": [0.0, 0.01],
    },
    "plans": {"asked": 3, "model": {"found": 0.7, "valid": 0.6, "exhausted": 0.3, "length": 2.0}},
    "impossible": {"states": 0.01, "transitions": 0.02, "likeliest": 0.0},
    "structure": {"models": 2, "precision": 1.0, "recall": 1.0},
}


def test_table_and_network_are_scored_alike_and_above_the_limit():
    dbn, taken = toy()[0], experience()
    figures = held_out(dbn, Network(), taken)
    assert figures["table"] == figures["network"] == figures["limit"] == 0
    half = np.full((16, 3, 3), 1 / 3)
    assert network_nll(lambda codes, action: half[: len(codes)], *taken.distinct()) == pytest.approx(3 * np.log(3))


def test_plans_follow_the_likeliest_outcomes():
    dbn, codebook = toy()
    known = np.unique(codebook.codes, axis=0)
    successors = likeliest_successors(dbn, known)
    place = {tuple(code): i for i, code in enumerate(known.tolist())}
    # the wall in front goes to the side (swap), and from the side away (go, the front being free)
    assert shortest_plan(successors, place[1, 0, 0], place[0, 0, 0]) == [0, 1]
    assert shortest_plan(successors, place[0, 0, 0], place[1, 0, 0]) is None
    assert shortest_plan(successors, 2, 2) == []


def test_the_commonest_next_view():
    now, action, later = np.array([0, 0, 0, 1]), np.array([1, 1, 1, 0]), np.array([1, 2, 2, 0])
    assert commonest_successors(now, action, later, 3, 2).tolist() == [[-1, 2], [0, -1], [-1, -1]]


def test_successors_outside_the_known_codes_are_marked():
    dbn, _ = toy()
    known = np.array([[1, 0, 0], [0, 0, 0]], dtype=np.uint8)
    assert likeliest_successors(dbn, known).tolist() == [[-1, 0], [1, 1]]


def test_the_report_is_drawn(tmp_path):
    draw_fidelity(REPORT, tmp_path / "f.svg")
    text = (tmp_path / "f.svg").read_text()
    assert text.count("<path") > 20
    draw_fidelity({**REPORT, "impossible": {}}, tmp_path / "f.png")
    with pytest.raises(UserError, match=r"\.png or \.svg"):
        draw_fidelity(REPORT, tmp_path / "f.pdf")


def test_the_section_of_the_report(tmp_path):
    from nesy.report.sections import fidelity
    from nesy.run_folder import RunFolder

    dbn = {"max_difference_to_network": 0.0, "row_tv": 0.01, "row_kl": 0.02}
    page = fidelity.make(RunFolder(tmp_path), {"dbn": {**dbn, "fidelity": REPORT}})
    assert "0.500 to 0.600" in page and "<svg" in page
    assert "nesy extract" in fidelity.make(RunFolder(tmp_path), {"dbn": dbn})


def test_thumbnails_show_walls_goal_and_viewer():
    dbn, codebook = toy()
    text = thumbnails(dbn, codebook, 0)
    rows = text.splitlines()
    # front = 0 and front = 1, four views each; the wall in front is drawn for the second
    assert rows[1].split() == ["=", "0", "=", "1", "=", "2"] and rows[2].startswith("4 views")
    width = rows[1].index("= 1")
    assert rows[4][width : width + 4] == "  ██" and rows[4][:width].strip() == ""
    assert "gg" in rows[3] and rows[5].count("^^") == 2 and "none" in rows[3]


def test_shares_of_arcs():
    found = Recovery(right=3, found=4, true=6)
    assert found.precision == 0.75 and found.recall == 0.5


def test_values_of_named_factors_are_said_by_their_answers():
    from nesy.dbn.codebook import named_meanings

    found = (("a", "not met"), ("b", "c"))
    named = {"named": {"0": {"questions": ["wall", "goal"], "answers": {"0": [True, False], "1": [True, True]}}}}
    assert named_meanings(found, named) == (("wall, not goal", "not met"), ("b", "c"))
    assert named_meanings(found, {}) == found
    for damaged in ({"9": named["named"]["0"]}, {"0": {"questions": ["x"], "answers": {"0": [True, False]}}}, {"0": 3}):
        with pytest.raises(UserError, match=r"readability\.json"):
            named_meanings(found, {"named": damaged})
