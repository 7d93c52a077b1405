"""Learning the tables of the influence-augmented local model (ialm) from logged transitions."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from domains.core import DISCOUNT, FORWARD, STAY
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from planners.models.split_tables import learn_by
from planners.models.tables import DecisionTable, Parents, learn_distribution, learn_mean
from planners.person_following import ialm
from planners.person_following.bounds import relational_values
from planners.person_following.ialm import IALM, MAX_DISTANCE, SCALARS, TIMEOUT, Codec
from planners.person_following.motion import WAIT, RelativeMotion, learn_motion

if TYPE_CHECKING:
    from nesy.log.experience import Experience

_MOST_CROSSING = 120_000  # steps of crossing that are looked at: the views of a task repeat soon
_ORDERED = {"side", "ahead", "waiting", "lost", "distance"}


def learn_ialm(
    dbn: TwoSliceDBN,
    codec: Codec,
    experience: Experience,
    provenance: dict[str, Any] | None = None,
    discount: float = DISCOUNT,
) -> IALM:
    """Learn every table from experience.

    Args:
        dbn: the 2DBN extracted from the same codes.
        codec: turns views into codes.
        experience: transitions of person following (all tables), and of the crossing task's expert (pi only).
        provenance: recorded with the model.
        discount: per step, for the leaf values.
    """
    following = experience.select(np.char.startswith(experience.source, "following"))
    crossing = _some_crossing(experience)
    if len(following) == 0:
        raise UserError("the experience holds no person-following episodes; collect some (sources following-*)")
    motion, moved = learn_motion(following)
    variables = _variables(dbn.num_factors, codec, following, motion, moved)
    names = _slot_names(dbn.num_factors)
    n = dbn.num_factors

    def parents(*wanted: str) -> Parents:
        slots: list[int] = []
        for name in wanted:
            if name in ("x", "next_x", "y"):
                start = ("x", "next_x", "y").index(name) * n
                slots += range(start, start + n)
            elif name in ("c", "mid", "next"):
                prefix = {"c": "", "mid": "mid_", "next": "next_"}[name]
                slots += [3 * n + SCALARS.index(prefix + part) for part in ("side", "ahead", "heading")]
            else:
                slots.append(3 * n + SCALARS.index(name))
        plain = [names[s].removeprefix("mid_").removeprefix("next_") for s in slots]
        return Parents(tuple(names[s] for s in slots), tuple(slots), tuple(p in _ORDERED for p in plain))

    def column(scalar: int) -> np.ndarray:
        return variables[:, 3 * n + scalar]

    acted = column(ialm.ACTION) != STAY
    waited = column(ialm.PERSON) == WAIT
    followed, next_waiting, next_lost = _next_counters(following)
    outcome = column(ialm.THE_OUTCOME).astype(np.int64)
    variables[followed, 3 * n + ialm.NEXT_LOST_COUNT] = next_lost[followed]
    # Where the episode ended there is no next counter to read; the table learned from the others fills it in.
    lost_table = learn_distribution(
        variables[followed], parents("lost", "distance", "next"), next_lost[followed], int(next_lost.max()) + 2
    )
    ended = ~followed
    estimated = lost_table.estimates()[lost_table.locate(variables[ended])].argmax(axis=1)
    variables[ended, 3 * n + ialm.NEXT_LOST_COUNT] = estimated
    tables = {
        "moved": _learn_moved(codec, crossing, variables[acted], moved[acted], parents("action", "x", "c")),
        "waits": learn_distribution(variables, parents("mid", "next_x", "waiting"), waited.astype(np.int64), 2),
        "influence": _learn_influence(dbn, codec, experience, following, parents("y")),
        "next_waiting": learn_distribution(
            variables[followed], parents("waiting", "person"), next_waiting[followed], int(next_waiting.max()) + 1
        ),
        "distance": learn_distribution(
            variables, parents("next", "next_x"), column(ialm.THE_DISTANCE).astype(np.int64), MAX_DISTANCE + 1
        ),
        "next_lost": lost_table,
        "visible": learn_distribution(
            variables, parents("next", "next_x"), (following.next_configuration > 0).astype(np.int64), 2
        ),
        "outcome": learn_by(
            3 * n + ialm.PERSON,
            "person",
            variables,
            parents("motion", "visible", "distance", "next_lost", "x", "y"),
            outcome,
            int(outcome.max()) + 1,
        ),
        "reward": learn_mean(
            variables,
            parents("action", "motion", "next", "visible", "distance", "next_lost", "outcome"),
            following.reward,
        ),
    }
    known_codes, person_counts = _known_codes(codec, crossing, following)
    first = following.t == following.t.min()
    poses, counts = np.unique(following.relative_pose[first], axis=0, return_counts=True)
    return IALM(
        dbn=dbn,
        motion=motion,
        tables=tables,
        known_codes=known_codes,
        person_counts=person_counts,
        initial_poses=poses.astype(np.int16),
        initial_pose_counts=counts.astype(np.int64),
        initial_waiting=np.bincount(following.waiting[first].clip(0)).astype(np.int64),
        leaf_values=_leaf_values(motion, variables[:, 3 * n :], following, discount),
        view_size=int(following.view.shape[-1]),
        provenance=dict(provenance or {}),
    )


def joined(first: Experience, second: Experience) -> Experience:
    """The rows of both; episodes of the second are renumbered to follow those of the first."""
    columns = {field.name: (getattr(first, field.name), getattr(second, field.name)) for field in fields(first)}
    shift = first.episode.max(initial=-1) + 1
    columns["episode"] = (first.episode, second.episode + shift)
    return type(first)(**{name: np.concatenate(pair) for name, pair in columns.items()})


def _some_crossing(experience: Experience) -> Experience:
    """Steps of the crossing task, at most `_MOST_CROSSING`, evenly spread."""
    rows = np.flatnonzero(np.char.startswith(experience.source, "crossing"))
    return experience.select(rows[:: max(1, -(-len(rows) // _MOST_CROSSING))])


def _known_codes(codec: Codec, crossing: Experience, following: Experience) -> tuple[np.ndarray, np.ndarray]:
    """The distinct codes of robots and of persons, uint8 [V, N], and how often persons had them, float64 [V]."""
    views = np.concatenate([following.person_view, crossing.view, following.view, following.next_view])
    known, number = np.unique(codec.codes(views), axis=0, return_inverse=True)
    of_persons = number.reshape(-1)[: len(following)]
    return known, np.bincount(of_persons, minlength=len(known)).astype(np.float64)


def _slot_names(num_factors: int) -> list[str]:
    codes = [f"{prefix}{i}" for prefix in ("x", "next_x", "y") for i in range(num_factors)]
    return codes + list(SCALARS)


def _variables(
    num_factors: int, codec: Codec, experience: Experience, motion: RelativeMotion, moved: np.ndarray
) -> np.ndarray:
    """All variables of every step: int32 [n, 3N + len(SCALARS)]; `next_lost` is left 0."""
    n = num_factors
    out = np.zeros((len(experience), 3 * n + len(SCALARS)), np.int32)
    out[:, :n] = codec.codes(experience.view)
    out[:, n : 2 * n] = codec.codes(experience.next_view)
    out[:, 2 * n : 3 * n] = codec.codes(experience.person_view)
    action = experience.action.astype(np.int64)
    effective = np.where(moved, action, STAY)
    middle = motion.apply(experience.relative_pose, effective, np.full(len(action), WAIT))
    outcome = np.where(experience.outcome == TIMEOUT, 0, experience.outcome)
    columns: dict[int, np.ndarray] = {
        ialm.ACTION: action,
        ialm.MOTION: effective,
        ialm.PERSON: experience.person_action,
        ialm.IS_WAITING: experience.waiting,
        ialm.LOST_COUNT: experience.lost,
        ialm.THE_DISTANCE: np.rint(experience.distance).clip(0, MAX_DISTANCE),
        ialm.IS_VISIBLE: experience.next_configuration > 0,
        ialm.THE_OUTCOME: outcome,
    }
    for start, pose in (
        (ialm.SIDE, experience.relative_pose),
        (ialm.MID_SIDE, middle),
        (ialm.NEXT_SIDE, experience.next_relative_pose),
    ):
        shifted = motion.shifted(pose)
        for part in range(3):
            columns[start + part] = shifted[:, part]
    for scalar, values in columns.items():
        out[:, 3 * n + scalar] = values
    return out


def _next_counters(experience: Experience) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(whether the next row continues the episode, its waiting counter, its lost counter), each [n]."""
    followed = np.zeros(len(experience), np.bool_)
    followed[:-1] = (experience.episode[1:] == experience.episode[:-1]) & (experience.t[1:] == experience.t[:-1] + 1)
    followed[:-1] &= experience.source[1:] == experience.source[:-1]
    followed &= ~(experience.terminated | experience.truncated)
    waiting, lost = (np.roll(counter.astype(np.int64), -1) for counter in (experience.waiting, experience.lost))
    return followed, np.where(followed, waiting, 0), np.where(followed, lost, 0)


