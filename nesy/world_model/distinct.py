"""Experience as weighted distinct views and transitions: what is learned from, far smaller than what was met.

The worlds here are small next to the number of steps taken in them (958 views and some 7,700 transitions on the
`paper` variant), so learning works on the distinct ones, gathered by index from columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from domains.core import Domain, DomainError
from nesy.log.experience import Experience


@dataclass(frozen=True)
class Transitions:
    """Distinct views and the distinct transitions between them.

    A transition's weight is the number of (map, view) places it was met in, not of visits: the model of the
    world should not depend on where the behaviour that collected the experience liked to go.
    """

    views: np.ndarray
    """uint8 [V, v, v], distinct, in ascending order of `view_keys`."""
    visits: np.ndarray
    """int64 [V]: how often each view was met."""
    source: np.ndarray
    """int64 [E]: index of the view before."""
    action: np.ndarray
    """int64 [E]."""
    target: np.ndarray
    """int64 [E]: index of the view after."""
    weight: np.ndarray
    """int64 [E], positive."""

    def __len__(self) -> int:
        return len(self.action)

    @property
    def num_views(self) -> int:
        """Number of distinct views."""
        return len(self.views)


def view_keys(views: np.ndarray) -> np.ndarray:
    """A key per view, equal exactly where the views are equal.

    Args:
        views: uint8 [n, v, v], cell kinds 0 to 3.

    Returns:
        [n]: int64 of two bits per cell for up to 31 cells, fixed-width bytes beyond.
    """
    flat = np.ascontiguousarray(views, dtype=np.uint8).reshape(len(views), -1)
    cells = flat.shape[1]
    if cells > 31:
        return (flat + 1).view(f"S{cells}").reshape(-1)  # fixed-width strings end at a zero byte, hence + 1
    key = np.zeros(len(flat), dtype=np.int64)
    for cell in range(cells):
        key = key << 2 | flat[:, cell]
    return key


def unobstructed(experience: Experience) -> np.ndarray:
    """Bool [n]: steps whose next view depends on the own view and action alone; see `free_ahead`."""
    return free_ahead(experience.configuration, experience.view.shape[1])


def free_ahead(configurations: np.ndarray, view_size: int) -> np.ndarray:
    """Bool [n]: no other agent is in the cell ahead.

    One that is there blocks the way forward although the view, from which agents are removed, does not show it.
    Which steps that concerns is read from the configuration; what follows from it belongs to the planner's model,
    not to the model of the view.
    """
    pose = configurations.astype(np.int64) - 1
    cell = pose // 4
    ahead = (pose >= 0) & (cell // view_size == view_size // 2) & (cell % view_size == view_size - 2)
    return ~ahead


def transitions_of(
    experience: Experience, *, base: Transitions | None = None, views: np.ndarray | None = None
) -> Transitions:
    """The distinct views of `experience`, and its distinct unobstructed transitions.

    Args:
        experience: any rows.
        base: index views as this set does; it must hold every view of `experience`.
        views: uint8 [m, v, v], further views to index although nothing was met there.
    """
    further = experience.view[:0] if views is None else views
    keys = view_keys(np.concatenate([experience.view, experience.next_view, further]))
    count = len(experience)
    if base is None:
        unique, first, index = np.unique(keys, return_index=True, return_inverse=True)
        distinct = np.concatenate([experience.view, experience.next_view, further])[first]
    else:
        unique, distinct = view_keys(base.views), base.views
        index = np.searchsorted(unique, keys)
        assert (unique[np.minimum(index, len(unique) - 1)] == keys).all(), "a view outside the base set"
    visits = np.bincount(index[: 2 * count], minlength=len(unique))
    free = unobstructed(experience)
    edge = (index[:count] * 4 + experience.action) * len(unique) + index[count : 2 * count]
    _, place = np.unique(experience.map_id, return_inverse=True)
    # One entry per (map, transition), then one per transition with the number of maps as its weight.
    per_map = np.unique(edge[free] * (int(place.max(initial=0)) + 1) + place[free])
    edges, weight = np.unique(per_map // (int(place.max(initial=0)) + 1), return_counts=True)
    return from_edges(distinct, visits, edges, weight)


def with_mirror(transitions: Transitions, views: np.ndarray | None = None) -> Transitions:
    """The transitions and their mirror images: left and right change places in views and actions.

    The world has no handedness: the mirror image of a map is a map as likely, so every step met stands for two.

    Args:
        transitions: any.
        views: uint8 [m, v, v], distinct, the views to index; they must hold all views and their mirror images. By
            default those of `transitions` with their mirror images.
    """
    t = transitions
    mirrored = t.views[:, ::-1]
    keys = view_keys(np.concatenate([t.views, mirrored]))
    if views is None:
        unique, first = np.unique(keys, return_index=True)
        views = np.concatenate([t.views, mirrored])[first]
    else:
        unique = view_keys(views)
    index = np.searchsorted(unique, keys)
    assert (unique[np.minimum(index, len(unique) - 1)] == keys).all(), "a view outside the given ones"
    total = t.num_views
    same, other = index[:total], index[total:]
    action = np.array([1, 0, 2, 3])[t.action]
    edge = np.concatenate(
        [
            (same[t.source] * 4 + t.action) * len(unique) + same[t.target],
            (other[t.source] * 4 + action) * len(unique) + other[t.target],
        ]
    )
    edges, place = np.unique(edge, return_inverse=True)
    weight = np.bincount(place, np.tile(t.weight, 2)).astype(np.int64)
    visits = np.bincount(index, np.tile(t.visits, 2), minlength=len(unique)).astype(np.int64)
    return from_edges(views, visits, edges, weight)


def reference_transitions(domain: Domain, variant: str, task: str = "following") -> Transitions | None:
    """Every step from every pose of every map, each counted once: the set that no behaviour has chosen.

    Returns None where the maps of the variant are too many to list.
    """
    try:
        _, before, action, after = domain.transitions(variant, task=task)
    except DomainError:
        return None
    unique, first, index = np.unique(view_keys(np.concatenate([before, after])), return_index=True, return_inverse=True)
    edge = (index[: len(before)] * 4 + action) * len(unique) + index[len(before) :]
    edges, weight = np.unique(edge, return_counts=True)
    distinct = np.concatenate([before, after])[first]
    return from_edges(distinct, np.bincount(index, minlength=len(unique)), edges, weight)


def from_edges(views: np.ndarray, visits: np.ndarray, edges: np.ndarray, weight: np.ndarray) -> Transitions:
    """Transitions from their numbers `(source * 4 + action) * V + target`, int64 [E] ascending, and weights [E]."""
    total = len(views)
    return Transitions(
        views=np.ascontiguousarray(views),
        visits=visits.astype(np.int64),
        source=edges // total // 4,
        action=edges // total % 4,
        target=edges % total,
        weight=weight.astype(np.int64),
    )
