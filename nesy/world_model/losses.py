"""The loss `L = L_VAE + L_forward + L_inverse` and its parts, in nats per transition.

L_VAE      reconstruction cross-entropy over the cells + KL of the belief to the uniform prior
L_forward  the predicted next belief against the observed one, which is detached
L_inverse  the inferred action against the true one
"""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from nesy.world_model.networks import NUM_KINDS


def class_weights(views: np.ndarray, visits: np.ndarray) -> Tensor:
    """Square-root inverse-frequency weights of the cell kinds, float32 [4], mean 1 over the cells.

    Args:
        views: uint8 [V, v, v].
        visits: [V], how often each view counts.
    """
    kinds = np.stack([(views == kind).reshape(len(views), -1).sum(1) for kind in range(NUM_KINDS)], axis=1)
    share = (kinds * visits[:, None]).sum(0) / (kinds * visits[:, None]).sum()
    weight = np.where(share > 0, 1 / np.sqrt(np.maximum(share, 1e-12)), 0.0)
    return torch.as_tensor(weight / (weight * share).sum(), dtype=torch.float32)


def reconstruction(cell_logits: Tensor, views: Tensor, weights: Tensor | None = None) -> Tensor:
    """Cross-entropy of the cells, summed over a view and averaged over views.

    Args:
        cell_logits: [B, v, v, 4].
        views: [B, v, v].
        weights: [4], one per cell kind.
    """
    loss = F.cross_entropy(cell_logits.flatten(0, 2), views.long().flatten(), weight=weights, reduction="sum")
    return loss / len(views)


def kl_to_uniform(logits: Tensor) -> Tensor:
    """KL of the belief to the uniform prior, summed over factors and averaged over the batch; logits [B, N, K]."""
    log_q = F.log_softmax(logits, -1)
    return ((log_q.exp() * log_q).sum(-1) + math.log(logits.shape[-1])).sum(-1).mean()


def kl_to_target(predicted: Tensor, target: Tensor) -> Tensor:
    """KL(target || predicted) of beliefs [B, N, K], summed over factors, averaged over the batch; target detached."""
    target = target.detach()
    ratio = torch.log(target.clamp_min(1e-9)) - torch.log(predicted.clamp_min(1e-9))
    return (target * ratio).sum((-1, -2)).mean()


def usage_entropy(probabilities: Tensor) -> Tensor:
    """Entropy of the average use of each factor's values, summed over factors; probabilities [B, N, K]."""
    mean = probabilities.mean(0)
    return -(mean * torch.log(mean.clamp_min(1e-9))).sum()


def gumbel(shape: torch.Size, generator: torch.Generator, device: torch.device) -> Tensor:
    """Standard Gumbel noise, drawn on the CPU so that a seed means the same everywhere."""
    uniform = torch.rand(shape, generator=generator).clamp_(1e-9, 1 - 1e-7)
    return (-torch.log(-torch.log(uniform))).to(device)


def sample_straight_through(
    logits: Tensor, temperature: float, noise: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """A one-hot sample per factor whose gradient is that of the relaxed one.

    Args:
        logits: [B, N, K].
        temperature: of the relaxation.
        noise: scale of the Gumbel noise: 1 samples, 0 takes the most probable value.
        generator: a CPU generator.

    Returns:
        The sample and the relaxed probabilities it was taken from, both [B, N, K].
    """
    perturbed = logits + noise * gumbel(logits.shape, generator, logits.device) if noise > 0 else logits
    soft = torch.softmax(perturbed / temperature, -1)
    hard = F.one_hot(soft.argmax(-1), logits.shape[-1]).to(soft.dtype)
    return hard + soft - soft.detach(), soft
