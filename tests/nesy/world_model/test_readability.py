import numpy as np
import pytest

from nesy.world_model.codes.readability import readability


def test_fewest_factors_and_information_by_hand() -> None:
    codes = np.array([[a, b, c] for a in range(4) for b in range(4) for c in range(2)])
    truth = np.stack(
        [
            codes[:, 0] == 2,  # one factor
            (codes[:, 1] >= 2) ^ (codes[:, 2] == 1),  # two factors, neither alone
            np.ones(len(codes), bool),  # constant: left out
            codes[:, 2] == 1,  # is a factor
        ],
        axis=1,
    )
    found = readability(codes, truth, ("is_two", "either", "always", "same"), num_values=4)
    predicates = found["predicates"]
    assert set(predicates) == {"is_two", "either", "same"}
    assert predicates["is_two"]["factors"] == [0]
    assert predicates["either"]["factors"] == [1, 2]
    assert predicates["either"]["information"] == pytest.approx(0.0, abs=1e-9)
    assert predicates["same"]["information"] == pytest.approx(1.0)
    entropy = -(0.25 * np.log(0.25) + 0.75 * np.log(0.75))
    assert predicates["is_two"]["information"] == pytest.approx(2 * entropy / (entropy + np.log(4)))
    assert found["mean_factors"] == pytest.approx(4 / 3)
    assert found["single"] == pytest.approx(2 / 3)


def test_a_predicate_that_no_factors_decide_needs_all() -> None:
    codes = np.zeros((4, 3), dtype=int)
    truth = np.array([[True], [False], [True], [False]])
    assert readability(codes, truth, ("noise",))["predicates"]["noise"]["factors"] == [0, 1, 2]
