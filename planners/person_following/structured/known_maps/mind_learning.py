"""Learning the local model of minds (planners.person_following.structured.known_maps.minds) from logged transitions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from domains.core import EMPTY, FORWARD, GOAL, STAY, WALL
from nesy.errors import UserError
from planners.models.tables import DecisionTable, Parents, learn_distribution, learn_mean
from planners.person_following.ialm import TIMEOUT, Codec
from planners.person_following.motion import NUM_HEADINGS, WAIT
from planners.person_following.structured.frames import Frame, learn_frame, reckon
from planners.person_following.structured.known_maps.intentions import learn_intentions
from planners.person_following.structured.known_maps.minds import (
    MAX_STANDING,
    MAX_WALK,
    MOVES,
    STEP,
    MindModel,
    move_variables,
)
from planners.person_following.structured.known_maps.scenes import Scenes, learn_scenes

if TYPE_CHECKING:
    from nesy.log.experience import Experience

_MOST_EXPLORING = 120_000
HORIZON = 64
"""Steps for which persons' ways are imagined, at least: logged episodes that are lost early say little of the last."""


def several_goals(experience: Experience) -> bool:
    """Whether there is something to intend: some view shows more goals than one, or a goal goes before a robot's eyes.

    A goal that the person steps on is only hidden. Robots that stay see what becomes of the goals in view.
    """
    shown = (experience.view == GOAL).reshape(len(experience), -1).sum(1)
    if (shown > 1).any():
        return True
    stays = np.flatnonzero(experience.action == STAY)
    gone = (experience.view[stays] == GOAL) & (experience.next_view[stays] == EMPTY)
    gone = gone.reshape(len(stays), experience.view[0].size)
    configuration = experience.next_configuration[stays].astype(np.int64)
    seen = configuration > 0
    gone[seen, (configuration[seen] - 1) // NUM_HEADINGS] = False
    return bool(gone.any())


def learn_minds(codec: Codec, experience: Experience, provenance: dict[str, Any] | None = None) -> MindModel:
    """Learn every table from experience.

    Args:
        codec: turns views into codes, and codes into views.
        experience: transitions of person following (all tables), and walks over its maps (scenes only).
        provenance: recorded with the model.
    """
    following = whole_episodes(experience.select(np.char.startswith(experience.source, "following")))
    if len(following) == 0:
        raise UserError("the experience holds no person-following episodes; collect some (sources following-*)")
    frame, moved = learn_frame(following)
    t = following.t.astype(np.int64) - int(following.t.min())
    poses = reckon(frame, following, moved)
    people = frame.compose(poses, following.relative_pose.astype(np.int64))
    width = following.view.shape[1]
    wall = following.view[:, width // 2, width - 2] == WALL
    in_front = (following.relative_pose[:, :2] == (0, 1)).all(1)
    acted = following.action != STAY
    moves = learn_distribution(
        move_variables(t, following.action, wall & (following.action == FORWARD), in_front)[acted],
        MOVES,
        moved[acted].astype(np.int64),
        2,
    )
    maps, seen_from, seen = [following.map_id] * 2, [poses, people], [following.view, following.person_view]
    begins = [t == 0, np.zeros(len(t), np.bool_)]
    exploring = whole_episodes(_some(experience, np.isin(experience.map_id, np.unique(following.map_id))))
    if len(exploring):
        maps.append(exploring.map_id)
        seen_from.append(_explored(frame, exploring, moves))
        seen.append(exploring.view)
        begins.append(np.zeros(len(exploring), np.bool_))
    everything = np.concatenate(seen)
    known = np.unique(everything.reshape(len(everything), -1), axis=0).reshape(-1, width, width)
    scenes = learn_scenes(
        frame, np.concatenate(maps), np.concatenate(seen_from), everything, np.concatenate(begins), known
    )
    scene = np.searchsorted(scenes.keys, following.map_id)
    robot, person = scenes.station(scene, poses), scenes.station(scene, people)
    lost_way = np.unique(following.episode[(robot < 0) | (person < 0)])
    kept = ~np.isin(following.episode, lost_way)  # of scenes that are not known well enough
    if not kept.any():
        raise UserError("the experience does not hang together: no way could be followed; collect more episodes")
    following, scene, robot, person, t = following.select(kept), scene[kept], robot[kept], person[kept], t[kept]
    moved = moved[kept]
    intentions, own, given_up = learn_intentions(scenes, following, scene, robot, person)
    next_lost, outcome, reward = _learn_steps(scenes, following, scene, robot, person, moved, own, given_up, t)
    expected = codec.codes(scenes.view[scene, robot])
    plain = (following.view != GOAL).all((1, 2)) & (scenes.view[scene, robot] != GOAL).all((1, 2))
    noise = float((expected != codec.codes(following.view))[plain].mean()) if plain.any() else 0.0
    return MindModel(
        scenes,
        intentions,
        moves,
        next_lost,
        outcome,
        reward,
        noise,
        max(HORIZON, int(t.max()) + 1),
        dict(provenance or {}),
    )


def whole_episodes(experience: Experience) -> Experience:
    """The episodes that are there from their first step on, in order."""
    order = np.lexsort((experience.t, experience.episode))
    experience = experience.select(order)
    begins = np.r_[True, np.diff(experience.episode) != 0]
    start = np.flatnonzero(begins)
    lengths = np.diff(np.r_[start, len(experience)])
    expected = np.arange(len(experience)) - np.repeat(start, lengths) + experience.t.min(initial=0)
    broken = np.unique(experience.episode[expected != experience.t])
    return experience.select(~np.isin(experience.episode, broken))


def _some(experience: Experience, wanted: np.ndarray) -> Experience:
    rows = np.flatnonzero(wanted & (experience.source == "crossing-explore"))
    if len(rows) <= _MOST_EXPLORING:
        return experience.select(rows)
    return experience.select(rows[experience.episode[rows] <= experience.episode[rows[_MOST_EXPLORING]]])


def _explored(frame: Frame, exploring: Experience, moves: DecisionTable) -> np.ndarray:
    """Poses of a robot that nobody is with: which actions moved it the learned table says."""
    t = exploring.t.astype(np.int64) - int(exploring.t.min())
    width = exploring.view.shape[1]
    wall = (exploring.view[:, width // 2, width - 2] == WALL) & (exploring.action == FORWARD)
    variables = move_variables(t, exploring.action, wall, np.zeros(len(t), np.int64))
    moved = moves.estimates()[moves.locate(variables)].argmax(1) > 0
    return reckon(frame, exploring, moved | (exploring.action == STAY))


def _learn_steps(
    scenes: Scenes,
    experience: Experience,
    scene: np.ndarray,
    robot: np.ndarray,
    person: np.ndarray,
    moved: np.ndarray,
    own: np.ndarray,
    given_up: np.ndarray,
    t: np.ndarray,
) -> tuple[DecisionTable, DecisionTable, DecisionTable]:
    """P(lost' | walk, lost), P(outcome | STEP) and E[r | STEP]."""
    effective = np.where(moved, experience.action.astype(np.int64), STAY)
    then = scenes.follows[scene, robot, effective].astype(np.int64)
    moves = experience.person_action.astype(np.int64)
    person_then = np.where(moves < WAIT, scenes.follows[scene, person, moves.clip(0, 3)], person).astype(np.int64)
    cell, person_cell = scenes.cell[scene, then], scenes.cell[scene, person_then].astype(np.int64)
    walk = scenes.walk[scene, then, person_cell].clip(0, MAX_WALK)
    best = own.argmax(1)
    rows = np.arange(len(scene))
    certain = own[rows, best] > 0.9
    # the goal as the person finds it: the candidate given up is not, the only other one then is
    now = _goal_now(scenes, scene, best, given_up[rows, best])
    certain &= now >= 0
    at_goal = person_cell == now
    standing = _running_count(at_goal, t).clip(0, MAX_STANDING)
    enters = (cell == now) & (then != robot) & (effective == FORWARD)
    faced = scenes.follows[scene, then, FORWARD]
    ahead = (scenes.cell[scene, faced] == person_cell) & (faced != then) & (experience.action == FORWARD)
    lost = experience.lost.astype(np.int64)
    goes_on = np.zeros(len(scene), np.bool_)
    goes_on[:-1] = t[1:] == t[:-1] + 1
    next_lost = np.where(goes_on, np.roll(lost, -1), 0)
    columns = np.stack([walk, lost], 1).astype(np.int32)
    table = learn_distribution(
        columns[goes_on], Parents(("walk", "lost"), (0, 1), (True, True)), next_lost[goes_on], int(next_lost.max()) + 1
    )
    outcome = np.where(experience.outcome == TIMEOUT, 0, experience.outcome).astype(np.int64)
    variables = np.stack(
        [walk, experience.next_configuration > 0, at_goal, standing, lost, enters, ahead, cell == person_cell], 1
    ).astype(np.int32)[certain]
    outcomes = learn_distribution(variables, STEP, outcome[certain], int(outcome.max()) + 1)
    return table, outcomes, learn_mean(variables, STEP, experience.reward[certain])


def _goal_now(scenes: Scenes, scene: np.ndarray, chosen: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Cells of the goals that persons head for [n]; -1 where the one left for is not known."""
    goals = scenes.goals[scene].astype(np.int64)
    number = (goals >= 0).sum(1)
    other = np.where(number == 2, goals[:, :2].sum(1) - goals[np.arange(len(goals)), chosen], -1)
    return np.where(left, other, goals[np.arange(len(goals)), chosen])


def _running_count(flags: np.ndarray, t: np.ndarray) -> np.ndarray:
    """For how many steps in a row a flag [n] has been set, this one included; episodes begin where t is 0."""
    out = np.zeros(len(flags), np.int64)
    run = 0
    for i, (flag, step) in enumerate(zip(flags.tolist(), t.tolist(), strict=True)):
        run = 0 if step == 0 else run
        run = run + 1 if flag else 0
        out[i] = run
    return out
