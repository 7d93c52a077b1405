"""Belief DQN: a value network over the belief b, the shifted belief b~ and, in input set `full`, the configuration.

    s   (b, b~) or (b, b~, one-hot configuration), flattened
    a   the robot's actions
    y   sum_{k<n} gamma^k r_{t+k} + gamma^n Q_target(s_{t+n}, argmax_a Q(s_{t+n}, a))     (double, n-step)

The sum stops at the end of an episode. What follows the end counts as worth nothing when the task itself ended
it, and is bootstrapped when only the clock did (`bootstrap`: which truncations count as the clock's).
Readable top to bottom: network, trained policy, learning; the replay memory is planners/dqn/replay_buffer.py. A mask of
allowed actions (a shield) holds for exploring, for acting and for the action that the target is made with.
Sources: Mnih et al. 2015; van Hasselt et al. 2016 (double); Wang et al. 2016 (dueling).
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from domains.core import OUTCOMES, Domain, completed
from nesy.errors import UserError
from nesy.progress import SILENT, Progress
from nesy.run_folder import atomic_path, parse_json
from planners.config import DQNConfig
from planners.dqn.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from planners.dqn.published import dqn_perception
from planners.dqn.replay_buffer import Replay, distinct
from planners.perception import Codec, Perception, Percepts
from planners.shielding import ActionMask

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


class DQNPolicy:
    """A trained network with what is needed to use it."""

    def __init__(
        self,
        network: ValueNetwork,
        inputs: str,
        num_configurations: int,
        config: DQNConfig,
        trained: Mapping[str, Any] | None = None,
    ) -> None:
        self.network, self.inputs, self.num_configurations, self.config = network, inputs, num_configurations, config
        self.trained = dict(trained or {})
        """What it was trained with: `influence`, `variant`, `seed`, `episodes`, `steps`."""

    @torch.no_grad()
    def values(self, percepts: Percepts) -> np.ndarray:
        """Q-values float32 [B, A]."""
        inputs = torch.from_numpy(features(percepts, self.inputs, self.num_configurations))
        values: np.ndarray = self.network(inputs).numpy()
        return values

    def actions(self, percepts: Percepts, allowed: np.ndarray | None = None) -> np.ndarray:
        """Greedy actions int64 [B] among the allowed ones, bool [B, A]."""
        values = self.values(percepts)
        return (values if allowed is None else np.where(allowed, values, -np.inf)).argmax(axis=1)

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
            "trained": json.dumps(self.trained),
        }
        with atomic_path(path) as temporary:
            # One entry, since safetensors writes several in any order: the same policy is to give the same bytes.
            save_file(self.network.state_dict(), str(temporary), metadata={"policy": json.dumps(metadata)})

    @classmethod
    def load(cls, path: Path) -> DQNPolicy:
        """Read what `save` wrote.

        Raises:
            UserError: the file is missing, damaged or no policy.
        """
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(str(path), framework="pt") as stored:
                metadata = parse_json((stored.metadata() or {})["policy"])
                weights = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
            values = parse_json(metadata["config"])
            config = DQNConfig(**{**values, "hidden": tuple(values["hidden"])})
            network = ValueNetwork(int(metadata["num_inputs"]), int(metadata["num_actions"]), config)
            network.load_state_dict(weights)
            trained = parse_json(metadata.get("trained", "{}"))
            return cls(network, metadata["inputs"], int(metadata["num_configurations"]), config, trained)
        except FileNotFoundError:
            raise UserError(f"{path}: no such policy; train it with: nesy compare") from None
        except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UserError(f"{path}: damaged or not a policy ({reason}); delete it and train again") from None


def train(
    training: Training, progress: Progress = SILENT, checkpoint: Path | None = None
) -> tuple[DQNPolicy, dict[str, np.ndarray]]:
    """Train to the end.

    Args:
        training: what is learned, as it stands.
        progress: told of finished episodes.
        checkpoint: a file from which a stopped training goes on, with the same results; None to do without.

    Returns:
        The policy, and the training episodes in the order in which they ended: `return`, `length`, `outcome`
        (code), `step` (environment steps taken so far).
    """
    torch.set_num_threads(1)
    config = training.config
    if checkpoint is not None:
        training.resume(checkpoint)
    told, saved = 0, time.monotonic()
    with progress.task(f"dqn {training.inputs}/{training.about['influence']}", config.episodes) as task:
        while not training.over:
            training.step(training.choose())
            training.learn()
            new = round(training.share * config.episodes) - told
            if new > 0:
                told += new
                recent = [row[0] for row in training.finished[-200:]]
                task.advance(new, mean_return=float(np.mean(recent)) if recent else 0.0)
            if checkpoint is not None and time.monotonic() - saved > config.checkpoint_seconds:
                training.save(checkpoint)
                saved = time.monotonic()
    if checkpoint is not None:
        training.save(checkpoint)
    training.env.close()
    finished = training.finished if config.steps else training.finished[: config.episodes]
    kinds = {"return": np.float64, "length": np.int64, "outcome": np.int64, "step": np.int64}
    return training.policy(), {
        name: np.array([row[at] for row in finished], kind) for at, (name, kind) in enumerate(kinds.items())
    }


class Training:
    """One training: choose actions, take a step in all environments, learn from the memory; again and again."""

    def __init__(
        self,
        domain: Domain,
        codec: Codec,
        inputs: str,
        influence: str,
        variant: str,
        config: DQNConfig,
        seed: int,
        mask: ActionMask | None = None,
        perception: Perception | None = None,
    ) -> None:
        """Set everything up.

        Args:
            domain: gives the environments.
            codec: encodes views.
            inputs: input set, `paper` or `full`.
            influence: influence mode.
            variant: variant of the task.
            config: how to learn.
            seed: of everything random here.
            mask: the allowed actions; None for all.
            perception: what makes b~, where that is another than influence mode and settings ask for.
        """
        config = config.at(domain.spec.discount(variant))
        self.config, self.inputs, self.mask = config, inputs, mask
        self.about = {"influence": influence, "variant": variant, "seed": seed, "episodes": config.episodes}
        self.num_actions = len(domain.spec.action_names)
        self.num_configurations = domain.spec.geometry.num_configurations
        sequence = np.random.SeedSequence([seed, 0xD91])
        self.rng, perception_rng = (np.random.default_rng(child) for child in sequence.spawn(2))
        task, first_seed = domain.spec.main_task, int(self.rng.integers(2**31))
        self.env: Any = completed(domain).make(task, config.num_envs, variant=variant, seed=first_seed)
        self.perception = perception or dqn_perception(codec, influence, perception_rng, config)
        generator = torch.Generator().manual_seed(int(self.rng.integers(2**62)))
        observation, _ = self.env.reset(seed=int(self.rng.integers(2**31)))
        self.state, self.allowed = self._perceive(observation, self.env.person_views())
        # What training this is: its settings, and what its first moment looks like to this world model.
        settings = json.dumps([self.about, inputs, asdict(replace(config, checkpoint_seconds=0.0))], sort_keys=True)
        self.fingerprint = hashlib.sha256(settings.encode() + self.state.tobytes()).hexdigest()
        num_inputs = self.state.shape[1]
        self.network = _initialised(ValueNetwork(num_inputs, self.num_actions, config), generator)
        self.target = _initialised(ValueNetwork(num_inputs, self.num_actions, config), generator)
        if not config.published_target_start:
            self.target.load_state_dict(self.network.state_dict())
        self.weights: list[torch.Tensor] = list(self.network.parameters())
        self.target_weights: list[torch.Tensor] = list(self.target.parameters())
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate, fused=True)
        self.replay = Replay(config.memory, config.num_envs, num_inputs, self.num_actions)
        self.actions: list[np.ndarray] = []
        self.finished: list[tuple[float, int, int, int]] = []  # return, length, outcome, steps so far
        self.totals, self.lengths = np.zeros(config.num_envs), np.zeros(config.num_envs, np.int64)
        self.steps, self.updates, self.owed = 0, 0, 0.0

    @property
    def share(self) -> float:
        """How much of the training is done, 0 to 1: of its steps where their number is set, else of its episodes."""
        if self.config.steps:
            return min(self.steps / self.config.steps, 1.0)
        return min(len(self.finished) / self.config.episodes, 1.0)

    @property
    def over(self) -> bool:
        """Whether all of it is done."""
        return self.share >= 1.0

    def policy(self) -> DQNPolicy:
        """The policy as it is now."""
        trained = {**self.about, "steps": self.steps}
        return DQNPolicy(self.network, self.inputs, self.num_configurations, self.config, trained)

    def _perceive(
        self, observation: dict[str, np.ndarray], person_views: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """The network's input and the allowed actions."""
        percepts = self.perception(observation, person_views)
        allowed = None if self.mask is None else self.mask(percepts.codes, percepts.configurations)
        return features(percepts, self.inputs, self.num_configurations), allowed

    def choose(self) -> np.ndarray:
        """Epsilon-greedy actions int64 [B], allowed ones."""
        config = self.config
        spread = config.epsilon_start - config.epsilon_end
        epsilon = config.epsilon_end + spread * np.exp(-self.share / config.epsilon_decay)
        with torch.no_grad():
            values = self.network(torch.from_numpy(self.state)).numpy()
        explore = self.rng.random(config.num_envs) < epsilon
        at_random = self.rng.integers(self.num_actions, size=config.num_envs)
        if self.allowed is not None:
            values = np.where(self.allowed, values, -np.inf)
            at_random = np.where(self.allowed, self.rng.random(self.allowed.shape), -1.0).argmax(axis=1)
        return np.where(explore, at_random, values.argmax(axis=1))

    def step(self, action: np.ndarray) -> None:
        """Take actions [B] and remember what came of them."""
        config = self.config
        observation, reward, terminated, truncated, infos = self.env.step(action)
        done, outcome = terminated | truncated, infos["outcome_code"]
        state, allowed = self._perceive(observation, self.env.person_views())
        arrived, then_allowed = state, allowed
        if done.any():  # what followed the ended episodes' last steps is not what the reset brought
            arrived = state.copy()
            final = {name: values[done] for name, values in infos["final_obs"].items()}
            arrived[done], final_allowed = self._perceive(final, infos["final_person_view"][done])
            if allowed is not None:
                then_allowed = allowed.copy()
                then_allowed[done] = final_allowed
        clock = truncated if config.bootstrap == "truncated" else truncated & (outcome == TIMEOUT)
        bootstrap = np.ones(len(done), np.bool_) if config.published_terminals else ~done | clock
        self.replay.add(self.state, action, reward * config.reward_scale, arrived, then_allowed, done, bootstrap)
        self.state, self.allowed = state, allowed
        self.actions.append(action.astype(np.uint8))
        self.steps += len(done)
        self.totals += reward
        self.lengths += 1
        for i in np.flatnonzero(done):
            self.finished.append((float(self.totals[i]), int(self.lengths[i]), int(outcome[i]), self.steps))
        self.totals[done], self.lengths[done] = 0.0, 0

    def learn(self) -> None:
        """The updates that the steps taken so far are worth."""
        config = self.config
        if self.steps < config.warm_up:
            return
        rate = config.learning_rate + (config.final_learning_rate - config.learning_rate) * self.share
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.owed += config.updates_per_step * config.num_envs
        for _ in range(int(self.owed)):
            self.update()
        self.owed -= int(self.owed)

    def update(self) -> None:
        """One gradient step on one batch, and the target network after it.

        A batch holds many a state several times (half of it are repeats); the networks are asked once for each.
        """
        config, network = self.config, self.network
        age, env, weight = self.replay.draw(config.batch_size, self.rng, config.prioritised)
        states, action, reward, next_states, factor, allowed = self.replay.n_step(
            age, env, config.n_step, config.per_step
        )
        state, at = distinct(states)
        next_state, next_at = distinct(next_states)
        with torch.no_grad():
            next_values = self.target(next_state)[next_at]
            chooser = network(next_state)[next_at] if config.double else next_values
            if self.mask is not None:
                chooser = chooser.masked_fill(~torch.from_numpy(allowed), -torch.inf)
            best = next_values.gather(1, chooser.argmax(dim=1, keepdim=True)).squeeze(1)
            goal = torch.from_numpy(reward) + torch.from_numpy(factor) * best
        value = network(state)[at, torch.from_numpy(action)]
        loss = (nn.functional.smooth_l1_loss(value, goal, reduction="none") * torch.from_numpy(weight)).mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), config.gradient_clip)
        self.optimiser.step()
        if config.prioritised:
            self.replay.priority[self.replay.row(age), env] = (value.detach() - goal).abs().numpy() + 1e-3
        self.updates += 1
        with torch.no_grad():
            if not config.target_period:
                torch._foreach_lerp_(self.target_weights, self.weights, config.tau)
            elif self.updates % config.target_period == 0:
                self.target.load_state_dict(network.state_dict())

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        actions = np.array(self.actions, np.uint8).reshape(-1, self.config.num_envs)
        rows = min(self.replay.written, self.replay.length) if self.config.prioritised else 0
        state = {"random": self.rng.bit_generator.state, "owed": self.owed, "updates": self.updates}
        checkpoint = Checkpoint(actions, self.replay.priority[:rows], state)
        save_checkpoint(path, self.fingerprint, self._networks(), self.optimiser, checkpoint)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of this training, where there is one."""
        stored = load_checkpoint(path, self.fingerprint, self._networks(), self.optimiser)
        if stored is None:
            return
        for action in stored.actions:
            self.step(action.astype(np.int64))
        self.rng.bit_generator.state = stored.state["random"]
        self.owed, self.updates = float(stored.state["owed"]), int(stored.state["updates"])
        self.replay.priority[: len(stored.priorities)] = stored.priorities

    def _networks(self) -> dict[str, nn.Module]:
        return {"network": self.network, "target": self.target}


def _initialised(network: ValueNetwork, generator: torch.Generator) -> ValueNetwork:
    """Draw the weights from `generator` as torch's Linear draws them from its global one."""
    for module in network.modules():
        if isinstance(module, nn.Linear):
            bound = module.in_features**-0.5
            with torch.no_grad():
                module.weight.uniform_(-bound, bound, generator=generator)
                module.bias.uniform_(-bound, bound, generator=generator)
    return network
