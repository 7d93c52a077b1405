"""Beliefs over the state (x, y, c, counters) of the influence-augmented local model.

    b_t(s) ~ sum_i w_i [s = s_i],  s_i = (x, y_i, c_i, waiting_i, lost_i)

The robot's own code x is observed. Each step every particle is advanced by I(u | l), the mean of pi(u | y_i), and
weighted by the likelihood of what was seen: the robot's next code, the person's pose or its absence from view, and
that the episode went on. An influence mode (nesy.perspective.influence) says what then becomes of y:

    perspective-shift                 kept; the shifted belief, where it says something, weighs it and renews a share
    egocentric, perfect-information   the robot's code, or the person's true one, where the person is in view
    zero, random                      the base: codes as often as persons had them

If nothing explains what was seen, the belief starts afresh from the observation: a defined fallback, counted in
`resets`.
"""

from __future__ import annotations

import numpy as np

from nesy.checked_arrays import distributions, whole_numbers
from nesy.compiled import njit
from nesy.errors import UserError
from nesy.perspective.influence import InfluencePrior, influence
from planners.person_following import kernels
from planners.person_following.ialm import IALM, SCALARS
from planners.person_following.kernels import Model
from planners.person_following.motion import NUM_HEADINGS
from planners.search.random_bits import stream, uniform

_PRIOR_FLOOR = 0.05  # how far a value that the prior excludes is still believed, per factor


