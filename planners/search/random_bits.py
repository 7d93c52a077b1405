"""A random stream for compiled kernels: SplitMix64 in one uint64 cell, passed by reference.

Kernels cannot share NumPy's generators cheaply, and hidden global state would make results depend on who
ran before; a stream that the caller owns does neither. Source: Steele, Lea, Flood, "Fast splittable
pseudorandom number generators" (2014).
"""

from __future__ import annotations

import numpy as np

from nesy.compiled import njit

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


def stream(rng: np.random.Generator) -> np.ndarray:
    """A new stream drawn from `rng`: uint64 [1], its state."""
    return rng.integers(0, 2**64, size=1, dtype=np.uint64)


@njit(cache=True)
def random_bits(state: np.ndarray) -> int:
    """The next 64 bits of the stream `state` (uint64 [1], advanced in place), as uint64."""
    z = state[0] + _GAMMA
    state[0] = z
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@njit(cache=True)
def uniform(state: np.ndarray) -> float:
    """The next number of the stream, uniform in [0, 1)."""
    return np.float64(random_bits(state) >> _S11) * (1.0 / 9007199254740992.0)


@njit(cache=True)
def drawn(cumulative: np.ndarray, state: np.ndarray) -> int:
    """A position drawn from its cumulative distribution, float64 [n], by bisection."""
    number = uniform(state)
    low, high = 0, cumulative.shape[0] - 1
    while low < high:
        half = (low + high) // 2
        if number < cumulative[half]:
            high = half
        else:
            low = half + 1
    return low
