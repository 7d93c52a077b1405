"""Beliefs over (scene, stations, what the person has in mind): exact, as there are few hypotheses.

    b(s, q, p, z, g, gone, n, lost)   a weight each; the clock is known

A step carries every hypothesis on (ways) and weighs it by what was seen: the robot's code, the person's pose
or its absence from view, and that the episode went on. An influence mode (nesy.perspective.influence) says what then
becomes of (z, g), what the person heads for and what is so:

    perspective-shift     kept as the person's moves and its imagined views over time leave it
    zero, random          the base: all candidates alike
    egocentric            the person knows of a moved goal what the robot knows (another `Ways`)
    perfect-information   the truth

If nothing explains what was seen, the belief goes on without that observation: a defined fallback, counted in `resets`.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from domains.core import FORWARD, STAY
from nesy.perspective.influence import InfluencePrior, influence
from planners.person_following.structured.frames import AHEAD
from planners.person_following.structured.known_maps.mind_checks import PERIOD
from planners.person_following.structured.known_maps.mind_walk import MindParticles
from planners.person_following.structured.known_maps.minds import MAX_WALK
from planners.person_following.structured.known_maps.ways import CLOCK, GONE, HEADS_FOR, OWN, PLACE, SCENE, Node, Ways

Truth = tuple[tuple[int, int], tuple[int, int]]
"""(side, ahead) of the place that the person heads for and of its goal, relative to the robot."""
_LEAST = 1e-6  # hypotheses below this share are dropped
_LEAST_NOISE = 1e-4
_Hypothesis = tuple[Node, int, int]  # node, robot's station, lost counter


class MindBelief:
    """A filter for one episode.

    Attributes:
        weights: the hypotheses and their probabilities.
        resets: how often nothing explained what was seen.
    """

    def __init__(self, ways: Ways, mode: str, rng: np.random.Generator) -> None:
        self.ways, self.model, self.prior = ways, ways.model, InfluencePrior(mode, rng)
        self.weights: dict[_Hypothesis, float] = {}
        self.resets = 0
        noise = max(self.model.code_noise, _LEAST_NOISE)
        self._match = np.log(1 - noise), np.log(noise)

    def reset(self, code: np.ndarray, pose: np.ndarray | None, truth: Truth | None = None) -> None:
        """Start an episode.

        Args:
            code: uint8 [N], the robot's code.
            pose: int [3], (side, ahead, heading) of the person if in view, else None.
            truth: what is in the person's mind, for `perfect-information`.
        """
        model, scenes = self.model, self.model.scenes
        start = np.array([0, 0, AHEAD])
        weights: dict[_Hypothesis, float] = {}
        for s, p, count in model.intentions.starts.tolist():
            q = int(scenes.station(np.array([s]), start[None])[0])
            for k in self.ways.candidates(s):
                node: Node = (s, 0, p, k, k, -1, 0)
                weights[node, q, 0] = count * float(model.intentions.prior[s, k])
        self.weights = weights
        self._see(code, pose)
        self._mind(truth)

    def update(self, action: int, code: np.ndarray, pose: np.ndarray | None, truth: Truth | None = None) -> float:
        """Take in one step: `action`, and what was seen after it (as in `reset`).

        Returns:
            Log-likelihood of what was seen; -inf if nothing explained it.
        """
        weights: dict[_Hypothesis, float] = {}
        following: dict[Node, list[tuple[Node, float]]] = {}
        packed, scenes = self.ways.packed, self.model.scenes
        goes_on = self.model.judgement
        for (node, q, lost), weight in self.weights.items():
            if node not in following:
                following[node] = list(self.ways.successors(node).items())
            s = node[SCENE]
            for then, moves in self._moves(node, q, action):
                for after, chance in following[node]:
                    likelihood = weight * moves * chance
                    if likelihood < 1e-12:
                        continue
                    cell, person = int(scenes.cell[s, then]), int(scenes.cell[s, after[PLACE]])
                    walk = min(int(scenes.walk[s, then, person]), MAX_WALK)
                    sight = int(scenes.sees[s, then, person] and cell != person)
                    if sight != (pose is not None):
                        continue
                    faced = int(scenes.follows[s, then, FORWARD])
                    at_goal = person == scenes.goals[s, after[OWN]]
                    enters = cell == scenes.goals[s, after[OWN]] and then != q and action == FORWARD
                    ahead = action == FORWARD and faced != then and scenes.cell[s, faced] == person
                    judged = goes_on[
                        walk, sight, int(at_goal), after[6], lost, int(enters), int(ahead), int(cell == person)
                    ]
                    key = after, then, int(packed.next_lost[walk, lost])
                    weights[key] = weights.get(key, 0.0) + likelihood * float(judged[1])
        self.weights = weights or self.weights
        likelihood = self._see(code, pose)
        self._mind(truth)
        return likelihood

    @property
    def effective(self) -> float:
        """How many hypotheses there are."""
        return float(len(self.weights))

    @property
    def states(self) -> MindParticles:
        """The belief for a search."""
        nodes = self.ways.numbers([node for node, _, _ in self.weights])
        weights = np.array(list(self.weights.values()))
        return MindParticles(
            np.cumsum(weights / weights.sum()),
            nodes,
            np.array([q for _, q, _ in self.weights], np.int64),
            np.array([lost for _, _, lost in self.weights], np.int64),
        )

    def influence(self) -> np.ndarray:
        """I(u | l) = sum over (p, z) of pi(u | p, z) b(p, z): float64 [4]."""
        nodes = np.array([node for node, _, _ in self.weights])
        policy = self.ways.policy[nodes[:, SCENE], nodes[:, HEADS_FOR], nodes[:, PLACE]]
        return influence(policy, np.array(list(self.weights.values())))

    @property
    def window(self) -> int:
        """W of `pose_marginal`."""
        return int(self.model.scenes.kinds.shape[1])

    def pose_marginal(self) -> np.ndarray:
        """P(c): float64 [2W + 1, 2W + 1, 4] over side, ahead, heading (for pictures)."""
        out = np.zeros((2 * self.window + 1, 2 * self.window + 1, 4))
        for (node, q, _), weight in self.weights.items():
            side, ahead, heading = self.model.scenes.relative(
                *(np.array([part]) for part in (node[SCENE], q, node[PLACE]))
            )[0]
            out[side + self.window, ahead + self.window, heading] += weight
        return out

    def person_marginals(self) -> np.ndarray:
        """P(y_i = k): float64 [N, K], what the person sees where it may be (for pictures)."""
        ways = self.ways
        out = np.zeros((ways.codes.shape[1], ways.num_values))
        for (node, _, _), weight in self.weights.items():
            gone = 0 if node[GONE] < 0 else 1 << node[GONE]
            code = ways.codes[ways.packed.shows[node[SCENE], node[PLACE], gone]]
            out[np.arange(len(code)), code] += weight
        return out

    def _moves(self, node: Node, q: int, action: int) -> list[tuple[int, float]]:
        if action == STAY:
            return [(q, 1.0)]
        scenes, s = self.model.scenes, node[SCENE]
        faced = int(scenes.follows[s, q, FORWARD])
        wall = int(action == FORWARD and faced == q)
        person = int(faced != q and scenes.cell[s, faced] == scenes.cell[s, node[PLACE]])
        t = node[CLOCK]
        while t > self.model.horizon:
            t -= PERIOD
        moved = float(self.model.moved_chance[t, action, wall, person])
        return [(int(scenes.follows[s, q, action]), moved), (q, 1.0 - moved)]

    def _see(self, code: np.ndarray, pose: np.ndarray | None) -> float:
        """Weigh the hypotheses by the robot's code and by where the person is, and drop what is out of the question."""
        if not self.weights:
            return -np.inf
        scenes, ways = self.model.scenes, self.ways
        keys = list(self.weights)
        prior = np.array(list(self.weights.values()))
        nodes = np.array([node for node, _, _ in keys])
        s, p, q = nodes[:, SCENE], nodes[:, PLACE], np.array([station for _, station, _ in keys])
        person = scenes.cell[s, p]
        sight = scenes.sees[s, q, person] & (scenes.cell[s, q] != person)
        covered = (scenes.goals[s] == person[:, None]) & sight[:, None]
        gone = nodes[:, GONE][:, None] == np.arange(scenes.goals.shape[1])
        hidden = ((covered | gone) << np.arange(scenes.goals.shape[1])).sum(1)
        expected = ways.codes[ways.packed.shows[s, q, hidden]]
        wrong = (expected != code).sum(1)
        log = (expected.shape[1] - wrong) * self._match[0] + wrong * self._match[1]
        if pose is None:
            log = np.where(sight, -np.inf, log)
        else:
            at = scenes.relative(s, q, p)
            log = np.where(sight & (at == np.asarray(pose)).all(1), log, -np.inf)
        weights = prior * np.exp(log)
        total = float(weights.sum())
        if not total > 0.0:
            self.resets += 1
            weights, total = prior, float(prior.sum())
            found = -np.inf
        else:
            found = float(np.log(total / prior.sum()))
        weights = weights / total
        self.weights = {key: float(w) for key, w in zip(keys, weights, strict=True) if w > _LEAST}
        return found

    def _mind(self, truth: Truth | None) -> None:
        """Put what the influence mode has in the person's mind."""
        if self.prior.mode in ("perspective-shift", "egocentric"):
            return
        weights: dict[_Hypothesis, float] = {}
        self.prior.renew()
        for (node, q, lost), weight in self.weights.items():
            for other, share in self._minds(node, q, truth):
                weights[other, q, lost] = weights.get((other, q, lost), 0.0) + weight * share
        if weights:
            total = sum(weights.values())
            self.weights = {key: weight / total for key, weight in weights.items()}

    def _minds(self, node: Node, q: int, truth: Truth | None) -> Iterable[tuple[Node, float]]:
        s, t, p, _, _, gone, standing = node
        if self.prior.mode == "perfect-information" and truth is not None:
            cells = [self.model.scenes.cell_at(s, q, place) for place in truth]
            which = [
                self.model.scenes.goals[s].tolist().index(c) if c in self.model.scenes.goals[s] else -1 for c in cells
            ]
            if min(which) >= 0:
                left = gone if which[0] == which[1] else which[0]
                return [((s, t, p, which[0], which[1], left, standing), 1.0)]
            return [(node, 1e-9)]
        candidates = self.ways.candidates(s, gone)
        shares = zip(candidates, self.prior.base(np.ones(len(candidates))).tolist(), strict=True)
        return [((s, t, p, k, k, gone, standing), share) for k, share in shares if share > 0]
