"""Plans of the model in the real environment."""

import pytest

from nesy.asp.questions.validity import plan_validity
from nesy.errors import UserError
from tests.nesy.dbn.real import real_model


def test_plans_to_face_a_wall_work_in_the_environment():
    from domains.core import load_domain

    figures = plan_validity(real_model(), load_domain("person_following"), "wall_ahead", episodes=30, max_steps=4)
    assert figures["known"] >= 25
    assert figures["found"] + figures["exhausted"] == figures["known"]
    assert figures["found"] >= 20
    # turning towards a wall beside the viewer is certain; what lies beyond the view is not
    assert figures["valid"] >= 0.6 * figures["judged"]
    with pytest.raises(UserError, match="predicate"):
        plan_validity(real_model(), load_domain("person_following"), "dragon")
