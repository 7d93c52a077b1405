"""The exact optimum under partial observability, where the set of possible worlds is finite.

    V(b) = max_a [ r(b, a) + gamma * sum_o P(o | b, a) V(b_ao) ]

Every belief met keeps an upper and a lower bound on V. The upper bound starts as the expected full-state value
(nobody without the full state does better), the lower one as a value that nothing undercuts. Trials walk down
by the best upper bound and the widest gap, and back up both: heuristic search value iteration (Smith and
Simmons 2004) on an explicit graph of beliefs. A belief of one particle is solved at once. When the bounds of
the root meet, to `tolerance`, the optimum is known; where the graph grows too large first, both bounds are reported.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from domains.core import DomainError
from domains.person_following.oracles.beliefs import KEPT_STEPS, Belief, Gains, Successor, Worlds
from domains.person_following.simulation.batch import NUM_ACTIONS

_LEAST = -60.0


MAX_BELIEFS = 200_000


@dataclass(frozen=True)
class BayesResult:
    """Bounds on the discounted optimum, and what the best policy found earns in every world."""

    lower: float
    upper: float
    gains: Gains
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

    def __init__(self, worlds: Worlds, tolerance: float = 0.01, max_beliefs: int = MAX_BELIEFS) -> None:
        """Put the beliefs after the first observation at the root."""
        self.worlds, self.tolerance, self.max_beliefs = worlds, tolerance, max_beliefs
        self._nodes: dict[bytes, _Node] = {}
        start = worlds.start()
        self.roots = [
            (share, self._node(belief)) for share, belief in zip(start.probabilities, start.beliefs, strict=True)
        ]
        self.trials = 0

    def bounds(self) -> tuple[float, float]:
        """Lower and upper bound on the optimum."""
        lower = sum(share * node.lower for share, node in self.roots)
        return lower, sum(share * node.upper for share, node in self.roots)

    def run(self) -> BayesResult:
        """Search until the bounds meet or the graph is full, then evaluate the policy found."""
        while len(self._nodes) < self.max_beliefs:
            share, node = max(self.roots, key=lambda root: root[0] * (root[1].upper - root[1].lower))
            if share * (node.upper - node.lower) * len(self.roots) < self.tolerance:
                break
            self._trial(node)
        gains = Gains(*(np.zeros(len(self.worlds.chains)) for _ in range(3)))
        stack = [(share, node.belief) for share, node in self.roots]
        while stack:
            share, belief = stack.pop()
            successor = self.worlds.step(belief, self.action(belief), gains, share)
            later = zip(successor.probabilities, successor.beliefs, strict=True)
            stack.extend((share * probability, after) for probability, after in later)
        lower, upper = self.bounds()
        return BayesResult(lower, upper, gains, len(self._nodes), self.trials)

    def action(self, belief: Belief) -> int:
        """The best action in a belief, which is solved first where no search has come by yet.

        Raises:
            DomainError: the graph of beliefs is full.
        """
        node = self._node(belief)
        self._expand(node)
        lower = [self._q(node, a, "lower") for a in range(NUM_ACTIONS)]
        if max(lower) <= _LEAST / 2:
            self._solve(node)
            lower = [self._q(node, a, "lower") for a in range(NUM_ACTIONS)]
        return int(np.argmax(lower))

    def solve(self, belief: Belief) -> int:
        """The best action in a belief that is solved for its own sake, whatever the search at the root has left open.

        Raises:
            DomainError: the graph of beliefs is full.
        """
        node = self._node(belief)
        self._expand(node)
        self._solve(node)
        return self.action(belief)

    def _solve(self, node: _Node) -> None:
        while node.upper - node.lower > self.tolerance:
            if len(self._nodes) >= self.max_beliefs:
                raise DomainError(f"the search over beliefs did not close within {self.max_beliefs} of them")
            self._trial(node)

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

    def _trial(self, root: _Node) -> None:
        path, node, tolerance = [], root, self.tolerance
        self.trials += 1
        while node.upper - node.lower > tolerance:
            self._expand(node)
            path.append(node)
            action = max(range(NUM_ACTIONS), key=lambda a, n=node: self._q(n, a, "upper"))  # type: ignore[misc]
            pairs = zip(node.successors[action].probabilities, node.children[action], strict=True)
            gaps = [(share * (child.upper - child.lower), k) for k, (share, child) in enumerate(pairs)]
            tolerance /= max(self.worlds.discount, 1e-6)
            if not gaps or max(gaps)[0] <= 0:
                break
            node = node.children[action][max(gaps)[1]]
        for node in reversed(path):
            node.upper = min(node.upper, max(self._q(node, a, "upper") for a in range(NUM_ACTIONS)))
            node.lower = max(node.lower, max(self._q(node, a, "lower") for a in range(NUM_ACTIONS)))
