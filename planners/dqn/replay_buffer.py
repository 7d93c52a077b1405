"""The replay memory: the last steps of B environments, from which n-step targets are put together when sampled.

    sum_{k<n} gamma^k r_{t+k}, s_{t+n}, and gamma^n where the value of s_{t+n} counts, else 0

The sum stops where an episode ended. Priorities: Schaul et al., "Prioritized experience replay", 2016.
"""

from __future__ import annotations

import numpy as np
import torch


class Replay:
    """The last steps of B environments, as rings [T, B, ...]; n-step targets are put together when sampled."""

    def __init__(self, memory: int, num_envs: int, num_inputs: int, num_actions: int) -> None:
        self.length, self.num_envs = max(memory // num_envs, 2), num_envs
        shape = (self.length, num_envs)
        self.state = np.zeros((*shape, num_inputs), np.float32)
        self.next_state = np.zeros((*shape, num_inputs), np.float32)
        self.next_allowed = np.ones((*shape, num_actions), np.bool_)
        self.action = np.zeros(shape, np.int64)
        self.reward = np.zeros(shape, np.float32)
        self.done = np.zeros(shape, np.bool_)  # the episode ended here
        self.bootstrap = np.zeros(shape, np.bool_)  # the value of next_state counts
        self.priority = np.zeros(shape, np.float64)
        self.written = 0

    def __len__(self) -> int:
        return min(self.written, self.length) * self.num_envs

    def add(
        self,
        state: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        next_state: np.ndarray,
        next_allowed: np.ndarray | None,
        done: np.ndarray,
        bootstrap: np.ndarray,
    ) -> None:
        """Add one step of every environment, arrays [B, ...]."""
        row = self.written % self.length
        self.state[row], self.next_state[row] = state, next_state
        if next_allowed is not None:
            self.next_allowed[row] = next_allowed
        self.action[row], self.reward[row] = action, reward
        self.done[row], self.bootstrap[row] = done, bootstrap
        self.priority[row] = max(float(self.priority.max()), 1.0) if self.written else 1.0
        self.written += 1

    def draw(
        self, count: int, rng: np.random.Generator, prioritised: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(age-ordered row, environment, importance weight) of `count` steps."""
        rows = min(self.written, self.length)
        if not prioritised:
            return rng.integers(rows, size=count), rng.integers(self.num_envs, size=count), np.ones(count, np.float32)
        chance = self.priority[self.row(np.arange(rows))].reshape(-1) ** 0.6
        cumulative = np.cumsum(chance)
        flat = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right").clip(0, len(chance) - 1)
        weight = (chance[flat] * len(chance) / cumulative[-1]) ** -0.4
        return flat // self.num_envs, flat % self.num_envs, (weight / weight.max()).astype(np.float32)

    def row(self, age: np.ndarray) -> np.ndarray:
        """Ring row of the `age`-th oldest step."""
        return (age + max(self.written - self.length, 0)) % self.length

    def n_step(self, age: np.ndarray, env: np.ndarray, n: int, discount: float) -> tuple[np.ndarray, ...]:
        """State, action, n-step reward, next state, the discount of its value (0: it does not count), and its mask."""
        newest = min(self.written, self.length) - 1
        total = np.zeros(len(age), np.float32)
        factor = np.ones(len(age), np.float32)
        last = age.copy()
        running = np.ones(len(age), np.bool_)
        for k in range(n):
            here = np.minimum(age + k, newest)
            running &= age + k <= newest
            rows = self.row(here)
            total += np.where(running, factor * self.reward[rows, env], 0)
            last = np.where(running, here, last)
            factor = np.where(running, factor * discount, factor).astype(np.float32)
            running = running & ~self.done[rows, env]
        first, end = self.row(age), self.row(last)
        factor *= self.bootstrap[end, env]
        states = self.state[first, env], self.action[first, env], total, self.next_state[end, env]
        return *states, factor, self.next_allowed[end, env]


def distinct(rows: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """The distinct ones of float32 `rows` [B, D], [U, D], and for each row which of them it is, int64 [B]."""
    whole = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    _, first, which = np.unique(whole, return_index=True, return_inverse=True)
    return torch.from_numpy(rows[first]), torch.from_numpy(which)
