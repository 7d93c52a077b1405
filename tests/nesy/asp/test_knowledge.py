"""Questions to the knowledge base, on a toy world whose answers are known."""

import subprocess
import sys

import numpy as np
import pytest

from nesy.asp import KnowledgeBase
from nesy.asp.program.facts import Facts
from nesy.asp.semantics.meaning import meaning_of
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from tests.nesy.dbn.toy import toy


@pytest.fixture(scope="module")
def base():
    return KnowledgeBase(*toy())


def test_meaning_of_a_value(base):
    finding = base.means("front", 1)
    relations = {row["predicate"]: row["relation"] for row in finding.rows}
    assert relations == {"wall_ahead": "means", "all_free": "excludes", "goal_visible": "mixed"}
    wall = next(row for row in finding.rows if row["predicate"] == "wall_ahead")
    assert (wall["views"], wall["of"], wall["of_all_views"]) == (4, 4, 0.5)
    assert "wall_ahead holds" in finding.text


def test_meaning_of_a_value_never_met(base):
    finding = base.means(0, 2)
    assert finding.rows == ()
    assert "no view" in finding.text


def test_influenced_factors(base):
    rows = {row["factor"]: row for row in base.influenced("swap").rows}
    # of the 8 views, those in which front and side differ
    assert (rows["front"]["changed"], rows["front"]["of"]) == (4, 8)
    assert rows["front"]["parents"] == ["side"]
    assert rows["goal"]["changed"] == 0
    assert "never changed: goal" in base.influenced("swap").text
    assert {row["factor"]: row["changed"] for row in base.influenced("go").rows} == {"side": 2, "front": 0, "goal": 0}


def test_values_that_imply_a_predicate(base):
    rows = base.implies("wall_ahead").rows
    single = [row for row in rows if len(row["values"]) == 1]
    assert [row["values"] for row in single] == [[{"factor": "front", "value": 1}]]
    assert single[0]["covers"] == 1.0


def test_pairs_that_imply_a_predicate_only_together(base):
    # all_free needs front = side = goal = 0: no pair decides it
    assert base.implies("all_free").rows == ()
    assert "No value and no pair" in base.implies("all_free").text


def test_wrong_names_are_explained(base):
    for question in (lambda: base.means(7, 0), lambda: base.means("front", 3), lambda: base.influenced("fly")):
        with pytest.raises(UserError):
            question()
    with pytest.raises(UserError, match="wall_ahead"):
        base.implies("sees_dragon")


def test_any_program_of_the_user(base):
    answer = base.query("ahead(I) :- holds(I,wall_ahead), code(I,1,0). #show ahead/1.")
    assert answer.satisfiable and answer.exhausted
    assert answer.models == (("ahead(1)", "ahead(5)"),) or len(answer.models[0]) == 2
    assert answer.dropped == 0


def test_facts_are_hidden_unless_shown(base):
    answer = base.query("moved(A) :- action(A), taken(A,C), C > 7.")
    assert answer.models == (("moved(go)", "moved(swap)"),)


def test_rows_join_with_parents(base):
    program = """
      next(A,F,V) :- arity(A,F,1), parent(A,F,1,P,0), at(P,X), row(A,F,(X,),V,W), scale(W).
      at(0,0). at(1,1). at(2,1).
      #show next/3.
    """
    (model,) = base.query(program).models
    assert "next(swap,0,1)" in model and "next(swap,1,0)" in model and "next(go,0,0)" in model


def test_several_models_and_unsatisfiable_programs(base):
    answer = base.query("1 { pick(V) : value(V) } 1.", models=0)
    assert sorted(model[0] for model in answer.models) == ["pick(0)", "pick(1)", "pick(2)"]
    assert answer.exhausted
    assert base.query("1 { pick(V) : value(V) } 1.", models=2).exhausted is False
    nothing = base.query(":- action(A).")
    assert nothing.satisfiable is False and nothing.models == ()


def test_optimisation_returns_the_proven_optimum(base):
    answer = base.query("1 { pick(V) : value(V) } 1. #maximize { V : pick(V) }.")
    assert answer.models == (("pick(2)",),) and answer.costs == ((-2,),) and answer.optimal


def test_a_query_needs_neither_torch_nor_numba_nor_sklearn(base, tmp_path):
    for part in toy():
        part.save(tmp_path)
    script = (
        "import sys; from nesy.asp import KnowledgeBase; "
        f"base = KnowledgeBase.from_folder({str(tmp_path)!r}); base.means(0, 1); base.influenced(0); "
        "base.implies('wall_ahead'); base.query('a.'); "
        "print([m for m in ('torch', 'numba', 'sklearn', 'matplotlib', 'scipy', 'networkx') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stderr


def test_a_run_without_extraction_says_which_step_is_missing(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(UserError, match="nesy extract"):
        KnowledgeBase.from_run(tmp_path)


@pytest.mark.parametrize("kinds", [2, 4, 6, 80])
def test_pictures_of_any_number_of_kinds(base, kinds):
    from nesy.asp.semantics.meaning import mean_view

    names = tuple(f"kind{number}" for number in range(kinds))
    views = np.arange(3 * kinds, dtype=np.uint8).reshape(-1, 3, 1) % kinds
    book = Codebook(
        views=views,
        codes=np.arange(len(views), dtype=np.uint8)[:, None] % 3,
        counts=np.ones(len(views), np.int64),
        predicates=views[:, 0] > 0,
        predicate_names=("some",),
        predicate_meanings=("",),
        cell_kinds=names,
    )
    picture, legend = mean_view(book, 0, 1).rsplit("\n", 1)
    assert len(picture.split("\n")) == 1 and legend.count("kind") == kinds
    symbols = [entry.split()[0].strip("(") for entry in legend.split("; ?")[0].split(", ")]
    assert len(set(symbols)) == kinds


def test_meanings_compare_shares_exactly_in_large_codebooks():
    """Products of counts of more than 46,340 views are beyond 32 bits, in which clingo counts."""
    n = 60_000
    codes = (np.arange(n) < n - 10).astype(np.uint8)[:, None]
    truth = np.arange(n)[:, None] < n - 5
    book = Codebook(
        views=np.zeros((n, 1, 1), np.uint8),
        codes=codes,
        counts=np.ones(n, np.int64),
        predicates=np.column_stack([truth, ~truth]),
        predicate_names=("most", "few"),
        predicate_meanings=("", ""),
    )
    dbn = TwoSliceDBN.from_tables([[np.eye(2)]], [[[0]]])
    rows = meaning_of(Facts(dbn, book), book, 0, 1, 0.95)[1]
    assert {row["predicate"]: row["relation"] for row in rows} == {"most": "means", "few": "excludes"}


@pytest.mark.parametrize("column", ["views", "codes", "counts"])
@pytest.mark.parametrize("wrong", [0.5, -1.0, 2.0**70, np.nan])
def test_codebooks_hold_whole_numbers(column, wrong):
    columns = {"views": np.zeros((2, 1, 1)), "codes": np.zeros((2, 3)), "counts": np.ones(2)}
    assert len(Codebook.build(**columns, vocabulary=None)) == 2
    columns[column].flat[0] = wrong
    with pytest.raises(UserError, match=f"{column} of a codebook are whole numbers"):
        Codebook.build(**columns, vocabulary=None)
