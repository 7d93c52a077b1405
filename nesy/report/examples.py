"""Moments of a run worth showing, found in its experience."""

from __future__ import annotations

import numpy as np

from domains.core import load_domain
from nesy.log.experience import Experience
from nesy.perspective.operator import imagine
from nesy.report.figures import BeliefExample
from nesy.run_folder import RunFolder, read_json
from nesy.world_model import SymbolicCodec, load_world_model


def belief_example(run: RunFolder) -> BeliefExample | None:
    """A moment in which the person is in view and the imagined way to it is long; None if there is none.

    Chosen by what the robot sees, never by how well the shifted belief turns out: the first of the moments
    with the most imagined actions, among up to 200 distinct ones.
    """
    domain = load_domain(str(read_json(run.config).get("domain", "person_following")))
    experience = Experience.load(run.experience)
    experience = experience.select(np.flatnonzero(experience.configuration > 0))
    if len(experience) == 0:
        return None
    codec = SymbolicCodec(load_world_model(run.world_model))
    keys = np.column_stack([experience.view.reshape(len(experience), -1), experience.configuration])
    distinct = np.sort(np.unique(keys, axis=0, return_index=True)[1])[:200]
    beliefs = codec.beliefs(experience.view[distinct])
    paths = [
        imagine(belief, int(configuration), codec)
        for belief, configuration in zip(beliefs, experience.configuration[distinct], strict=True)
    ]
    best = max(range(len(paths)), key=lambda i: (paths[i].reachable, len(paths[i].actions)))
    row, path = distinct[best], paths[best]
    vx, vy, heading = domain.spec.geometry.decode(np.array([experience.configuration[row]]))
    return BeliefExample(
        view=experience.view[row],
        person=(int(vx[0]), int(vy[0]), int(heading[0])),
        belief=beliefs[best],
        shifted=path.beliefs[-1],
        decoded=codec.views(beliefs[best].argmax(axis=-1).astype(np.uint8)[None])[0],
        decoded_shifted=codec.views(path.beliefs[-1].argmax(axis=-1).astype(np.uint8)[None])[0],
        person_view=experience.person_view[row],
        actions=tuple(domain.spec.action_names[action] for action in path.actions),
    )
