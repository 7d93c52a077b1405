"""Images of steps under symmetries: only what a world declares, each image once."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from domains.core import Symmetry, load_domain, symmetries_of
from nesy.errors import UserError
from nesy.world_model.distinct import Transitions, from_edges, reference_transitions, transitions_of, view_keys
from nesy.world_model.images import with_images
from tests.nesy.conftest import SYMMETRIES

TURN = Symmetry("quarter turn", (1, 2, 3, 0), lambda views: np.rot90(views, axes=(1, 2)))
MIRROR = Symmetry("mirror", (0, 3, 2, 1), lambda views: views[:, ::-1])


def edges_of(t: Transitions) -> dict[tuple[bytes, int, bytes], int]:
    views = [view.tobytes() for view in t.views]
    edges = zip(t.source, t.action, t.target, t.weight, strict=True)
    return {(views[s], int(a), views[then]): int(w) for s, a, then, w in edges}


def test_mirror_images_are_added_once(toy) -> None:  # type: ignore[no-untyped-def]
    plain = transitions_of(toy)
    both = with_images(plain, SYMMETRIES)
    assert both.weight.sum() == 2 * plain.weight.sum()
    keys, mirrored = view_keys(both.views), view_keys(both.views[:, ::-1])
    edges = {
        (int(keys[s]), int(a), int(keys[t])) for s, a, t in zip(both.source, both.action, both.target, strict=True)
    }
    swap = [1, 0, 2, 3]
    assert edges == {
        (int(mirrored[s]), swap[a], int(mirrored[t]))
        for s, a, t in zip(both.source, both.action, both.target, strict=True)
    }
    assert len(with_images(both, SYMMETRIES)) == len(both)


@given(st.lists(st.sampled_from([TURN, MIRROR]), max_size=2, unique_by=id), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_images_are_those_of_a_plain_search(symmetries: list[Symmetry], seed: int) -> None:
    """Against images made step by step with dictionaries, until there are no new ones."""
    rng = np.random.default_rng(seed)
    views = rng.integers(0, 4, (4, 3, 3)).astype(np.uint8)
    views = views[np.argsort(view_keys(views))]
    number, edges = len(views), np.unique(rng.integers(0, 4 * 4 * 4, 6))
    t = from_edges(views, np.ones(number), edges, rng.integers(1, 5, len(edges)), 4)
    found = with_images(t, symmetries)
    expected: dict[tuple[bytes, int, bytes], int] = {}
    # the group: every composition of the symmetries, told apart by what it does to a view without any symmetry
    probe = np.arange(9).reshape(1, 3, 3)
    group, fresh = {}, [()]
    while fresh:
        word = fresh.pop()
        image, actions = probe, np.arange(4)
        for s in word:
            image, actions = s.views(image), np.array(s.actions)[actions]
        mark = (image.tobytes(), actions.tobytes())
        if mark not in group:
            group[mark] = word
            fresh += [(*word, s) for s in symmetries]
    for word in group.values():
        for s, a, then, w in zip(t.source, t.action, t.target, t.weight, strict=True):
            before, after, action = views[s][None], views[then][None], int(a)
            for symmetry in word:
                before, after, action = symmetry.views(before), symmetry.views(after), symmetry.actions[action]
            key = (np.ascontiguousarray(before).tobytes(), action, np.ascontiguousarray(after).tobytes())
            expected[key] = expected.get(key, 0) + int(w)
    assert edges_of(found) == expected
    assert found.num_actions == 4 and (np.diff(view_keys(found.views)) > 0).all()


def test_what_is_no_symmetry_is_refused(toy) -> None:  # type: ignore[no-untyped-def]
    plain = transitions_of(toy)
    for symmetry, message in (
        (Symmetry("three", (1, 0, 2), lambda views: views[:, ::-1]), r"each of 0\.\.3 once, got \(1, 0, 2\)"),
        (Symmetry("twice", (0, 0, 1, 2), lambda views: views), "each of"),
        (Symmetry("flat", (0, 1, 2, 3), lambda views: np.zeros_like(views)), "two views the same image"),
        (Symmetry("cut", (0, 1, 2, 3), lambda views: views[:, 1:]), "makes views"),
        (Symmetry("kinds", (0, 1, 2, 3), lambda views: views + 7), "cells of views"),
    ):
        with pytest.raises(UserError, match=message):
            with_images(plain, [symmetry])


@pytest.mark.parametrize("task", ["crossing", "following"])
def test_person_following_is_what_it_says(task: str) -> None:
    """The declared symmetry maps the set of all steps from all poses of all maps onto itself, weights included."""
    domain = load_domain()
    assert domain.spec.weighting == "maps"
    (symmetry,) = symmetries_of(domain)
    t = reference_transitions(domain, "paper", task)
    assert t is not None
    index = np.searchsorted(view_keys(t.views), view_keys(symmetry.views(t.views)))
    images = edges_of(
        Transitions(t.views, t.visits, index[t.source], np.array(symmetry.actions)[t.action], index[t.target],
                    t.weight, t.num_actions)
    )  # fmt: skip
    assert images == edges_of(t)
    np.testing.assert_array_equal(t.visits[index], t.visits)
