"""NumPy's PCG64 generator inside compiled kernels: one stream per environment, as an array row.

A stream is a `uint64 [6]` row: state (high, low), increment (high, low), whether half of a 64-bit draw is
kept for the next 32-bit draw, and that half. Draws equal those of `numpy.random.Generator(PCG64)`, so a seed
means the same map here and in Minigrid. Sources: O'Neill, "PCG: A Family of Simple Fast Space-Efficient
Statistically Good Algorithms for Random Number Generation" (2014), and NumPy's `_pcg64.pyx`,
`distributions.c` (`random_interval`, `buffered_bounded_lemire_uint32`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from domains.person_following.simulation.compiled import inner

STREAM_WIDTH = 6

_MULTIPLIER_HIGH = np.uint64(0x2360ED051FC65DA4)
_MULTIPLIER_LOW = np.uint64(0x4385DF649FCCF645)
_LOW_32 = np.uint64(0xFFFFFFFF)
_32 = np.uint64(32)
_63 = np.uint64(63)
_58 = np.uint64(58)
_64 = np.uint64(64)
_ZERO = np.uint64(0)
_ONE = np.uint64(1)
_MASK_64 = (1 << 64) - 1


def stream_of(generator: np.random.Generator) -> NDArray[np.uint64]:
    """The row `uint64 [6]` that continues where a PCG64 generator stands."""
    full: dict[str, Any] = dict(generator.bit_generator.state)
    if full["bit_generator"] != "PCG64":
        raise ValueError(f"a PCG64 generator is needed, got {full['bit_generator']}")
    state, increment = full["state"]["state"], full["state"]["inc"]
    return np.array(
        [
            state >> 64,
            state & _MASK_64,
            increment >> 64,
            increment & _MASK_64,
            full["has_uint32"],
            full["uinteger"],
        ],
        dtype=np.uint64,
    )


def seeded_stream(seed: int) -> NDArray[np.uint64]:
    """The row of `numpy.random.default_rng(seed)`, which is also Gymnasium's generator for that seed."""
    return stream_of(np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed))))


def write_back(stream: NDArray[np.uint64], generator: np.random.Generator) -> None:
    """Set a PCG64 generator to where a stream stands."""
    words = [int(word) for word in stream]
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": (words[0] << 64) | words[1], "inc": (words[2] << 64) | words[3]},
        "has_uint32": words[4],
        "uinteger": words[5],
    }


@inner
def next_64(streams, b):  # type: ignore[no-untyped-def]
    """The next 64 random bits."""
    high, low = streams[b, 0], streams[b, 1]
    # 128-bit product state * multiplier, low 128 bits, from 32-bit halves of the low words.
    a0, a1 = low & _LOW_32, low >> _32
    b0, b1 = _MULTIPLIER_LOW & _LOW_32, _MULTIPLIER_LOW >> _32
    middle = a1 * b0 + ((a0 * b0) >> _32)
    middle_low = (middle & _LOW_32) + a0 * b1
    carry = a1 * b1 + (middle >> _32) + (middle_low >> _32)
    product_low = low * _MULTIPLIER_LOW
    product_high = carry + high * _MULTIPLIER_LOW + low * _MULTIPLIER_HIGH
    low = product_low + streams[b, 3]
    high = product_high + streams[b, 2]
    if low < product_low:
        high += _ONE
    streams[b, 0], streams[b, 1] = high, low
    value = high ^ low
    turn = high >> _58
    return (value >> turn) | (value << ((_64 - turn) & _63))


@inner
def next_32(streams, b):  # type: ignore[no-untyped-def]
    """The next 32 random bits, as a uint64; every second call takes the kept half of a 64-bit draw."""
    if streams[b, 4] != _ZERO:
        streams[b, 4] = _ZERO
        return streams[b, 5]
    value = next_64(streams, b)
    streams[b, 4] = _ONE
    streams[b, 5] = value >> _32
    return value & _LOW_32


@inner
def draw_interval(streams, b, largest):  # type: ignore[no-untyped-def]
    """Uniform on 0..largest by masked rejection: what `Generator.shuffle` draws."""
    if largest == 0:
        return 0
    mask = 1
    while mask < largest:
        mask = (mask << 1) | 1
    while True:
        value = np.int64(next_32(streams, b)) & mask
        if value <= largest:
            return value


@inner
def draw_below(streams, b, bound):  # type: ignore[no-untyped-def]
    """Uniform on 0..bound-1 by Lemire's method: what `Generator.integers` and `choice` draw."""
    if bound <= 1:
        return 0
    wide = np.uint64(bound)
    product = next_32(streams, b) * wide
    rest = product & _LOW_32
    if rest < wide:
        threshold = (_LOW_32 - (wide - _ONE)) % wide
        while rest < threshold:
            product = next_32(streams, b) * wide
            rest = product & _LOW_32
    return np.int64(product >> _32)


@inner
def shuffle(streams, b, values, count):  # type: ignore[no-untyped-def]
    """Shuffle `values[:count]` in place, as `Generator.shuffle` shuffles a list."""
    for i in range(count - 1, 0, -1):
        j = draw_interval(streams, b, i)
        values[i], values[j] = values[j], values[i]