class ParticleBelief:
    """A particle filter for one episode.

    Attributes:
        states: int16 [P, 2N + 5], equally weighted particles.
        moves: float64 [P, U], pi(u | y) of each particle: what `influence` mixes and the next step is predicted by.
        resets: how often the fallback was needed.
        effective: effective number of particles at the last update, before resampling.
    """

    def __init__(
        self,
        model: IALM,
        compiled: Model,
        num_particles: int,
        rng: np.random.Generator,
        renewal: float = 0.25,
        mode: str = "perspective-shift",
    ) -> None:
        self.model, self.compiled, self.rng = model, compiled, rng
        self.renewal, self.prior = renewal, InfluencePrior(mode, rng)
        self.states = np.zeros((num_particles, model.state_size), np.int16)
        self.moves = np.zeros((num_particles, model.tables["influence"].moments.shape[1]))
        self.resets = 0
        self.effective = float(num_particles)
        self._bits = stream(rng)
        poses = model.motion.shifted(model.initial_poses)
        self._poses, self._pose_chance = poses, model.initial_pose_counts / model.initial_pose_counts.sum()
        self._waiting_chance = model.initial_waiting / model.initial_waiting.sum()

    def reset(self, code: np.ndarray, pose: np.ndarray | None, prior: np.ndarray) -> None:
        """Start an episode.

        Args:
            code: uint8 [N], the robot's code.
            pose: int [3], (side, ahead, heading) of the person if in view, else None.
            prior: float [N, K], b~.

        Raises:
            UserError: an array of another shape or range.
        """
        code, prior = self._checked(code, pose, prior)
        n, count = self.model.num_factors, len(self.states)
        self.states[:, :n] = code
        self.prior.renew()
        self.states[:, n : 2 * n] = self._draw_codes(prior, count)
        if pose is not None:
            self.states[:, 2 * n : 2 * n + 3] = self.model.motion.shifted(np.asarray(pose)[None])[0]
        else:
            chosen = self.rng.choice(len(self._poses), size=count, p=self._pose_chance)
            self.states[:, 2 * n : 2 * n + 3] = self._poses[chosen]
        self.states[:, 2 * n + 3] = self.rng.choice(len(self._waiting_chance), size=count, p=self._waiting_chance)
        self.states[:, 2 * n + 4] = 0
        self._expect()

    def update(self, action: int, code: np.ndarray, pose: np.ndarray | None, prior: np.ndarray) -> float:
        """Take in one step.

        Args:
            action: what the robot did.
            code: uint8 [N], the robot's next code.
            pose: int [3], the person's next pose if in view, else None.
            prior: float [N, K], b~ after the step.

        Returns:
            Log-likelihood of the observation; -inf if the fallback was needed.

        Raises:
            UserError: an array of another shape or range, or no such action.
        """
        code, prior = self._checked(code, pose, prior)
        self.prior.renew()
        action = self.model.dbn.action_index(action)
        seen = np.full(3, -1, np.int16)
        if pose is not None:
            seen[:] = self.model.motion.shifted(np.asarray(pose)[None])[0]
        after = np.zeros_like(self.states)
        weights = _advance(
            self.compiled, self.states, self.moves, action, code.astype(np.int16), seen, after, self._bits
        )
        total = float(weights.sum())
        if not total > 0.0:
            self.resets += 1
            self._restart(action, code, pose, prior)
            self.effective = 0.0
            self._expect()
            return -np.inf
        n = self.model.num_factors
        kept = self.prior.mode == "perspective-shift"
        informed = self.prior.blind or bool((prior.max(axis=1) > 1.5 / self.model.num_values).any())
        if informed and kept:
            floored = (1 - _PRIOR_FLOOR) * prior + _PRIOR_FLOOR / self.model.num_values
            codes = after[:, n : 2 * n]
            log_likelihood = np.log(floored[np.arange(n), codes]).sum(axis=1)
            weights *= np.exp(log_likelihood - log_likelihood.max())
        self.effective = float(weights.sum() ** 2 / max((weights**2).sum(), 1e-300))
        self.states = after[_systematic(weights, self._bits)]
        if informed:
            renewed = self.rng.random(len(self.states)) < (self.renewal if kept else 1.0)
            self.states[renewed, n : 2 * n] = self._draw_codes(prior, int(renewed.sum()))
        self._expect()
        return float(np.log(total / len(weights)))

    def _checked(self, code: np.ndarray, pose: np.ndarray | None, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        n, k = self.model.num_factors, self.model.num_values
        if pose is not None and (np.shape(pose) != (3,) or not 0 <= pose[2] < NUM_HEADINGS):
            raise UserError(f"a pose is (side, ahead, heading 0..3), found {pose!r}")
        return whole_numbers(code, "codes", (n,), k), distributions(prior, "priors over the person's code", (n, k))

    def influence(self) -> np.ndarray:
        """I(u | l) = sum over y of pi(u | y) b~(y), given that the person does not wait: float64 [U]."""
        return influence(self.moves, np.ones(len(self.moves)))

    @property
    def window(self) -> int:
        """W of `pose_marginal`."""
        return self.model.motion.window

    def pose_marginal(self) -> np.ndarray:
        """P(c): float64 [2W + 1, 2W + 1, 4] over side, ahead, heading (for pictures)."""
        n, size = self.model.num_factors, 2 * self.model.motion.window + 1
        out = np.zeros((size, size, 4))
        np.add.at(out, tuple(self.states[:, 2 * n : 2 * n + 3].T), 1.0 / len(self.states))
        return out

    def person_marginals(self) -> np.ndarray:
        """P(y_i = k): float64 [N, K] (for pictures)."""
        n = self.model.num_factors
        codes = self.states[:, n : 2 * n]
        return (codes[:, :, None] == np.arange(self.model.num_values)).mean(axis=0)

    def _draw_codes(self, prior: np.ndarray, count: int) -> np.ndarray:
        """Person's codes drawn from b~, among the known ones: int16 [count, N].

        `prior` [N, K] is of the factors one by one, which is why only known codes are drawn, unless it is the one code
        that `egocentric` and `perfect-information` speak of.
        """
        if not self.prior.blind and self.prior.mode != "perspective-shift" and (prior.max(axis=1) > 0.999).all():
            return np.tile(prior.argmax(axis=1).astype(np.int16), (count, 1))
        base = self.model.person_chances
        cumulative = np.cumsum(self.prior.base(base) if self.prior.blind else self.model.code_chances(prior))
        chosen = np.searchsorted(cumulative, self.rng.random(count) * cumulative[-1], side="right")
        return self.model.known_codes[np.minimum(chosen, len(cumulative) - 1)].astype(np.int16)

    def _expect(self) -> None:
        """What each particle's person does next; the next step is predicted by it."""
        n = self.model.num_factors
        self.moves = self.model.influence_of(self.states[:, n : 2 * n])

    def _restart(self, action: int, code: np.ndarray, pose: np.ndarray | None, prior: np.ndarray) -> None:
        """The fallback: keep the counters, take x and (if seen) c from the observation and y from the prior."""
        n = self.model.num_factors
        after = np.zeros_like(self.states)
        _predict(self.compiled, self.states, action, after, self._bits)
        self.states = after
        self.states[:, :n] = code
        self.states[:, n : 2 * n] = self._draw_codes(prior, len(self.states))
        if pose is not None:
            self.states[:, 2 * n : 2 * n + 3] = self.model.motion.shifted(np.asarray(pose)[None])[0]


@njit(cache=True)
def _advance(
    model: Model,
    states: np.ndarray,
    moves: np.ndarray,
    action: int,
    code: np.ndarray,
    seen: np.ndarray,
    after: np.ndarray,
    bits: np.ndarray,
) -> np.ndarray:
    variables = np.zeros(3 * model.dbn.order.shape[0] + len(SCALARS), np.int16)
    weights = np.zeros(states.shape[0])
    for p in range(states.shape[0]):
        weights[p] = kernels.explain_step(model, states[p], moves[p], action, code, seen, after[p], variables, bits)
    return weights


@njit(cache=True)
def _predict(model: Model, states: np.ndarray, action: int, after: np.ndarray, bits: np.ndarray) -> None:
    variables = np.zeros(3 * model.dbn.order.shape[0] + len(SCALARS), np.int16)
    for p in range(states.shape[0]):
        kernels.step(model, states[p], action, after[p], variables, bits)


@njit(cache=True)
def _systematic(weights: np.ndarray, bits: np.ndarray) -> np.ndarray:
    """Systematic resampling: int64 [P], each index about weight * P times."""
    count = weights.shape[0]
    total = 0.0
    for p in range(count):
        total += weights[p]
    out = np.zeros(count, np.int64)
    position = uniform(bits)
    reached = 0.0
    k = 0
    for p in range(count):
        reached += weights[p] / total * count
        while k < count and position + k < reached:
            out[k] = p
            k += 1
    while k < count:
        out[k] = out[k - 1] if k > 0 else 0
        k += 1
    return out
