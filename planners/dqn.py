"""Belief DQN: a value network over the belief b, the shifted belief b~ and, in input set `full`, the configuration.

    s   (b, b~) or (b, b~, one-hot configuration), flattened
    a   the robot's actions
    y   sum_{k<n} gamma^k r_{t+k} + gamma^n Q_target(s_{t+n}, argmax_a Q(s_{t+n}, a))     (double, n-step)

The sum stops at the end of an episode. What follows the end counts as worth nothing when the task itself ended
it, and is bootstrapped when only the clock did (`bootstrap`: which truncations count as the clock's).
Readable top to bottom: network, replay, training, the trained policy.
Sources: Mnih et al. 2015; van Hasselt et al. 2016 (double); Wang et al. 2016 (dueling); Schaul et al. 2016.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import nn

from domains.core import OUTCOMES, Domain
from nesy.errors import UserError
from nesy.progress import SILENT, Progress
from nesy.run_folder import atomic_path
from planners.config import DQNConfig
from planners.perception import Codec, Perception, Percepts

TIMEOUT = OUTCOMES.index("timeout")


def features(percepts: Percepts, inputs: str, num_configurations: int) -> np.ndarray:
    """The network's input: float32 [B, D] with D = 2NK, plus `num_configurations` in input set `full`."""
    count = len(percepts.codes)
    parts = [percepts.beliefs.reshape(count, -1), percepts.shifted.reshape(count, -1)]
    if inputs == "full":
        one_hot = np.zeros((count, num_configurations), np.float32)
        one_hot[np.arange(count), percepts.configurations] = 1.0
        parts.append(one_hot)
    return np.concatenate(parts, axis=1, dtype=np.float32)


class ValueNetwork(nn.Module):
    """Q(s, .): a perceptron, optionally dueling and normalised."""

    def __init__(self, num_inputs: int, num_actions: int, config: DQNConfig) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = num_inputs
        for hidden in config.hidden:
            layers.append(nn.Linear(width, hidden))
            if config.layer_norm:
                layers.append(nn.LayerNorm(hidden))
            layers.append(nn.ReLU())
            width = hidden
        self.body = nn.Sequential(*layers)
        self.advantage = nn.Linear(width, num_actions)
        self.value = nn.Linear(width, 1) if config.dueling else None

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """[B, D] -> [B, A]."""
        hidden = self.body(inputs)
        advantage = self.advantage(hidden)
        if self.value is None:
            return advantage
        return self.value(hidden) + advantage - advantage.mean(dim=1, keepdim=True)


