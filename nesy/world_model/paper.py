"""The `paper` architecture, as published (arXiv 2503.20425); docs/notes/paper-architecture.md lists the corrections.

encoder      concept embedding 5; 3 x 3 convolution without padding to 4 channels; self-attention over what is left
             of the cells; a convolution over all of them to the N x K logits; ELU after both
decoder      self-attention over the factors; for a next belief, two layers that mix in the action; two transposed
             convolutions back to the cells; self-attention over the cells
transition   self-attention over the factors, joined with the action's embedding of size 10; perceptron 200-200
inverse      perceptron 100-100 from both beliefs to the action's embedding
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nesy.world_model.networks import NUM_KINDS, WorldModel

CONCEPT, CHANNELS, ACTION = 5, 4, 10


class _SelfAttention(nn.Module):
    """Self-attention over a sequence [B, L, C], which it replaces; with one head, or one head per channel.

    What `nn.MultiheadAttention` computes, with its initial weights; written out because its kernels take most of an
    epoch on the CPU where sequences are as short and channels as few as here.
    """

    def __init__(self, channels: int, *, head_per_channel: bool = False) -> None:
        super().__init__()
        self.head_per_channel = head_per_channel
        self.project, self.out = nn.Linear(channels, 3 * channels), nn.Linear(channels, channels)
        nn.init.xavier_uniform_(self.project.weight)
        nn.init.zeros_(self.project.bias)
        nn.init.zeros_(self.out.bias)

    def forward(self, sequence: Tensor) -> Tensor:
        size, length, channels = sequence.shape
        parts = self.project(sequence)
        if self.head_per_channel:
            # Scores are products of two numbers: with all heads of the batch side by side, no matrix product is due.
            query, key, value = parts.transpose(0, 1).reshape(length, size, 3, channels).unbind(2)
            weights = torch.softmax(key[:, None] * query[None], 0)
            mixed = (weights * value[:, None]).sum(0).transpose(0, 1)
        else:
            query, key, value = parts.chunk(3, -1)
            mixed = torch.softmax(query @ key.transpose(1, 2) * channels**-0.5, -1) @ value
        attended: Tensor = self.out(mixed)
        return attended


def _over_cells(attention: _SelfAttention, features: Tensor) -> Tensor:
    """Attention over the cells of a feature map [B, C, v, v]."""
    mixed: Tensor = attention(features.flatten(2).transpose(1, 2))
    return mixed.transpose(1, 2).reshape(features.shape)


class PaperWorldModel(WorldModel):
    """The published design, with beliefs relaxed by Gumbel-softmax during training."""

    architecture = "paper"

    def __init__(self, **sizes: int) -> None:
        super().__init__(**sizes)
        inner, code = self.view_size - 2, self.num_factors * self.num_values
        self.concepts = nn.Embedding(NUM_KINDS, CONCEPT)
        self.convolve_in = nn.Conv2d(CONCEPT, CHANNELS, 3)
        self.attend_in = _SelfAttention(CHANNELS)
        self.convolve_out = nn.Conv2d(CHANNELS, code, inner)
        self.attend_code = _SelfAttention(self.num_values, head_per_channel=True)
        self.with_action = nn.Sequential(nn.Linear(code + ACTION, 200), nn.ELU(), nn.Linear(200, code), nn.ELU())
        self.deconvolve_in = nn.ConvTranspose2d(code, CHANNELS, inner)
        self.deconvolve_out = nn.ConvTranspose2d(CHANNELS, NUM_KINDS, 3)
        self.attend_out = _SelfAttention(NUM_KINDS)
        self.actions = nn.Embedding(self.num_actions, ACTION)
        self.attend_factors = _SelfAttention(self.num_values, head_per_channel=True)
        self.forward_model = nn.Sequential(
            nn.Linear(code + ACTION, 200), nn.ELU(), nn.Linear(200, 200), nn.ELU(), nn.Linear(200, code)
        )
        self.inverse_model = nn.Sequential(
            nn.Linear(2 * code, 100), nn.ELU(), nn.Linear(100, 100), nn.ELU(), nn.Linear(100, ACTION)
        )

    def encode(self, views: Tensor) -> Tensor:
        """Belief logits [B, N, K] of views [B, v, v]."""
        features = self.concepts(views.long()).permute(0, 3, 1, 2)
        features = _over_cells(self.attend_in, F.elu(self.convolve_in(features)))
        logits: Tensor = F.elu(self.convolve_out(features))
        return logits.view(len(views), self.num_factors, self.num_values)

    def decode(self, belief: Tensor, action: Tensor | None = None) -> Tensor:
        """Cell logits [B, v, v, 4] of beliefs [B, N, K], in training those of next beliefs with the action [B]."""
        mixed: Tensor = self.attend_code(belief).flatten(1)
        if action is not None:
            mixed = self.with_action(torch.cat([mixed, self.actions(action.long())], 1))
        cells = self.deconvolve_out(self.deconvolve_in(mixed[:, :, None, None]))
        return _over_cells(self.attend_out, cells).permute(0, 2, 3, 1)

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
