"""Named factors: their values are the answers to questions, and the search's counts stay exact."""

import numpy as np
import pytest

from nesy.world_model.codes.code_search import CodeSearch
from nesy.world_model.codes.counting import count, edges_of, families_of, logs_up_to
from nesy.world_model.codes.questions import GroupSearch, Questions
from nesy.world_model.codes.refinement import Refiner
from nesy.world_model.codes.telling import telling_cost
from nesy.world_model.distinct import transitions_of
from nesy.world_model.structure import Limits
from tests.nesy.conftest import toy_experience


@pytest.fixture(scope="module")
def refiner() -> Refiner:
    return Refiner(
        transitions_of(toy_experience(), weighting="maps"), 8, 4, Limits(now=3, next=2, total=4, penalty=1.0)
    )


def test_questions_that_agree_are_asked_once() -> None:
    truth = np.array([[1, 1, 0, 1, 0], [0, 0, 1, 1, 0], [1, 1, 0, 1, 1]], dtype=bool)
    names = ("cell_wall", "wall", "other", "always", "cell_goal")
    assert Questions.of(names, truth).names == ("wall", "other", "cell_goal")
    assert Questions.of(names, truth, ("cell_wall",)).names == ("cell_wall", "other", "cell_goal")


def test_a_group_makes_values_only_if_its_answers_take_few_forms() -> None:
    answers = np.array([[a, b, c, a & b] for a in (0, 1) for b in (0, 1) for c in (0, 1)])
    questions = Questions(("a", "b", "c", "both"), answers)
    values = questions.values(np.array([0, 1, 3, -1]), 4)
    assert values is not None and len(np.unique(values)) == 4
    meanings = questions.meanings(np.array([0, 1, 3, -1]), values)
    assert meanings["questions"] == ["a", "b", "both"]
    for view in range(8):
        assert meanings["answers"][str(values[view])] == [bool(answers[view, q]) for q in (0, 1, 3)]
    assert questions.values(np.array([0, 1, 2, -1]), 4) is None


def test_named_factors_answer_their_questions_and_codes_are_distinct(refiner: Refiner) -> None:
    questions = Questions.about_cells(refiner.transitions.views)
    wanted = (questions.names[3], questions.names[5], "no_such_question")
    found = []
    for _ in range(2):
        rng = np.random.default_rng(3)
        search = CodeSearch(refiner, questions, 8, 5, wanted)
        search.start(rng)
        found.append(search.search(3, 5, rng))
    np.testing.assert_array_equal(found[0].codes, found[1].codes)
    codes = found[0].codes
    assert len(np.unique(codes, axis=0)) == len(codes)
    meanings = search.meanings()
    assert list(meanings) == ["3", "4", "5", "6", "7"]
    assert meanings["3"]["questions"][:2] == list(wanted[:2])
    for factor, meaning in meanings.items():
        for column, name in enumerate(meaning["questions"]):
            said = [meaning["answers"][str(value)][column] for value in codes[:, int(factor)]]
            np.testing.assert_array_equal(said, questions.answers[:, questions.names.index(name)])


def test_annealing_ends_where_counting_anew_ends(refiner: Refiner) -> None:
    questions = Questions.about_cells(refiner.transitions.views)
    rng = np.random.default_rng(0)
    groups = GroupSearch(questions, refiner, {}, 0.005)
    asked, book = groups.start(8, rng)
    best = np.inf
    for temperature in (0.1, 0.01, 0.0):
        asked, book, _ = groups.improve(asked, book, list(range(8)), 100, temperature, 1.0, rng)
        for i in range(8):
            values = questions.values(asked[i], 8)
            assert values is not None
            pairs = np.unique(np.stack([values, book.codes[:, i]], axis=1), axis=0)
            assert len(pairs) == len(np.unique(values)) == len(np.unique(book.codes[:, i]))
        best = min(best, book.nll)
    families, logs = families_of(book.structure), logs_up_to(int(refiner.transitions.weight.sum()))
    counts = count(book.codes, edges_of(refiner.transitions), families, 8, logs)
    cells, rows = counts.cells.astype(float), counts.rows.astype(float)
    entropy = (rows * np.log(np.maximum(rows, 1))).sum() - (cells * np.log(np.maximum(cells, 1))).sum()
    assert book.nll == pytest.approx(entropy / refiner.transitions.weight.sum())


def test_telling_cost_by_hand() -> None:
    answers = np.array([[1, 0], [1, 1], [0, 0], [0, 1]])
    codes = np.array([[0, 0], [0, 0], [1, 0], [1, 0]])
    cost = telling_cost(answers, codes, [0], 2)
    assert not cost[:, 1].any()
    # Factor 0 tells question 0; of question 1 neither says anything, and the first factor has it.
    assert cost[0, 0, 0] < cost[0, 0, 1]
    assert cost[2, 0, 1] < cost[2, 0, 0]
    sure, even = -np.log(2.05 / 2.1), -np.log(1.05 / 2.1)
    assert cost[0, 0, 0] == pytest.approx(sure + even)
