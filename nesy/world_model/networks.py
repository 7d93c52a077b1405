"""The world model's interface, and the `symbolic` architecture.

Views    uint8 [B, v, v] of cell kinds 0 to 3
Code     N = 8 factors with K = 8 values; belief [B, N, K], rows sum to 1
Action   a in 0 .. A - 1

encode: view -> belief logits;  decode: belief -> cell logits;  transition: belief, action -> next belief;
infer_action: belief, next belief -> action logits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nesy.errors import UserError
from nesy.world_model.structure import Structure
from nesy.world_model.tables import all_tables

NUM_KINDS = 4
CHUNK = 256


class WorldModel(nn.Module, ABC):
    """What every architecture offers."""

    architecture: str = ""

    def __init__(self, num_factors: int = 8, num_values: int = 8, num_actions: int = 4, view_size: int = 5) -> None:
        super().__init__()
        self.num_factors, self.num_values = num_factors, num_values
        self.num_actions, self.view_size = num_actions, view_size

    def settings(self) -> dict[str, Any]:
        """What `from_settings` needs to build the same model without its weights; JSON values."""
        return {
            "architecture": self.architecture,
            "num_factors": self.num_factors,
            "num_values": self.num_values,
            "num_actions": self.num_actions,
            "view_size": self.view_size,
        }

    @abstractmethod
    def encode(self, views: Tensor) -> Tensor:
        """Belief logits [B, N, K] of views [B, v, v]."""

    @abstractmethod
    def decode(self, belief: Tensor) -> Tensor:
        """Cell logits [B, v, v, 4] of beliefs [B, N, K]."""

    @abstractmethod
    def transition(self, belief: Tensor, action: Tensor) -> Tensor:
        """Next belief [B, N, K] (marginal probabilities) after actions [B]."""

    @abstractmethod
    def infer_action(self, belief: Tensor, next_belief: Tensor) -> Tensor:
        """Action logits [B, A] of beliefs before and after, both [B, N, K]."""

    def codes(self, views: Tensor) -> Tensor:
        """Most probable code [B, N] of views [B, v, v]."""
        return self.encode(views).argmax(-1)

    def one_hot(self, codes: Tensor) -> Tensor:
        """Belief [B, N, K] that is certain of codes [B, N]."""
        return F.one_hot(codes.long(), self.num_values).float()

    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.parameters()).device


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two hidden layers with layer normalisation (which halves the steps to an exact fit) and ReLU."""
    return nn.Sequential(
        nn.Linear(inputs, hidden),
        nn.LayerNorm(hidden),
        nn.ReLU(),
        nn.Linear(hidden, hidden),
        nn.LayerNorm(hidden),
        nn.ReLU(),
        nn.Linear(hidden, outputs),
    )


