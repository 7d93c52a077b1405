"""Compiled sweeps of the full-state optimum: rewards as tables, a pass backward and a pass forward.

    state    (t, person state p, waiting w, robot pose c, steps at the goal g, lost counter l)

`p` and `c` are numbers of a `PersonChain`. `g` is 0 on the way and 1 .. patience + 1 (saturating) at the goal.
A step goes (p, w, c) -> the robot's new pose -> the person's new state -> reward; what follows the robot's
move depends on the action only through a bumping penalty and through entering the goal, so the best
continuation of every (person state, pose) is computed once per t and shared by all that lead there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from domains.core import FORWARD, STAY
from domains.person_following.oracles.person_chain import PersonChain
from domains.person_following.simulation.batch import NUM_ACTIONS
from domains.person_following.simulation.compiled import entry, inner
from domains.person_following.simulation.paths import STEPS
from domains.person_following.variants import (
    R_GOAL_PATIENCE,
    R_MAX_LOST,
    R_MAX_STEPS,
    R_PERSON_REST,
    R_ROBOT_REST,
    Parameters,
)


class StepTables(NamedTuple):
    """What a step brings on one map, by person state [P] and robot pose [C] after the step."""

    reward: NDArray[np.float64]  # [P, C]
    bump: NDArray[np.float64]  # [P, C]: added where the robot's action was forward
    far: NDArray[np.bool_]  # [P, C]: beyond the follow distance
    won: NDArray[np.bool_]  # [P, C]
    waits: NDArray[np.bool_]  # [P, C]: the person, before its move, wants to wait for a robot there
    enters: NDArray[np.bool_]  # [2, C]: stepping forward enters a goal, if nobody blocks; before and after
    moved_at: int  # the step from which the second row of `enters` holds
    moves: NDArray[np.int64]  # [P, C, 4]
    successors: NDArray[np.int64]  # [P, 2]
    at_goal: NDArray[np.bool_]  # [P]


def step_tables(chain: PersonChain, parameters: Parameters) -> StepTables:
    """The tables of one map under some parameters."""
    people, poses = chain.person, chain.poses
    x, y, h = poses[:, 0], poses[:, 1], poses[:, 2]
    ahead = np.array(STEPS)
    front_x, front_y = x + ahead[h, 0], y + ahead[h, 1]
    far = chain.distance > parameters.follow_distance
    same = (people[:, None, 0] == x) & (people[:, None, 1] == y)
    visible = chain.configuration > 0
    won = ~far & visible & chain.at_goal[:, None]
    near = np.where(chain.distance > 0, 1.5 / (1.0 + chain.distance), 0.0) + 0.5 * visible
    reward = np.where(far, -0.05 * chain.distance, near + 100.0 * won) - 0.01 * same
    bump = np.where((people[:, None, 0] == front_x) & (people[:, None, 1] == front_y), -0.01, 0.0)
    waits = (~visible | far) if parameters.look_back else np.zeros_like(far)
    return StepTables(
        reward,
        bump,
        far,
        won,
        waits,
        np.stack([(front_x == goal_x) & (front_y == goal_y) for goal_x, goal_y in chain.goals]),
        chain.moved_at,
        chain.moves,
        chain.successors,
        chain.at_goal,
    )


@entry
def reachable_states(rules, successors, reached):  # type: ignore[no-untyped-def]
    """Mark in `reached` [T, P, W] the person states and waiting counters in which a step t can begin."""
    for w in range(reached.shape[2]):
        reached[0, 0, w] = True
    for t in range(reached.shape[0] - 1):
        rests = rules[R_PERSON_REST] > 0 and (t + 1) % rules[R_PERSON_REST] == 0
        for p in range(reached.shape[1]):
            for w in range(reached.shape[2]):
                if not reached[t, p, w]:
                    continue
                if rests:
                    reached[t + 1, p, w] = True
                    continue
                if w + 1 < reached.shape[2]:
                    reached[t + 1, p, w + 1] = True
                reached[t + 1, successors[p, 0], 0] = True
                reached[t + 1, successors[p, 1], 0] = True


@inner
def _arrive(rules, tables, reached, discount, t, value, total, success, arrive):  # type: ignore[no-untyped-def]
    """Fill `arrive` [3, P, W, C, G, L]: what arriving in a state at the end of step t is worth."""
    reward, _, far, won, _, _, _, _, _, at_goal = tables
    patience, max_lost = rules[R_GOAL_PATIENCE], rules[R_MAX_LOST]
    _, people, waits, poses, stands, losts = arrive.shape
    last = t == reached.shape[0] - 1
    later = (t + 1) & 1
    for p in range(people):
        for w in range(waits):
            if not last and not reached[t + 1, p, w]:
                continue
            for c in range(poses):
                for g in range(stands):
                    stood = min(g + 1, patience + 1) if at_goal[p] else 0
                    for l in range(losts):  # noqa: E741
                        v = reward[p, c]
                        u = v
                        s = 0.0
                        ended = last
                        lost = 0
                        if far[p, c]:
                            lost = l + 1
                            ended = ended or lost >= max_lost or (at_goal[p] and stood > patience)
                        elif won[p, c]:
                            ended = True
                            s = 1.0
                        if not ended:
                            v += discount * value[later, p, w, c, stood, lost]
                            u += total[later, p, w, c, stood, lost]
                            s += success[later, p, w, c, stood, lost]
                        arrive[0, p, w, c, g, l] = v
                        arrive[1, p, w, c, g, l] = u
                        arrive[2, p, w, c, g, l] = s


@entry
def sweep_backward(rules, tables, reached, discount, policy, value, total, success, kept):  # type: ignore[no-untyped-def]
    """Fill `policy` [T, P, W, C, G, L]; tables [2, P, W, C, G, L] end with t = 0 in their first half.

    `value` is discounted; `total` and `success` are the undiscounted return and the success of the policy.
    `kept` [K, P, W, C, G, L] gets the values of the first K steps.
    """
    reward, bump, _, won, waits, enters, moved_at, moves, successors, at_goal = tables
    steps, people, num_waits, poses, stands, losts = policy.shape
    arrive = np.zeros((3, people, num_waits, poses, stands, losts))
    first, second = np.empty(NUM_ACTIONS, np.int64), np.empty(NUM_ACTIONS, np.int64)
    waiting, to = np.empty(NUM_ACTIONS, np.int64), np.empty(NUM_ACTIONS, np.int64)
    extra, ends = np.empty(NUM_ACTIONS), np.empty(NUM_ACTIONS, np.bool_)
    for t in range(steps - 1, -1, -1):
        now = t & 1
        _arrive(rules, tables, reached, discount, t, value, total, success, arrive)
        rests = rules[R_PERSON_REST] > 0 and (t + 1) % rules[R_PERSON_REST] == 0
        held = rules[R_ROBOT_REST] > 0 and (t + 1) % rules[R_ROBOT_REST] == 0
        after = 1 if t + 1 >= moved_at else 0
        bonus = 1.0 - 0.9 * ((t + 1) / rules[R_MAX_STEPS])
        for p in range(people):
            # On the way the counter at the goal is 0; at the goal it is at least 1.
            low, high = (1, stands) if at_goal[p] else (0, 1)
            for w in range(num_waits):
                if not reached[t, p, w]:
                    continue
                for c in range(poses):
                    for action in range(NUM_ACTIONS):
                        act = STAY if held else action
                        to[action] = moves[p, c, act]
                        first[action], second[action] = successors[p, 0], successors[p, 1]
                        waiting[action] = 0
                        if rests:
                            first[action], second[action], waiting[action] = p, p, w
                        elif waits[p, to[action]] and w + 1 < 3:
                            first[action], second[action], waiting[action] = p, p, w + 1
                        extra[action], ends[action] = 0.0, False
                        if act == FORWARD:
                            extra[action] = 0.5 * (bump[first[action], to[action]] + bump[second[action], to[action]])
                            if to[action] != c and enters[after, c]:
                                # The episode ends here, with what this step alone brings.
                                extra[action] += bonus
                                ends[action] = True
                    for g in range(low, high):
                        for l in range(losts):  # noqa: E741
                            best, chosen = -np.inf, 0
                            for action in range(NUM_ACTIONS):
                                a, b, w2, c2 = first[action], second[action], waiting[action], to[action]
                                if ends[action]:
                                    v = 0.5 * (reward[a, c2] + reward[b, c2])
                                else:
                                    v = 0.5 * (arrive[0, a, w2, c2, g, l] + arrive[0, b, w2, c2, g, l])
                                v += extra[action]
                                if v > best + 1e-12:
                                    best, chosen = v, action
                            a, b, w2, c2 = first[chosen], second[chosen], waiting[chosen], to[chosen]
                            if ends[chosen]:
                                u = 0.5 * (reward[a, c2] + reward[b, c2])
                                s = 0.5 * (won[a, c2] + won[b, c2])
                            else:
                                u = 0.5 * (arrive[1, a, w2, c2, g, l] + arrive[1, b, w2, c2, g, l])
                                s = 0.5 * (arrive[2, a, w2, c2, g, l] + arrive[2, b, w2, c2, g, l])
                            policy[t, p, w, c, g, l] = chosen
                            value[now, p, w, c, g, l] = best
                            total[now, p, w, c, g, l] = u + extra[chosen]
                            success[now, p, w, c, g, l] = s
                            if t < kept.shape[0]:
                                kept[t, p, w, c, g, l] = best


@entry
def follow_policy(rules, tables, policy, start, states, actions):  # type: ignore[no-untyped-def]
    """Collect the states [n, 6] that the policy reaches from `start` at t = 0, and its actions [n]; returns n.

    Collecting stops when the arrays are full.
    """
    _, _, far, won, waits, enters, moved_at, moves, successors, at_goal = tables
    patience = rules[R_GOAL_PATIENCE]
    seen = np.zeros(policy.shape[1:], np.int32)
    count = policy.shape[2]
    for w in range(count):
        for i in range(6):
            states[w, i] = 0
        states[w, 2] = w
        states[w, 3] = start
    done = 0
    while done < count:
        t, p, w, c, g, l = (  # noqa: E741
            states[done, 0],
            states[done, 1],
            states[done, 2],
            states[done, 3],
            states[done, 4],
            states[done, 5],
        )
        chosen = policy[t, p, w, c, g, l]
        actions[done] = chosen
        done += 1
        if rules[R_ROBOT_REST] > 0 and (t + 1) % rules[R_ROBOT_REST] == 0:
            chosen = STAY
        to = moves[p, c, chosen]
        if t + 1 >= policy.shape[0] or (chosen == FORWARD and to != c and enters[1 if t + 1 >= moved_at else 0, c]):
            continue
        for branch in range(2):
            after, w2 = successors[p, branch], 0
            if rules[R_PERSON_REST] > 0 and (t + 1) % rules[R_PERSON_REST] == 0:
                after, w2 = p, w
            elif waits[p, to] and w + 1 < 3:
                after, w2 = p, w + 1
            stood = min(g + 1, patience + 1) if at_goal[after] else 0
            lost = l + 1 if far[after, to] else 0
            ended = won[after, to] or lost >= rules[R_MAX_LOST]
            if ended or (far[after, to] and at_goal[after] and stood > patience):
                continue
            if seen[after, w2, to, stood, lost] == t + 1 or count >= states.shape[0]:
                continue
            seen[after, w2, to, stood, lost] = t + 1
            states[count, 0], states[count, 1], states[count, 2] = t + 1, after, w2
            states[count, 3], states[count, 4], states[count, 5] = to, stood, lost
            count += 1
    return count
