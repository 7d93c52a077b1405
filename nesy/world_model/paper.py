"""The `paper` architecture, as published (arXiv 2503.20425): docs/notes/paper-architecture.md lists the corrections.

Encoder: concept embedding 5, two 3 x 3 convolutions with 4 hidden channels and self-attention over the cells
between them, then a linear map to the N x K logits. Decoder: the mirror image with transposed convolutions.
Action embedding 10; transition: self-attention over the factors, then a perceptron 200-200; inverse 100-100.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nesy.world_model.networks import NUM_KINDS, WorldModel

CONCEPT, CHANNELS, ACTION = 5, 4, 10


class _SelfAttention(nn.Module):
    """One head of self-attention over a sequence [B, L, C], added to it.

    What `nn.MultiheadAttention` computes, with its initial weights; written out because its fused kernel is slow
    on the CPU for sequences as short and channels as few as here.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.project, self.out = nn.Linear(channels, 3 * channels), nn.Linear(channels, channels)
        nn.init.xavier_uniform_(self.project.weight)
        nn.init.zeros_(self.project.bias)
        nn.init.zeros_(self.out.bias)
        self.scale = channels**-0.5

    def forward(self, sequence: Tensor) -> Tensor:
        query, key, value = self.project(sequence).chunk(3, -1)
        weights = torch.softmax(torch.einsum("bic,bjc->bij", query * self.scale, key), -1)
        mixed: Tensor = self.out(torch.einsum("bij,bjc->bic", weights, value))
        return sequence + mixed


def _attend(attention: _SelfAttention, features: Tensor) -> Tensor:
    """Attention over the cells of a feature map [B, C, v, v]."""
    mixed: Tensor = attention(features.flatten(2).transpose(1, 2))
    return mixed.transpose(1, 2).reshape(features.shape)


class PaperWorldModel(WorldModel):
    """The published design, with beliefs relaxed by Gumbel-softmax during training."""

    architecture = "paper"

    def __init__(self, **sizes: int) -> None:
        super().__init__(**sizes)
        cells, code = self.view_size**2, self.num_factors * self.num_values
        self.concepts = nn.Embedding(NUM_KINDS, CONCEPT)
        self.convolve_in = nn.Conv2d(CONCEPT, CHANNELS, 3, padding=1)
        self.attend_in = _SelfAttention(CHANNELS)
        self.convolve_out = nn.Conv2d(CHANNELS, CHANNELS, 3, padding=1)
        self.to_code = nn.Linear(CHANNELS * cells, code)
        self.from_code = nn.Linear(code, CHANNELS * cells)
        self.deconvolve_in = nn.ConvTranspose2d(CHANNELS, CHANNELS, 3, padding=1)
        self.attend_out = _SelfAttention(CHANNELS)
        self.deconvolve_out = nn.ConvTranspose2d(CHANNELS, NUM_KINDS, 3, padding=1)
        self.actions = nn.Embedding(self.num_actions, ACTION)
        self.attend_factors = _SelfAttention(self.num_values)
        self.forward_model = nn.Sequential(
            nn.Linear(code + ACTION, 200), nn.ReLU(), nn.Linear(200, 200), nn.ReLU(), nn.Linear(200, code)
        )
        self.inverse_model = nn.Sequential(
            nn.Linear(2 * code, 100), nn.ReLU(), nn.Linear(100, 100), nn.ReLU(), nn.Linear(100, ACTION)
        )

    def encode(self, views: Tensor) -> Tensor:
        """Belief logits [B, N, K] of views [B, v, v]."""
        features = self.concepts(views.long()).permute(0, 3, 1, 2)
        features = _attend(self.attend_in, F.relu(self.convolve_in(features)))
        logits: Tensor = self.to_code(F.relu(self.convolve_out(features)).flatten(1))
        return logits.view(len(views), self.num_factors, self.num_values)

    def decode(self, belief: Tensor) -> Tensor:
        """Cell logits [B, v, v, 4] of beliefs [B, N, K]."""
        side = self.view_size
        features = F.relu(self.from_code(belief.flatten(1))).view(len(belief), CHANNELS, side, side)
        features = _attend(self.attend_out, F.relu(self.deconvolve_in(features)))
        logits: Tensor = self.deconvolve_out(features)
        return logits.permute(0, 2, 3, 1)

    def transition_logits(self, belief: Tensor, action: Tensor) -> Tensor:
        """Logits [B, N, K] of the next belief."""
        inputs = torch.cat([self.attend_factors(belief).flatten(1), self.actions(action.long())], 1)
        logits: Tensor = self.forward_model(inputs)
        return logits.view(len(belief), self.num_factors, self.num_values)

    def transition(self, belief: Tensor, action: Tensor) -> Tensor:
        """Next belief [B, N, K]."""
        return torch.softmax(self.transition_logits(belief, action), -1)

    def inferred_embedding(self, belief: Tensor, next_belief: Tensor) -> Tensor:
        """Inferred action embedding [B, 10]."""
        embedding: Tensor = self.inverse_model(torch.cat([belief.flatten(1), next_belief.flatten(1)], 1))
        return embedding

    def infer_action(self, belief: Tensor, next_belief: Tensor) -> Tensor:
        """Action logits [B, A]: minus the squared distance to each action's embedding."""
        distance = torch.cdist(self.inferred_embedding(belief, next_belief), self.actions.weight)
        return -distance.square()