class SymbolicWorldModel(WorldModel):
    """Argmax codes, and a forward model that is by construction a 2DBN.

    Encoder, decoder and inverse model are small perceptrons. The forward model consists of a structure (the
    parents of every factor under every action) and the weighted code transitions that its tables are counted
    from; tables have no zeros and fall back to fewer parents where a row was never seen (`tables.py`).
    """

    architecture = "symbolic"

    def __init__(self, hidden: int = 256, **sizes: int) -> None:
        super().__init__(**sizes)
        self.hidden = hidden
        cells, code = self.view_size**2 * NUM_KINDS, self.num_factors * self.num_values
        self.encoder = perceptron(cells, hidden, code)
        self.decoder = perceptron(code, hidden, cells)
        self.inverse = perceptron(2 * code, hidden // 2, self.num_actions)
        self._structure: Structure | None = None
        self._tables: list[list[np.ndarray]] = []
        self._torch_tables: list[list[Tensor]] = []
        for name, width in (("now", num := self.num_factors), ("then", num)):
            self.register_buffer(f"transitions_{name}", torch.zeros(0, width, dtype=torch.uint8))
        self.register_buffer("transitions_action", torch.zeros(0, dtype=torch.uint8))
        self.register_buffer("transitions_weight", torch.zeros(0, dtype=torch.int64))

    def settings(self) -> dict[str, Any]:
        """See `WorldModel.settings`; includes the structure."""
        settings = {**super().settings(), "hidden": self.hidden}
        if self._structure is not None:
            settings["structure"] = {
                "parents_now": self._structure.parents_now,
                "parents_next": self._structure.parents_next,
                "order": self._structure.order,
            }
        return settings

    def encode(self, views: Tensor) -> Tensor:
        """Belief logits [B, N, K] of views [B, v, v]."""
        cells = F.one_hot(views.long(), NUM_KINDS).float().flatten(1)
        logits: Tensor = self.encoder(cells)
        return logits.view(len(views), self.num_factors, self.num_values)

    def decode(self, belief: Tensor) -> Tensor:
        """Cell logits [B, v, v, 4] of beliefs [B, N, K]."""
        logits: Tensor = self.decoder(belief.flatten(1))
        return logits.view(len(belief), self.view_size, self.view_size, NUM_KINDS)

    def infer_action(self, belief: Tensor, next_belief: Tensor) -> Tensor:
        """Action logits [B, A]."""
        logits: Tensor = self.inverse(torch.cat([belief.flatten(1), next_belief.flatten(1)], 1))
        return logits

    # ------------------------------------------------------------------ forward model
    def set_transitions(
        self,
        structure: Structure,
        now: np.ndarray,
        action: np.ndarray,
        then: np.ndarray,
        weight: np.ndarray,
    ) -> None:
        """Set the forward model.

        Args:
            structure: the parents.
            now: int [E, N] codes before.
            action: int [E].
            then: int [E, N] codes after.
            weight: int [E].
        """
        assert now.shape == then.shape == (len(action), self.num_factors)
        assert structure.num_factors == self.num_factors and structure.num_actions == self.num_actions
        device = self.device()
        self.transitions_now = torch.as_tensor(now.astype(np.uint8), device=device)
        self.transitions_action = torch.as_tensor(action.astype(np.uint8), device=device)
        self.transitions_then = torch.as_tensor(then.astype(np.uint8), device=device)
        self.transitions_weight = torch.as_tensor(weight.astype(np.int64), device=device)
        self.set_structure(structure)

    def set_structure(self, structure: Structure) -> None:
        """Set the parents; the tables are counted anew when they are next asked for."""
        self._structure, self._tables, self._torch_tables = structure, [], []

    def structure(self) -> Structure:
        """Parents per action and factor.

        Raises:
            UserError: the forward model has not been trained.
        """
        if self._structure is None:
            raise UserError("this world model has no forward model yet; train it to the end with: nesy train")
        return self._structure

    def conditional(self, action: int, factor: int) -> np.ndarray:
        """Table float64 [rows, K] of a factor under an action.

        One row per combination of (parents of slice t..., parents of slice t+1...) in mixed radix, first parent
        most significant; rows sum to 1.
        """
        return self.tables()[action][factor]

    def tables(self) -> list[list[np.ndarray]]:
        """All conditional tables, `[A][N]`."""
        if not self._tables:
            self._tables = all_tables(
                self.structure(),
                self.transitions_now.cpu().numpy(),
                self.transitions_action.cpu().numpy(),
                self.transitions_then.cpu().numpy(),
                self.transitions_weight.cpu().numpy(),
                self.num_values,
            )
        return self._tables

    def transition(self, belief: Tensor, action: Tensor) -> Tensor:
        """Next marginals [B, N, K] in float32.

        Exact for a belief that is certain of a code, when two parents in slice t+1 are always parent and child
        themselves (as the search sees to): then the joint of every pair that is needed is at hand. Otherwise
        parents are taken as independent given the belief.
        """
        structure = self.structure()
        if not self._torch_tables or self._torch_tables[0][0].device != belief.device:
            self._torch_tables = [
                [torch.as_tensor(table, dtype=torch.float32, device=belief.device) for table in tables]
                for tables in self.tables()
            ]
        result = torch.empty_like(belief)
        for a in range(self.num_actions):
            for rows in torch.nonzero(action == a).flatten().split(CHUNK):
                if not len(rows):
                    continue
                result[rows] = self._next_marginals(belief[rows], a, structure)
        return result

    def _next_marginals(self, belief: Tensor, a: int, structure: Structure) -> Tensor:
        size, num_values = len(belief), self.num_values
        single: dict[int, Tensor] = {}
        pairs: dict[tuple[int, int], Tensor] = {}
        for i in structure.order:
            now = [belief[:, j] for j in structure.parents_now[a][i]]
            given = structure.parents_next[a][i]
            # P(x'_i | parents in slice t+1), the parents in slice t averaged out: [B, K, ..., K]
            joint = _mix(self._torch_tables[a][i], now, size).view(size, *[num_values] * (len(given) + 1))
            if len(given) == 2 and given in pairs:
                joint = joint * pairs[given].unsqueeze(-1)
            else:
                for position, j in enumerate(given):
                    shape = [size, *[1] * position, num_values, *[1] * (len(given) - position)]
                    joint = joint * single[j].view(shape)
            axes = list(range(1, len(given) + 1))
            single[i] = joint.sum(axes) if axes else joint
            for j in given:
                others = [position + 1 for position, k in enumerate(given) if k != j]
                pairs[j, i] = joint.sum(others) if others else joint
                pairs[i, j] = pairs[j, i].transpose(1, 2)
        return torch.stack([single[i] for i in range(self.num_factors)], 1)


def _mix(table: Tensor, parents: list[Tensor], size: int) -> Tensor:
    """Average of a table over its first digits, under independent parents [B, K] for them: [B, rest of a row]."""
    if not parents:
        return table.reshape(1, -1).expand(size, -1)
    if all(bool((parent.amax(1) == 1).all()) for parent in parents):  # certain parents: their rows, nothing to average
        row = torch.zeros(size, dtype=torch.int64, device=table.device)
        for parent in parents:
            row = row * table.shape[1] + parent.argmax(1)
        return table.view(table.shape[1] ** len(parents), -1)[row]
    # The most significant parent first: one matrix product, then the remaining digits by batched products.
    num_values = table.shape[1]
    mixed = parents[0] @ table.view(num_values, -1)
    for parent in parents[1:]:
        mixed = torch.bmm(parent[:, None], mixed.view(size, num_values, -1)).view(size, -1)
    return mixed