def _learn_moved(
    codec: Codec, crossing: Experience, variables: np.ndarray, moved: np.ndarray, parents: Parents
) -> DecisionTable:
    """P(moved | action, x, c) from following, where c shows it, and from crossing, where the view does.

    A view may look the same after a move, so one unchanged view proves nothing; a code from which `forward` never
    changed the view is one from which it does not move. Nobody is met in crossing: c is set to the farthest pose.
    """
    crossing = crossing.select(crossing.action == FORWARD)
    if len(crossing) == 0:
        return learn_distribution(variables, parents, moved.astype(np.int64), 2)
    codes = codec.codes(crossing.view)
    changed = (crossing.view != crossing.next_view).reshape(len(crossing), -1).any(axis=1)
    distinct, group, counts = np.unique(codes, axis=0, return_inverse=True, return_counts=True)
    ever = np.bincount(group.reshape(-1), changed) > 0
    alone = np.zeros((len(distinct), variables.shape[1]), np.int32)
    alone[:, : codes.shape[1]] = distinct
    alone[:, 3 * codes.shape[1] + ialm.ACTION] = FORWARD
    return learn_distribution(
        np.concatenate([variables, alone]),
        parents,
        np.concatenate([moved, ever]).astype(np.int64),
        2,
        np.concatenate([np.ones(len(moved)), counts]),
    )


