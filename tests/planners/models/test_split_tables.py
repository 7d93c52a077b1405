from __future__ import annotations

import numpy as np
import pytest

from planners.models.split_tables import learn_by
from planners.models.tables import Parents, learn_distribution, locate, pack

PARENTS = Parents(("a", "b"), (1, 2), (False, True))


def _steps() -> tuple[np.ndarray, np.ndarray]:
    """Variables (action, a, b) and what followed: a success where a is 1, b at least 3 and the action 2."""
    variables = np.random.default_rng(0).integers(0, 5, (4000, 3)).astype(np.int32)
    variables[:, 0] %= 3
    return variables, ((variables[:, 0] == 2) & (variables[:, 1] == 1) & (variables[:, 2] >= 3)).astype(np.int64)


def test_agrees_with_what_it_was_learned_from_and_keeps_counts() -> None:
    variables, target = _steps()
    table = learn_by(0, "action", variables, PARENTS, target, 2)
    assert (table.estimates()[table.locate(variables)].argmax(axis=1) == target).all()
    assert table.parents() == ("action", "a", "b")
    assert table.moments[table.slot < 0].sum() == table.moments[0].sum() == len(variables)
    packed = pack([table, table])
    for row in variables[:50]:
        here = table.locate(row[None])[0]
        assert locate(packed, 0, row) == here
        assert locate(packed, 1, row) == here + len(table.slot)


def test_what_was_never_done_somewhere_is_not_taken_for_what_was() -> None:
    variables, target = _steps()
    logged = (variables[:, 1] != 1) | (variables[:, 0] == 2)  # where a is 1, only action 2 was ever taken
    asked = np.array([[0, 1, 4], [1, 1, 4], [2, 1, 4]], np.int32)
    everything = Parents(("action", "a", "b"), (0, 1, 2), (False, False, True))
    fooled = learn_distribution(variables[logged], everything, target[logged], 2)
    assert fooled.estimates()[fooled.locate(asked), 1].min() > 0.9
    apart = learn_by(0, "action", variables[logged], PARENTS, target[logged], 2)
    assert apart.estimates()[apart.locate(asked), 1] == pytest.approx([0.0, 0.0, 1.0], abs=0.02)


def test_one_value_alone_asks_nothing_first() -> None:
    variables, target = _steps()
    variables[:, 0] = 0
    table = learn_by(0, "action", variables, PARENTS, target, 2)
    assert "action" not in table.parents()