class Replay:
    """The last steps of B environments, as rings [T, B, ...]; n-step targets are put together when sampled."""

    def __init__(self, memory: int, num_envs: int, num_inputs: int) -> None:
        self.length, self.num_envs = max(memory // num_envs, 2), num_envs
        shape = (self.length, num_envs)
        self.state = np.zeros((*shape, num_inputs), np.float32)
        self.next_state = np.zeros((*shape, num_inputs), np.float32)
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
        done: np.ndarray,
        bootstrap: np.ndarray,
    ) -> None:
        """Add one step of every environment, arrays [B, ...]."""
        row = self.written % self.length
        self.state[row], self.next_state[row] = state, next_state
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
        chance = self.priority[self._row(np.arange(rows))].reshape(-1) ** 0.6
        cumulative = np.cumsum(chance)
        flat = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right").clip(0, len(chance) - 1)
        weight = (chance[flat] * len(chance) / cumulative[-1]) ** -0.4
        return flat // self.num_envs, flat % self.num_envs, (weight / weight.max()).astype(np.float32)

    def _row(self, age: np.ndarray) -> np.ndarray:
        """Ring row of the `age`-th oldest step."""
        return (age + max(self.written - self.length, 0)) % self.length

    def n_step(
        self, age: np.ndarray, env: np.ndarray, n: int, discount: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """State, action, n-step reward, next state, and the discount of its value (0 where it does not count)."""
        newest = min(self.written, self.length) - 1
        total = np.zeros(len(age), np.float32)
        factor = np.ones(len(age), np.float32)
        last = age.copy()
        running = np.ones(len(age), np.bool_)
        for k in range(n):
            here = np.minimum(age + k, newest)
            running &= age + k <= newest
            rows = self._row(here)
            total += np.where(running, factor * self.reward[rows, env], 0)
            last = np.where(running, here, last)
            factor = np.where(running, factor * discount, factor).astype(np.float32)
            running = running & ~self.done[rows, env]
        first, end = self._row(age), self._row(last)
        factor *= self.bootstrap[end, env]
        return self.state[first, env], self.action[first, env], total, self.next_state[end, env], factor


class DQNPolicy:
    """A trained network with what is needed to use it."""

    def __init__(self, network: ValueNetwork, inputs: str, num_configurations: int, config: DQNConfig) -> None:
        self.network, self.inputs, self.num_configurations, self.config = network, inputs, num_configurations, config

    @torch.no_grad()
    def values(self, percepts: Percepts) -> np.ndarray:
        """Q-values float32 [B, A]."""
        inputs = torch.from_numpy(features(percepts, self.inputs, self.num_configurations))
        values: np.ndarray = self.network(inputs).numpy()
        return values

    def actions(self, percepts: Percepts) -> np.ndarray:
        """Greedy actions int64 [B]."""
        return self.values(percepts).argmax(axis=1)

    def save(self, path: Path) -> None:
        """Write weights and settings into one safetensors file."""
        from safetensors.torch import save_file

        first = next(iter(self.network.parameters()))
        metadata = {
            "format": "nesy-dqn",
            "inputs": self.inputs,
            "num_inputs": str(first.shape[1]),
            "num_actions": str(self.network.advantage.out_features),
            "num_configurations": str(self.num_configurations),
            "config": json.dumps(asdict(self.config)),
        }
        with atomic_path(path) as temporary:
            save_file(self.network.state_dict(), str(temporary), metadata=metadata)

    @classmethod
    def load(cls, path: Path) -> DQNPolicy:
        """Read what `save` wrote.

        Raises:
            UserError: the file is missing, damaged or no policy.
        """
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(str(path), framework="pt") as stored:
                metadata = stored.metadata() or {}
                weights = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
            values = json.loads(metadata["config"])
            config = DQNConfig(**{**values, "hidden": tuple(values["hidden"])})
            network = ValueNetwork(int(metadata["num_inputs"]), int(metadata["num_actions"]), config)
            network.load_state_dict(weights)
            return cls(network, metadata["inputs"], int(metadata["num_configurations"]), config)
        except FileNotFoundError:
            raise UserError(f"{path}: no such policy; train it with: nesy compare") from None
        except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UserError(f"{path}: damaged or not a policy ({reason}); delete it and train again") from None


def train(
    domain: Domain,
    codec: Codec,
    inputs: str,
    influence: str,
    variant: str,
    config: DQNConfig,
    seed: int,
    progress: Progress = SILENT,
) -> tuple[DQNPolicy, dict[str, np.ndarray]]:
    """Train a policy.

    Args:
        domain: gives the environments.
        codec: encodes views.
        inputs: input set, `paper` or `full`.
        influence: influence mode.
        variant: variant of the task.
        config: how to learn.
        seed: of everything random here.
        progress: told of finished episodes.

    Returns:
        The policy, and the training episodes in the order in which they ended: `return`, `length`, `outcome`
        (code), `step` (environment steps taken so far).
    """
    sequence = np.random.SeedSequence([seed, 0xD91])
    rng, perception_rng = (np.random.default_rng(child) for child in sequence.spawn(2))
    torch.set_num_threads(1)
    env = domain.make("following", config.num_envs, variant=variant, seed=int(rng.integers(2**31)))
    perception = Perception(codec, influence, perception_rng)
    num_actions = len(domain.spec.action_names)
    num_configurations = domain.spec.geometry.num_configurations
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))

    def perceive(observation: dict[str, np.ndarray], person_views: np.ndarray) -> np.ndarray:
        return features(perception(observation, person_views), inputs, num_configurations)

    observation, _ = env.reset(seed=int(rng.integers(2**31)))
    state = perceive(observation, env.person_views())
    network = _initialised(ValueNetwork(state.shape[1], num_actions, config), generator)
    target = _initialised(ValueNetwork(state.shape[1], num_actions, config), generator)
    if not config.published_target_start:
        target.load_state_dict(network.state_dict())
    weights: list[torch.Tensor] = list(network.parameters())
    target_weights: list[torch.Tensor] = list(target.parameters())
    optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    replay = Replay(config.memory, config.num_envs, state.shape[1])
    finished: list[tuple[float, int, int, int]] = []
    running_return, running_length = np.zeros(config.num_envs), np.zeros(config.num_envs, np.int64)
    steps, owed, told = 0, 0.0, 0
    with progress.task(f"dqn {inputs}/{influence}", config.episodes) as task:
        while len(finished) < config.episodes:
            done_share = len(finished) / config.episodes
            epsilon = config.epsilon_end + (config.epsilon_start - config.epsilon_end) * np.exp(
                -done_share / config.epsilon_decay
            )
            with torch.no_grad():
                action = network(torch.from_numpy(state)).argmax(dim=1).numpy()
            explore = rng.random(config.num_envs) < epsilon
            action = np.where(explore, rng.integers(num_actions, size=config.num_envs), action)
            observation, reward, terminated, truncated, infos = env.step(action)
            done = terminated | truncated
            outcome = infos["outcome_code"]
            next_state = perceive(observation, env.person_views())
            arrived = next_state
            if done.any():  # what followed the ended episodes' last steps is not what the reset brought
                arrived = next_state.copy()
                final = {name: values[done] for name, values in infos["final_obs"].items()}
                arrived[done] = perceive(final, infos["final_person_view"][done])
            clock = truncated if config.bootstrap == "truncated" else truncated & (outcome == TIMEOUT)
            bootstrap = np.ones(config.num_envs, np.bool_) if config.published_terminals else ~done | clock
            replay.add(state, action, reward * config.reward_scale, arrived, done, bootstrap)
            state = next_state
            steps += config.num_envs
            running_return += reward
            running_length += 1
            for i in np.flatnonzero(done):
                finished.append((running_return[i], int(running_length[i]), int(outcome[i]), steps))
            running_return[done], running_length[done] = 0.0, 0
            if done.any():
                recent = float(np.mean([row[0] for row in finished[-200:]]))
                task.advance(min(int(done.sum()), config.episodes - told), mean_return=recent)
                told = min(told + int(done.sum()), config.episodes)
            if steps < config.warm_up:
                continue
            owed += config.updates_per_step * config.num_envs
            for _ in range(int(owed)):
                rate = config.learning_rate + (config.final_learning_rate - config.learning_rate) * done_share
                _update(network, target, optimiser, replay, config, rate, rng)
                with torch.no_grad():
                    torch._foreach_lerp_(target_weights, weights, config.tau)
            owed -= int(owed)
    env.close()  # type: ignore[attr-defined]
    rows = finished[: config.episodes]
    episodes = {
        "return": np.array([row[0] for row in rows]),
        "length": np.array([row[1] for row in rows]),
        "outcome": np.array([row[2] for row in rows]),
        "step": np.array([row[3] for row in rows]),
    }
    return DQNPolicy(network, inputs, num_configurations, config), episodes


