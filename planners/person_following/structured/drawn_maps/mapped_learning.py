"""Learning the local model over maps drawn on the way (mapped_model) from logged transitions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from domains.core import FORWARD, STAY, UNSEEN, WALL
from nesy.compiled import njit
from nesy.errors import UserError
from planners.models.tables import DecisionTable, Parents, learn_distribution, learn_mean
from planners.person_following.ialm import TIMEOUT
from planners.person_following.motion import NUM_HEADINGS, NUM_MOVES
from planners.person_following.structured.drawn_maps.mapped_model import (
    AROUND,
    BACK,
    FRONT,
    LATER,
    LOST,
    MAX_WALK,
    MOVES,
    PERSON,
    REACH,
    STEP,
    MappedModel,
    walk_variables,
)
from planners.person_following.structured.drawn_maps.mapped_ways import features, walls_in_view
from planners.person_following.structured.drawn_maps.mapping import Chart, chart_of, note, patch, walks_to, ways_on
from planners.person_following.structured.frames import learn_frame, reckon
from planners.person_following.structured.known_maps.mind_learning import whole_episodes

if TYPE_CHECKING:
    from nesy.log.experience import Experience

_LAGS = (0, 2, 4)
"""For how many steps the map that pi is asked about may not have grown: it is asked about the person's future too."""
_MOST_VIEWS = 20_000
_SURELY = 0.95
"""Share of wall from which on a place that nobody has seen yet counts as one: where less is sure, persons may go."""


def walls_hide(experience: Experience) -> bool:
    """Whether views have cells that are not shown."""
    return bool((experience.view == UNSEEN).any())


