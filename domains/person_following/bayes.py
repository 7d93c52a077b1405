"""The exact optimum under partial observability, where the set of possible worlds is finite.

    V(b) = max_a [ r(b, a) + gamma * sum_o P(o | b, a) V(b_ao) ]

Every belief met keeps an upper and a lower bound on V. The upper bound starts as the expected full-state value
(nobody without the full state does better), the lower one as a value that nothing undercuts. Trials walk down
by the best upper bound and the widest gap, and back up both: heuristic search value iteration (Smith and
Simmons 2004) on an explicit graph of beliefs. A belief of one particle is solved at once. When the bounds of
the root meet, to `tolerance`, the optimum is known; where time runs out first, both bounds are reported.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from domains.person_following.beliefs import KEPT_STEPS, Belief, Successor, Worlds

NUM_ACTIONS = 4
_LEAST = -60.0


@dataclass(frozen=True)
class BayesResult:
    """Bounds on the discounted optimum, and what the best policy found earns without discount."""

    lower: float
    upper: float
    mean_return: float
    success: float
    seconds: float
    beliefs: int
    trials: int

    @property
    def solved(self) -> bool:
        """Whether the bounds have met."""
        return self.upper - self.lower < 0.011


@dataclass
class _Node:
    belief: Belief
    upper: float
    lower: float
    successors: list[Successor] = field(default_factory=list)
    children: list[list[_Node]] = field(default_factory=list)


class BayesSearch:
    """Heuristic search over the beliefs of some worlds."""

    def __init__(self, worlds: Worlds, tolerance: float = 0.01) -> None:
        """Put the beliefs after the first observation at the root."""
        self.worlds, self.tolerance = worlds, tolerance
        self._nodes: dict[bytes, _Node] = {}
        self.roots = [(share, self._node(belief)) for share, belief in worlds.start()]
        self.trials = 0

    def bounds(self) -> tuple[float, float]:
        """Lower and upper bound on the optimum."""
        lower = sum(share * node.lower for share, node in self.roots)
        return lower, sum(share * node.upper for share, node in self.roots)

    def run(self, time_limit: float) -> BayesResult:
        """Search until the bounds meet or the seconds are used up, then evaluate the policy found."""
        started = time.monotonic()
        while time.monotonic() - started < time_limit:
            share, node = max(self.roots, key=lambda root: root[0] * (root[1].upper - root[1].lower))
            if share * (node.upper - node.lower) * len(self.roots) < self.tolerance:
                break
            self._trial(node, self.tolerance)
            self.trials += 1
        mean_return = success = 0.0
        for share, node in self.roots:
            total, won = self._evaluate(node)
            mean_return += share * total
            success += share * won
        lower, upper = self.bounds()
        seconds = time.monotonic() - started
        return BayesResult(lower, upper, mean_return, success, seconds, len(self._nodes), self.trials)

    def _node(self, belief: Belief) -> _Node:
        key = belief.key()
        node = self._nodes.get(key)
        if node is None:
            upper = self.worlds.value(belief)
            alone = len(belief.weights) == 1 and belief.t < KEPT_STEPS
            node = self._nodes[key] = _Node(belief, upper, upper if alone else _LEAST)
        return node

    def _expand(self, node: _Node) -> None:
        if node.successors:
            return
        for action in range(NUM_ACTIONS):
            successor = self.worlds.step(node.belief, action)
            node.successors.append(successor)
            node.children.append([self._node(belief) for belief in successor.beliefs])

    def _q(self, node: _Node, action: int, bound: str) -> float:
        successor = node.successors[action]
        later = sum(
            share * getattr(child, bound)
            for share, child in zip(successor.probabilities, node.children[action], strict=True)
        )
        return successor.reward + self.worlds.discount * later

    def _trial(self, root: _Node, tolerance: float) -> None:
        path, node = [], root
        discount = self.worlds.discount
        while node.upper - node.lower > tolerance:
            self._expand(node)
            path.append(node)
            action = max(range(NUM_ACTIONS), key=lambda a, n=node: self._q(n, a, "upper"))  # type: ignore[misc]
            pairs = zip(node.successors[action].probabilities, node.children[action], strict=True)
            gaps = [(share * (child.upper - child.lower), k) for k, (share, child) in enumerate(pairs)]
            tolerance /= discount
            if not gaps or max(gaps)[0] <= 0:
                break
            node = node.children[action][max(gaps)[1]]
        for node in reversed(path):
            node.upper = min(node.upper, max(self._q(node, a, "upper") for a in range(NUM_ACTIONS)))
            node.lower = max(node.lower, max(self._q(node, a, "lower") for a in range(NUM_ACTIONS)))

    def _evaluate(self, root: _Node) -> tuple[float, float]:
        """Undiscounted return and success of the policy that takes the best lower bound."""
        total = success = 0.0
        stack = [(1.0, root)]
        while stack:
            share, node = stack.pop()
            if not node.successors and len(node.belief.weights) == 1:
                state = node.belief.particles[0].tolist()
                action = int(self.worlds.policies[state[0]][(node.belief.t, *state[1:])])
                successor = self.worlds.step(node.belief, action)
                children = [_Node(belief, 0.0, 0.0) for belief in successor.beliefs]
            else:
                self._expand(node)
                best = [self._q(node, a, "lower") for a in range(NUM_ACTIONS)]
                if max(best) <= _LEAST / 2:
                    best = [self._q(node, a, "upper") for a in range(NUM_ACTIONS)]
                action = int(np.argmax(best))
                successor, children = node.successors[action], node.children[action]
            total += share * successor.reward
            success += share * successor.success
            stack.extend((share * p, child) for p, child in zip(successor.probabilities, children, strict=True))
        return total, success
