"""docs/asp.md: every question in it is asked, every program run, on a model of the real domain."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from nesy.asp import VOCABULARY, KnowledgeBase
from nesy.cli import configuration
from nesy.errors import UserError
from tests.nesy.dbn.real import real_model
from tests.nesy.dbn.toy import toy

ROOT = Path(__file__).resolve().parents[3]
TEXT = (ROOT / "docs" / "asp.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(python|lp)\n(.*?)```", TEXT, re.DOTALL)


@pytest.fixture(scope="module")
def base():
    return real_model()


def test_the_ten_questions_and_everything_else(base, capsys, tmp_path):
    folder = tmp_path / "a run"
    base.dbn.save(folder / "dbn")
    base.codebook.save(folder / "dbn")
    configuration.save(configuration.PRESETS["smoke"], folder / "config.json", {})
    script = runpy.run_path(str(ROOT / "scripts" / "worked_questions.py"))
    count = script["work_through"](folder)
    text = capsys.readouterr().out
    assert count == 29
    assert "wall_ahead holds in" in text and "'forward' changes" in text
    assert "# left out, needs compare: nesy query --run runs/demo --why" in text
    assert len(re.findall(r"^\*\*\d+\. ", TEXT, re.MULTILINE)) == 10


@pytest.mark.parametrize("number", range(sum(language == "lp" for language, _ in BLOCKS)))
def test_programs(base, number):
    program = [block for language, block in BLOCKS if language == "lp"][number]
    answer = base.query(program)
    assert answer.satisfiable and answer.models[0]
    assert not answer.notes


def test_the_vocabulary_is_complete():
    for fact, meaning in VOCABULARY.items():
        assert f"| `{fact}` | {meaning} |" in TEXT


def test_a_wall_ahead_is_recovered_from_the_codes(base):
    finding = base.rules("wall_ahead", held_out=0.25)
    assert finding.rows[0]["accuracy"] == finding.rows[0]["precision"] == finding.rows[0]["recall"] == 1
    assert "X0 in {2, 3}" in finding.text


def test_impossible_entries_are_removed_and_reported():
    base = KnowledgeBase(*toy())
    rules = "impossible(swap,0,(1,),2). impossible(go,1,X,0) :- row(go,1,X,0,W), X = (1,0)."
    with pytest.raises(UserError, match="row side = 1, front = 0 of side under go"):
        base.constrained([rules])
    model, report = base.constrained(["impossible(swap,0,(1,),2)."])
    assert (report.entries, report.rows, report.largest) == (1, 1, 0.0)
    np.testing.assert_array_equal(model.probabilities, base.dbn.probabilities)
    for wrong in ("impossible(fly,0,(1,),2).", "impossible(swap,0,(1,1),2).", "impossible(swap,0,(1,),9)."):
        with pytest.raises(UserError, match="impossible"):
            base.constrained([wrong])


def test_rows_are_renormalised_when_entries_go(base):
    model, report = base.constrained(["impossible(A,F,X,V) :- row(A,F,X,V,W), W < 300000."])
    assert report.entries > 0 and 0 < report.largest < 0.9 and 0 < report.visits <= 1
    np.testing.assert_allclose(model.probabilities.sum(axis=1), 1)
    assert ((base.dbn.probabilities > 0) & (model.probabilities == 0)).sum() == report.entries
