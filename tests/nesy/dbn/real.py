"""A model of the real domain for the tests, made once per process."""

import functools

import numpy as np

# two cells per factor: the kind of the first, and whether the second is a wall
CELLS = [(2, 3, 1, 4), (2, 2, 3, 4), (1, 3, 3, 3), (2, 1, 1, 2), (3, 2, 0, 4), (4, 4, 0, 3), (4, 3, 2, 0), (1, 1, 3, 1)]


def encode(views):
    return np.stack([views[:, a, b] % 3 * 2 + (views[:, c, d] == 1) for a, b, c, d in CELLS], axis=1).astype(np.uint8)


@functools.cache
def real_model():
    """A model of the real domain, counted from random steps, with codes that are read off the view."""
    from domains.core import load_domain
    from nesy.asp import KnowledgeBase
    from nesy.dbn.codebook import Codebook, value_meanings
    from nesy.dbn.learning.fitting import from_experience
    from nesy.dbn.learning.structure import Search
    from nesy.dbn.learning.transitions import Transitions

    domain = load_domain("person_following")
    environment = domain.make("crossing", 64, seed=0)
    rng = np.random.default_rng(0)
    observation, _ = environment.reset(seed=0)
    before, actions, after = [], [], []
    for _ in range(60):
        action = rng.integers(0, 4, size=64)
        later, _, terminated, truncated, _ = environment.step(action)
        going = ~(terminated | truncated)
        before.append(observation["view"][going].copy())
        actions.append(action[going])
        after.append(later["view"][going].copy())
        observation = later
    taken = Transitions(np.concatenate(before), np.concatenate(actions), np.concatenate(after), encode)
    codebook = Codebook.build(taken.views, taken.view_codes, taken.view_counts, domain.predicates)
    dbn = from_experience(
        taken.codes,
        taken.actions,
        taken.next_codes,
        num_values=8,
        search=Search(max_parents=2, exhaustive=1),
        prior_count=0.01,
        action_names=domain.spec.action_names,
        meanings=value_meanings(codebook, 8),
    )
    return KnowledgeBase(dbn, codebook)
