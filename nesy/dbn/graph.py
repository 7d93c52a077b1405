"""The 2DBN as a networkx graph, and how strong its arcs are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import networkx
import numpy as np

from nesy.names import TEXT, sliced

if TYPE_CHECKING:
    from nesy.dbn.model import TwoSliceDBN


def to_networkx(dbn: TwoSliceDBN, action: int | None = None) -> networkx.MultiDiGraph:
    """The graph of one action, or of all.

    Nodes are `X0` (slice t, attributes `factor`, `slice` 0) and `X0'` (slice t+1), named by nesy.names.sliced. Edges
    have the key and attribute `action`, and `strength` in [0, 1] (see `arc_strength`).
    """
    graph = networkx.MultiDiGraph()
    for where in (0, 1):
        for i, name in enumerate(dbn.factor_names):
            graph.add_node(sliced(name, where), factor=i, slice=where)
    for a in range(dbn.num_actions) if action is None else (action,):
        for i, name in enumerate(dbn.factor_names):
            strengths = arc_strength(dbn, a, i)
            for (where, p), strength in zip(dbn.parents(a, i), strengths, strict=True):
                source, taken = sliced(dbn.factor_names[p], where), TEXT.encode(dbn.action_names[a])
                graph.add_edge(source, sliced(name, 1), key=taken, action=taken, strength=strength)
    return graph


def arc_strength(dbn: TwoSliceDBN, action: int, factor: int) -> list[float]:
    """How far each parent's value changes the factor's distribution, on average.

    Mean total variation between two rows that differ in that parent alone, over the pairs of which both rows were
    met in experience, weighted by the rarer one's visits; over all pairs alike where there is no such pair.

    Returns:
        One number in [0, 1] per parent, in the order of `TwoSliceDBN.parents`.
    """
    k = dbn.num_values
    table = dbn.tensor(action, factor)
    visits = dbn.counts(action, factor).reshape(table.shape[:-1])
    result = []
    for axis in range(table.ndim - 1):
        rows = np.moveaxis(table, axis, 0).reshape(k, -1, k)
        seen = np.moveaxis(visits, axis, 0).reshape(k, -1)
        far = weight = far_everywhere = 0.0
        for left in range(k):
            for right in range(left + 1, k):
                pairs = np.minimum(seen[left], seen[right])
                met = np.flatnonzero(pairs)
                chosen = met if visits.any() else np.arange(rows.shape[1])
                distance = 0.5 * np.abs(rows[left, chosen] - rows[right, chosen]).sum(axis=1)
                far += float((distance * pairs[chosen]).sum())
                weight += float(pairs[chosen].sum())
                far_everywhere += float(distance.mean()) if len(distance) else 0.0
        pairs_of_values = k * (k - 1) / 2
        result.append(min(1.0, far / weight if weight else far_everywhere / max(1.0, pairs_of_values)))
    return result