def _leaf_values(motion: RelativeMotion, scalars: np.ndarray, experience: Experience, discount: float) -> np.ndarray:
    """The relational part of the experience, solved (planners.person_following.bounds)."""
    next_pose = scalars[:, ialm.NEXT_SIDE : ialm.NEXT_SIDE + 3]
    arrival = np.concatenate([next_pose, scalars[:, [ialm.NEXT_LOST_COUNT]]], axis=1)
    departure = np.concatenate([next_pose, scalars[:, [ialm.LOST_COUNT]]], axis=1)
    pose = Parents(("side", "ahead", "heading"), (0, 1, 2), (True, True, False))
    pose_and_lost = Parents((*pose.names, "lost"), (0, 1, 2, 3), (*pose.ordered, True))
    ended = (scalars[:, ialm.THE_OUTCOME] > 0).astype(np.int64)
    lost_after = scalars[:, ialm.NEXT_LOST_COUNT].astype(np.int64)
    middle = scalars[:, ialm.MID_SIDE : ialm.MID_SIDE + 3]
    return relational_values(
        motion,
        learn_distribution(middle, pose, scalars[:, ialm.PERSON].astype(np.int64), WAIT + 1),
        learn_mean(arrival, pose_and_lost, experience.reward),
        learn_distribution(arrival, pose_and_lost, ended, 2),
        learn_distribution(departure, pose_and_lost, lost_after, int(lost_after.max()) + 1),
        discount,
    )


def _learn_influence(
    dbn: TwoSliceDBN, codec: Codec, experience: Experience, following: Experience, parents: Parents
) -> DecisionTable:
    """pi(u | y) from whoever walks towards a goal by what it sees: the crossing expert, and persons followed."""
    expert = experience.select(experience.source == "crossing-expert")
    person = experience.select(
        np.char.startswith(experience.source, "following")
        & (experience.person_action >= 0)
        & (experience.person_action < WAIT)
    )
    expert = expert.select(expert.action < WAIT)
    codes = np.concatenate([codec.codes(expert.view), codec.codes(person.person_view)])
    moves = np.concatenate([expert.action, person.person_action]).astype(np.int64)
    rows, counts = np.unique(
        np.concatenate([codes.astype(np.int64), moves[:, None]], axis=1), axis=0, return_counts=True
    )
    variables = np.zeros((len(rows), 3 * dbn.num_factors), np.int32)
    variables[:, 2 * dbn.num_factors :] = rows[:, :-1]
    return learn_distribution(variables, parents, rows[:, -1], WAIT, counts)
