"""Shields for agents: people's rules as a mask over actions, from code and configuration alone.

    rule file  ->  nesy.asp.Shield (checked and grounded once)
    (x, configuration)  ->  view that x means  ->  its predicates  ->  the shield, asked by assumptions  ->  mask [A]

The same mask serves a learner (during exploration and when it acts) and the root of a planner's search. Answers are
remembered by (code, configuration), so in the long run a decision costs one look-up.
"""

from __future__ import annotations

import logging
from collections import Counter
from typing import Any, Protocol

import numpy as np

from domains.core import Domain
from nesy.asp.program.sources import Programs
from nesy.asp.shield import Advice, Fallback, Shield, usual_fallback
from nesy.errors import UserError

_LOG = logging.getLogger(__name__)


class ActionMask(Protocol):
    """Says which actions are allowed."""

    def __call__(self, codes: np.ndarray, configurations: np.ndarray) -> np.ndarray:
        """Codes uint8 [B, N] and configurations int64 [B] -> bool [B, A], at least one true in every row."""
        ...


class Decoder(Protocol):
    """What turns codes into the views they mean: `nesy.world_model.SymbolicCodec`."""

    num_factors: int
    num_values: int

    def views(self, codes: np.ndarray) -> np.ndarray:
        """uint8 [B, N] -> uint8 [B, V, V]."""
        ...


class ShieldMask:
    """An `ActionMask` from rule files.

    Where rules prefer some of the allowed actions (`preferred(A)`), only those are left. Can be handed to another
    process: the rules travel as text and are grounded anew there.

    Args:
        rules: rule files (`Path`) or texts (`str`), see docs/asp.md.
        codec: decodes codes.
        domain: evaluates predicates on the decoded views and names the actions.
        fallback: what is allowed where the rules forbid every action: `all`, only `stay`, or an `error`; by
            default `stay` if there is such an action, else `all`.
        limits: of checking the rules, `time_limit` in seconds and `memory_mb`.

    Raises:
        UserError: a rule is wrong, or the rules do not ground within their limits.
    """

    def __init__(
        self, rules: Programs, codec: Decoder, domain: Domain, fallback: Fallback | None = None, **limits: Any
    ) -> None:
        self.codec, self.predicates = codec, domain.predicates
        self.num_configurations = domain.spec.geometry.num_configurations
        self.shield = Shield(
            rules,
            domain.spec.action_names,
            codec.num_factors,
            codec.num_values,
            tuple(domain.predicates.names),
            view_size=domain.spec.geometry.view_size,
            fallback=fallback or usual_fallback(domain.spec.action_names),
            **limits,
        )
        names = list(domain.predicates.names)
        self._columns = [names.index(name) for name in self.shield.predicates]
        self._allowed: dict[tuple[bytes, int], np.ndarray] = {}
        self.conflicts: Counter[tuple[str, ...]] = Counter()
        """Situations (code and configuration) without any allowed action, by the rules that conflict there."""

    def __call__(self, codes: np.ndarray, configurations: np.ndarray) -> np.ndarray:
        """Which actions are allowed, bool [B, A].

        Raises:
            UserError: the shapes do not fit; the rules contradict each other; or they forbid every action somewhere
                and the fallback is `error`.
        """
        codes = np.ascontiguousarray(codes, dtype=np.uint8)
        configurations = np.asarray(configurations)
        if codes.ndim != 2 or codes.shape[1] != self.codec.num_factors or configurations.shape != (len(codes),):
            raise UserError(
                f"a mask needs codes [B, {self.codec.num_factors}] and configurations [B], "
                f"found {list(codes.shape)} and {list(configurations.shape)}"
            )
        keys = [(code.tobytes(), int(c)) for code, c in zip(codes, configurations, strict=True)]
        new = {key: b for b, key in enumerate(keys) if key not in self._allowed}
        if new:
            rows = np.array(list(new.values()))
            for key, code, truth in zip(new, codes[rows], self._truth(codes[rows]), strict=True):
                self._allowed[key] = self._mask_of(self.shield.advise(code, truth, key[1]))
        masks = [self._allowed[key] for key in keys]
        return np.array(masks, dtype=bool).reshape(len(codes), len(self.shield.action_names))

    def advise(self, code: np.ndarray, configuration: int) -> Advice:
        """What the rules say in one situation, with the rules behind it; the code is uint8 [N].

        Raises:
            UserError: as for a call.
        """
        code = np.asarray(code, dtype=np.uint8)
        return self.shield.advise(code, self._truth(code[None])[0], int(configuration))

    def _truth(self, codes: np.ndarray) -> np.ndarray:
        """Truth bool [n, P'] of the predicates that the rules mention, in the views that codes mean."""
        if not self._columns:
            return np.zeros((len(codes), 0), dtype=bool)
        return np.asarray(self.predicates.evaluate(self.codec.views(codes))[:, self._columns], dtype=bool)

    def _mask_of(self, advice: Advice) -> np.ndarray:
        allowed = np.array(advice.allowed)
        if advice.conflict:
            rules = tuple(sorted({place for places in advice.because.values() for place in places}))
            if rules not in self.conflicts:
                _LOG.warning("the shield leaves no action; these rules conflict: %s", ", ".join(rules))
            self.conflicts[rules] += 1
            return allowed
        wanted = allowed & np.array(advice.preferred)
        return wanted if wanted.any() else allowed
