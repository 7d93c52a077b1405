"""Experience as weighted distinct views and transitions: what is learned from, far smaller than what was met.

The worlds here are small next to the number of steps taken in them (958 views and some 7,700 transitions on the
`paper` variant), so learning works on the distinct ones, gathered by index from columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from domains.core import CELL_KINDS, Domain, DomainError, Weighting, completed
from nesy.checked_arrays import integers
from nesy.errors import UserError
from nesy.log.experience import MOST_ACTIONS, Experience


@dataclass(frozen=True)
class Transitions:
    """Distinct views and the distinct transitions between them.

    A transition's weight is how often it was met. Weighting by `maps` it is the number of maps it was met on: chances
    are lost, but the model does not depend on where the behaviour that collected the experience liked to go.
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
    num_actions: int
    """A."""

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

    Raises:
        UserError: views that are not square, or other kinds of cells.
    """
    views = np.asarray(views)
    if views.ndim != 3 or views.shape[1] != views.shape[2]:
        raise UserError(f"views must be square, [n, v, v], found {list(views.shape)}")
    kinds = f"cells of views (kinds {', '.join(CELL_KINDS)})"
    flat = integers(views, kinds, (None, None, None), len(CELL_KINDS)).astype(np.uint8, copy=False)
    flat = np.ascontiguousarray(flat).reshape(len(views), int(np.prod(views.shape[1:])))
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
    experience: Experience,
    *,
    base: Transitions | None = None,
    views: np.ndarray | None = None,
    weighting: Weighting = "visits",
    num_actions: int | None = None,
) -> Transitions:
    """The distinct views of `experience`, and its distinct unobstructed transitions.

    Args:
        experience: any rows.
        base: index views as this set does; it must hold every view of `experience`.
        views: uint8 [m, v, v], further views to index although nothing was met there.
        weighting: what a transition counts as.
        num_actions: A; by default the largest action met, plus one.

    Raises:
        UserError: views or actions outside what can be counted.
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
    action, total = checked_actions(experience.action, num_actions)
    edge = (index[:count] * total + action) * len(unique) + index[count : 2 * count]
    if weighting == "maps":
        _, place = np.unique(experience.map_id, return_inverse=True)
        maps = int(place.max(initial=0)) + 1
        edge = np.unique(edge[free] * maps + place[free]) // maps  # one entry per transition and map
    else:
        edge = edge[free]
    edges, weight = np.unique(edge, return_counts=True)
    return from_edges(distinct, visits, edges, weight, total)


def checked_actions(actions: np.ndarray, num_actions: int | None) -> tuple[np.ndarray, int]:
    """Actions as int64 [n], and how many there are: as many as given, or the largest met plus one.

    Raises:
        UserError: an action is none of those that there are.
    """
    found = integers(actions, "actions", (None,), num_actions or MOST_ACTIONS).astype(np.int64)
    return found, num_actions or int(found.max(initial=0)) + 1


def reference_transitions(domain: Domain, variant: str, task: str = "following") -> Transitions | None:
    """Every step from every pose of every map, each counted once: the set that no behaviour has chosen.

    Returns None where the world does not list them, as the maps of the variant are too many, say.
    """
    try:
        _, before, action, after = completed(domain).transitions(variant, task=task)
    except DomainError:
        return None
    unique, first, index = np.unique(view_keys(np.concatenate([before, after])), return_index=True, return_inverse=True)
    action, total = checked_actions(action, len(domain.spec.action_names))
    edge = (index[: len(before)] * total + action) * len(unique) + index[len(before) :]
    edges, weight = np.unique(edge, return_counts=True)
    distinct = np.concatenate([before, after])[first]
    return from_edges(distinct, np.bincount(index, minlength=len(unique)), edges, weight, total)


def from_edges(
    views: np.ndarray, visits: np.ndarray, edges: np.ndarray, weight: np.ndarray, num_actions: int
) -> Transitions:
    """Transitions from their numbers `(source * A + action) * V + target`, int64 [E] ascending, and weights [E]."""
    total = len(views)
    return Transitions(
        views=np.ascontiguousarray(views),
        visits=visits.astype(np.int64),
        source=edges // total // num_actions,
        action=edges // total % num_actions,
        target=edges % total,
        weight=weight.astype(np.int64),
        num_actions=num_actions,
    )
