"""Images of transitions under the symmetries that a world declares: every step met stands for all of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from domains.core import Symmetry
from nesy.errors import UserError
from nesy.world_model.distinct import Transitions, from_edges, view_keys

MOST_IMAGES = 64
"""Most images of one step: symmetries that make up more are a mistake."""


def with_images(
    transitions: Transitions, symmetries: Sequence[Symmetry], views: np.ndarray | None = None
) -> Transitions:
    """The transitions and their images under the symmetries and all that these make up.

    Args:
        transitions: any.
        symmetries: that the world declares, each of A actions.
        views: uint8 [m, v, v], distinct, in ascending order of `view_keys`, the views to index; they must hold all
            views and their images. By default those of `transitions` with their images.

    Raises:
        UserError: a symmetry is none: of other actions, or not one to one on the views.
    """
    t = transitions
    for symmetry in symmetries:
        if sorted(symmetry.actions) != list(range(t.num_actions)):
            known = f"each of 0..{t.num_actions - 1} once"
            raise UserError(f"symmetry '{symmetry.name}': actions must hold {known}, got {symmetry.actions}")
    views = _closed(t.views, symmetries) if views is None else views
    keys = view_keys(views)
    index = _places(keys, t.views)
    group = _group([(_permuted(keys, views, s), np.array(s.actions)) for s in symmetries], len(views), t.num_actions)
    edge = [
        (of_view[index[t.source]] * t.num_actions + of_action[t.action]) * len(keys) + of_view[index[t.target]]
        for of_view, of_action in group
    ]
    edges, place = np.unique(np.concatenate(edge), return_inverse=True)
    weight = np.bincount(place, np.tile(t.weight, len(group))).astype(np.int64)
    shown = np.concatenate([of_view[index] for of_view, _ in group])
    visits = np.bincount(shown, np.tile(t.visits, len(group)), minlength=len(keys)).astype(np.int64)
    return from_edges(views, visits, edges, weight, t.num_actions)


def _closed(views: np.ndarray, symmetries: Sequence[Symmetry]) -> np.ndarray:
    """The views with all their images, in ascending order of `view_keys`."""
    most = MOST_IMAGES * len(views)
    while True:
        every = np.concatenate([views, *(_images(views, symmetry) for symmetry in symmetries)])
        _, first = np.unique(view_keys(every), return_index=True)
        if len(first) == len(views):
            return views
        if len(first) > most:
            raise UserError(f"the symmetries make more than {MOST_IMAGES} images of a view: they are none of a world")
        views = every[first]


def _images(views: np.ndarray, symmetry: Symmetry) -> np.ndarray:
    images = np.asarray(symmetry.views(views))
    if images.shape != views.shape:
        raise UserError(f"symmetry '{symmetry.name}' makes views {list(images.shape)} of {list(views.shape)}")
    return images


def _places(keys: np.ndarray, views: np.ndarray) -> np.ndarray:
    wanted = view_keys(views)
    index = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    assert (keys[index] == wanted).all(), "a view outside the given ones"
    return index


def _permuted(keys: np.ndarray, views: np.ndarray, symmetry: Symmetry) -> np.ndarray:
    """The index of every view's image, int64 [V]."""
    index = _places(keys, _images(views, symmetry))
    if len(np.unique(index)) < len(index):
        raise UserError(f"symmetry '{symmetry.name}' gives two views the same image")
    return index


def _group(
    generators: list[tuple[np.ndarray, np.ndarray]], num_views: int, num_actions: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """All that some permutations of views and actions make up, the identity first."""
    found = [(np.arange(num_views), np.arange(num_actions))]
    known = {(found[0][0].tobytes(), found[0][1].tobytes())}
    for of_view, of_action in found:  # which grows
        for next_view, next_action in generators:
            image = next_view[of_view], next_action[of_action]
            mark = image[0].tobytes(), image[1].tobytes()
            if mark not in known:
                known.add(mark)
                found.append(image)
        if len(found) > MOST_IMAGES:
            raise UserError(f"the symmetries make more than {MOST_IMAGES} images of a step: they are none of a world")
    return found