def learn_mapped(experience: Experience, discount: float, provenance: dict[str, Any] | None = None) -> MappedModel:
    """Learn every table from experience.

    Args:
        experience: transitions of person following; others are left out.
        discount: per step, for the returns of what is not looked at any more.
        provenance: recorded with the model.

    Raises:
        UserError: it holds no episode of person following, or too little to tell how poses add up.
    """
    following = whole_episodes(experience.select(np.char.startswith(experience.source, "following")))
    if len(following) == 0:
        raise UserError("the experience holds no person-following episodes; collect some (sources following-*)")
    frame, moved = learn_frame(following)
    t = following.t.astype(np.int64) - int(following.t.min())
    robots = reckon(frame, following, moved)
    persons = frame.compose(robots, following.relative_pose.astype(np.int64))
    chart = chart_of(frame, np.concatenate([robots, persons]))
    begins = np.flatnonzero(t == 0)
    maps = np.full((len(begins), *chart.usual.shape), UNSEEN, np.uint8)
    _draw(chart, following.view, robots, t, maps)
    _draw(chart, following.person_view, persons, t, maps)
    chart = chart._replace(usual=_usual(maps))
    width = following.view.shape[1]
    number = chart.number(persons)
    person, informed = (_learn_person(chart, following, robots, persons, t, told) for told in (False, True))
    shown = _learn_sight(chart, maps, following, robots, persons, t)
    wall = following.view[:, width // 2, width - 2] == WALL
    in_front = (following.relative_pose[:, :2] == (0, 1)).all(1)
    acted = following.action != STAY
    columns = np.stack([following.action, wall & (following.action == FORWARD), in_front], 1).astype(np.int32)
    moves = learn_distribution(columns[acted], MOVES, moved[acted].astype(np.int64), 2)
    lost = following.lost.astype(np.int64)
    robot = chart.number(robots)
    walk, *rest = _judged(chart, maps, following.action, following.person_action, robot, number, moved, t).T
    sight = following.next_configuration > 0
    at_goal, enters, ahead, same, follows = rest
    steps = walk_variables(walk, sight, at_goal, lost, enters, ahead, same)
    goes_on = np.zeros(len(t), np.bool_)
    goes_on[:-1] = t[1:] == t[:-1] + 1
    next_lost = np.where(goes_on, np.roll(lost, -1), 0)
    outcome = np.where(following.outcome == TIMEOUT, 0, following.outcome).astype(np.int64)
    starts = np.stack(np.unique(number[begins], return_counts=True), 1)
    after = walk_variables(walk, sight, next_lost)
    rest_follows = goes_on & np.roll(_from_here_on(follows == 1, t), -1)
    if not rest_follows.any():
        raise UserError("the experience shows nobody who follows the person; collect more episodes")
    returns = _returns(following.reward.astype(np.float64), t, discount)
    return MappedModel(
        chart,
        person,
        informed,
        tuple(shown),
        moves,
        learn_distribution(walk_variables(walk, lost)[goes_on], LOST, next_lost[goes_on], int(next_lost.max()) + 1),
        learn_distribution(steps, STEP, outcome, int(outcome.max()) + 1),
        learn_mean(steps, STEP, following.reward),
        learn_mean(after[rest_follows], LATER, np.roll(returns, -1)[rest_follows]),
        starts.astype(np.int64),
        width,
        dict(provenance or {}),
    )


def _usual(maps: np.ndarray) -> np.ndarray:
    """The kind that each place mostly is, uint8 [F, F], of maps [E, F, F]; a wall only where it is hardly ever none."""
    counts = np.stack([(maps == kind).sum(0) for kind in range(UNSEEN)], -1)
    known = counts.sum(-1)
    walled = counts[..., WALL] >= _SURELY * known
    counts[..., WALL] = 0
    return np.where(walled, WALL, counts.argmax(-1)).astype(np.uint8)


def _returns(rewards: np.ndarray, t: np.ndarray, discount: float) -> np.ndarray:
    """The discounted return from every step on [n]; episodes begin where t is 0."""
    out = np.zeros(len(rewards))
    later = 0.0
    for i in range(len(rewards) - 1, -1, -1):
        out[i] = rewards[i] + discount * later
        later = out[i] if t[i] > 0 else 0.0
    return out


def _from_here_on(flags: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Whether a flag [n] is set at a step and at all that follow in its episode; episodes begin where t is 0."""
    out = np.zeros(len(flags), np.bool_)
    later = True
    for i in range(len(flags) - 1, -1, -1):
        out[i] = later = bool(flags[i]) and later
        later = later or t[i] == 0
    return out


def _learn_person(
    chart: Chart, following: Experience, robots: np.ndarray, persons: np.ndarray, t: np.ndarray, told: bool
) -> DecisionTable:
    """The table pi, on maps as they were at the time, and as they had been some steps before; see `_around`."""
    views = np.stack([following.view, following.person_view])
    poses = np.stack([robots, persons])
    columns = [_around(chart, views, poses, chart.number(persons), t, lag, told) for lag in _LAGS]
    return learn_distribution(
        np.concatenate(columns), PERSON, np.tile(following.person_action.astype(np.int64), len(_LAGS)), NUM_MOVES
    )


def _learn_sight(
    chart: Chart, maps: np.ndarray, following: Experience, robots: np.ndarray, persons: np.ndarray, t: np.ndarray
) -> list[DecisionTable]:
    """P(shown | walls in the view) per cell of a view, as robots and persons saw on maps that are known by now."""
    views = np.concatenate([following.view, following.person_view])
    where = np.concatenate([chart.number(robots), chart.number(persons)])
    episode = np.tile(np.cumsum(t == 0) - 1, 2)
    some = np.arange(len(views))[:: max(1, -(-len(views) // _MOST_VIEWS))]
    width = views.shape[1]
    walls = _walls(chart, maps, where[some], episode[some], width)
    seen = views[some][:, :, ::-1].transpose(0, 2, 1).reshape(len(some), -1) != UNSEEN  # from the viewer's row on
    names = tuple(f"wall {s} right, {f} ahead" for f in range(width) for s in range(-(width // 2), width // 2 + 1))
    parents = Parents(names, tuple(range(width * width)), (False,) * width**2)
    return [learn_distribution(walls, parents, seen[:, i].astype(np.int64), 2) for i in range(width * width)]


@njit(cache=True)
def _draw(chart: Chart, views: np.ndarray, poses: np.ndarray, t: np.ndarray, maps: np.ndarray) -> None:
    """Draw the views of all steps into the maps of their episodes, uint8 [E, F, F]."""
    episode = -1
    for i in range(len(t)):
        episode += t[i] == 0
        note(chart, maps[episode], views[i], poses[i])


@njit(cache=True)
def _around(
    chart: Chart, views: np.ndarray, poses: np.ndarray, number: np.ndarray, t: np.ndarray, lag: int, told: bool
) -> np.ndarray:
    """The variables of `PERSON` on the robot's map of `lag` steps before (of the first step, at first): int32.

    `views` [2, n, V, V] and `poses` [2, n, 3] are the robot's and the person's; where `told`, both are on the map.
    """
    out = np.zeros((len(t), AROUND + 3), np.int32)
    size = chart.usual.shape[0]
    kinds = np.zeros((size, size), np.uint8)
    for i in range(len(t)):
        if t[i] == 0:
            kinds[:] = UNSEEN
        if t[i] == 0 or t[i] > lag:
            j = i if t[i] == 0 else i - lag
            note(chart, kinds, views[0, j], poses[0, j])
            if told:
                note(chart, kinds, views[1, j], poses[1, j])
        patch(chart, kinds, number[i], REACH, BACK, FRONT, WALL, out[i])
        out[i, AROUND] = number[i] // NUM_HEADINGS // size
        out[i, AROUND + 1] = number[i] // NUM_HEADINGS % size
        out[i, AROUND + 2] = number[i] % NUM_HEADINGS
    return out


@njit(cache=True)
def _walls(chart: Chart, maps: np.ndarray, where: np.ndarray, episode: np.ndarray, width: int) -> np.ndarray:
    """Which cells of views from poses [n] are wall, int32 [n, V * V]; what nobody saw is what it usually is."""
    out = np.zeros((len(where), width * width), np.int32)
    for i in range(len(where)):
        kinds = maps[episode[i]]
        filled = np.where(kinds == UNSEEN, chart.usual, kinds)
        walls_in_view(chart, filled, where[i], width, out[i])
    return out


@njit(cache=True)
def _judged(
    chart: Chart,
    maps: np.ndarray,
    action: np.ndarray,
    move: np.ndarray,
    robots: np.ndarray,
    persons: np.ndarray,
    moved: np.ndarray,
    t: np.ndarray,
) -> np.ndarray:
    """Walk, at goal, enters, ahead, same place (as `features`) of every step: int64 [n, 6].

    And last whether the robot followed: whether no other action had brought it nearer to where the person stood.
    """
    out = np.zeros((len(t), 6), np.int64)
    episode = -1
    size = chart.usual.shape[0]
    walk = np.zeros(size * size * NUM_HEADINGS, np.uint8)
    queue = np.zeros(len(walk), np.int64)
    filled = chart.usual
    follows, comes = ways_on(chart, filled)
    for i in range(len(t)):
        if t[i] == 0:
            episode += 1
            filled = np.where(maps[episode] == UNSEEN, chart.usual, maps[episode])
            follows, comes = ways_on(chart, filled)
        q = robots[i]
        then = follows[q, action[i]] if moved[i] and action[i] != STAY else q
        person = follows[persons[i], move[i]] if move[i] != STAY else persons[i]
        walks_to(comes, person, MAX_WALK, walk, queue)
        found = features(filled, follows, walk, q, then, action[i], person)
        for k in range(5):
            out[i, k] = found[k]
        walks_to(comes, persons[i], MAX_WALK, walk, queue)
        out[i, 5] = 1
        for m in range(FORWARD + 1):
            if walk[follows[q, m]] < walk[then]:
                out[i, 5] = 0
    return out
