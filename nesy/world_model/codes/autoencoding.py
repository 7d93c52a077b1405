"""Learning by gradients alone, for worlds of many views: the loss of the `symbolic` architecture's networks.

`L = L_VAE + L_forward + L_inverse` with straight-through Gumbel samples of a falling temperature, less a bonus for
using all values. `L_forward` is the cross-entropy of an autoregressive guide to the detached next code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nesy.world_model import losses
from nesy.world_model.distinct import Transitions
from nesy.world_model.networks import SymbolicWorldModel, perceptron


@dataclass(frozen=True)
class Ingredients:
    """What the loss is made of; scripts/ablations.py leaves out one at a time."""

    gumbel: bool = True
    """Whether codes are samples, with noise that fades out; otherwise always the likeliest values."""
    straight_through: bool = True
    """Whether samples are hard, with the gradient of the relaxed ones; otherwise relaxed."""
    annealing: bool = True
    """Whether the temperature falls from 1 to 0.4; otherwise it is 0.4."""
    usage: float = 0.02
    """Bonus for the entropy of the values' use, summed over factors."""
    forward: float = 0.1
    """Weight of `L_forward`."""
    inverse: float = 0.1
    """Weight of `L_inverse`."""
    class_weights: bool = True
    """Whether rare kinds of cells count more in the reconstruction."""

    def noise(self, done: float) -> float:
        """Scale of the Gumbel noise when a share `done` of the epochs is done."""
        return max(0.0, 1.0 - 1.3 * done) if self.gumbel else 0.0

    def temperature(self, done: float) -> float:
        """Temperature of the relaxation then."""
        return max(0.4, 1.0 - done) if self.annealing else 0.4


class ForwardGuide(nn.Module):
    """Predicts the next code factor by factor, later factors seeing the earlier ones; only used in training."""

    mask: Tensor

    def __init__(self, model: SymbolicWorldModel) -> None:
        super().__init__()
        self.sizes = (model.num_factors, model.num_values, model.num_actions)
        code = model.num_factors * model.num_values
        self.context = perceptron(code + model.num_actions, model.hidden, code)
        self.earlier = nn.Linear(code, code, bias=False)
        factor = torch.arange(code) // model.num_values
        self.register_buffer("mask", (factor[:, None] > factor[None, :]).float())

    def forward(self, belief: Tensor, action: Tensor, then: Tensor) -> Tensor:
        """Logits [B, N, K] of the next code, given what really followed in earlier factors, `then` [B, N, K]."""
        num_factors, num_values, num_actions = self.sizes
        inputs = torch.cat([belief.flatten(1), F.one_hot(action.long(), num_actions).float()], 1)
        logits = self.context(inputs) + F.linear(then.flatten(1), self.earlier.weight * self.mask)
        shaped: Tensor = logits.view(-1, num_factors, num_values)
        return shaped


class Autoencoding:
    """The loss on mini-batches of some transitions; all state is in the networks and the generator."""

    def __init__(
        self,
        model: SymbolicWorldModel,
        guide: ForwardGuide,
        transitions: Transitions,
        kl_weight: float,
        ingredients: Ingredients,
        generator: torch.Generator,
    ) -> None:
        """Prepare the loss.

        Args:
            model: to be trained.
            guide: trained with it.
            transitions: to learn from.
            kl_weight: weight of the KL to the uniform prior.
            ingredients: of the loss.
            generator: draws the samples.
        """
        self.model, self.guide, self.ingredients = model, guide, ingredients
        self.transitions, self.kl_weight, self.generator = transitions, kl_weight, generator
        self.views = torch.as_tensor(transitions.views, device=model.device())
        self.weights: Tensor | None = None
        if ingredients.class_weights:
            self.weights = losses.class_weights(transitions.views, transitions.visits).to(model.device())

    def loss(self, rows: np.ndarray, noise: float, temperature: float) -> dict[str, Tensor]:
        """The parts of the loss on the transitions `rows`, in nats; `loss` is what is to fall."""
        t, model, parts_of = self.transitions, self.model, self.ingredients
        device = model.device()
        action = torch.as_tensor(t.action[rows], device=device)
        # Source and target views overlap much; each distinct view goes through the encoder once.
        views, place = np.unique(np.concatenate([t.source[rows], t.target[rows]]), return_inverse=True)
        source, target = torch.as_tensor(place, device=device).chunk(2)
        batch = self.views[torch.as_tensor(views, device=device)]
        logits = model.encode(batch)
        hard, soft = losses.sample_straight_through(logits, temperature, noise, self.generator)
        sample = hard if parts_of.straight_through else soft
        certain = model.one_hot(logits.argmax(-1))
        before, then = sample[source], certain[target]
        parts = {
            "reconstruction": losses.reconstruction(model.decode(sample), batch, self.weights),
            "kl": losses.kl_to_uniform(logits),
            "forward": F.cross_entropy(self.guide(before, action, then).flatten(0, 1), then.argmax(-1).flatten())
            * model.num_factors,
            "inverse": F.cross_entropy(model.infer_action(before, sample[target]), action),
        }
        # The KL pulls towards the uniform prior; its weight fades with the noise, for codes are to be certain.
        parts["loss"] = (
            parts["reconstruction"]
            + self.kl_weight * noise * 0.1 * parts["kl"]
            + parts_of.forward * parts["forward"]
            + parts_of.inverse * parts["inverse"]
            - parts_of.usage * losses.usage_entropy(soft)
        )
        return parts