def _initialised(network: ValueNetwork, generator: torch.Generator) -> ValueNetwork:
    """Draw the weights from `generator` as torch's Linear draws them from its global one."""
    for module in network.modules():
        if isinstance(module, nn.Linear):
            bound = module.in_features**-0.5
            with torch.no_grad():
                module.weight.uniform_(-bound, bound, generator=generator)
                module.bias.uniform_(-bound, bound, generator=generator)
    return network


def _update(
    network: ValueNetwork,
    target: ValueNetwork,
    optimiser: torch.optim.Optimizer,
    replay: Replay,
    config: DQNConfig,
    rate: float,
    rng: np.random.Generator,
) -> None:
    """One gradient step on one batch."""
    age, env, weight = replay.draw(config.batch_size, rng, config.prioritised)
    batch = replay.n_step(age, env, config.n_step, config.discount)
    state, action, reward, next_state, factor = (torch.from_numpy(part) for part in batch)
    with torch.no_grad():
        next_values = target(next_state)
        chooser = network(next_state) if config.double else next_values
        best = next_values.gather(1, chooser.argmax(dim=1, keepdim=True)).squeeze(1)
        goal = reward + factor * best
    value = network(state).gather(1, action[:, None]).squeeze(1)
    loss = (nn.functional.smooth_l1_loss(value, goal, reduction="none") * torch.from_numpy(weight)).mean()
    for group in optimiser.param_groups:
        group["lr"] = rate
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), config.gradient_clip)
    optimiser.step()
    if config.prioritised:
        replay.priority[replay._row(age), env] = (value.detach() - goal).abs().numpy() + 1e-3
