"""The tiger problem (Cassandra, Kaelbling, Littman 1994).

S   tiger behind the left or the right door
A   listen, open-left, open-right
O   heard left, heard right; right 85 % of the time after listening, noise after opening
R   -1 for listening, -100 for the tiger, +10 for the other door; opening puts the tiger anywhere
Optimal value from the uniform belief at discount 0.95: 19.371.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def tiger(discount: float = 0.95, accuracy: float = 0.85) -> dict[str, Any]:
    """The arrays of the tiger problem."""
    half = np.full((2, 2), 0.5)
    hears = np.array([[accuracy, 1 - accuracy], [1 - accuracy, accuracy]])
    return {
        "states": ("tiger-left", "tiger-right"),
        "actions": ("listen", "open-left", "open-right"),
        "observations": ("hear-left", "hear-right"),
        "transition": [np.eye(2), half, half],
        "observation": np.stack([hears, half, half]),
        "reward": np.array([[-1.0, -1.0], [-100.0, 10.0], [10.0, -100.0]]),
        "discount": discount,
        "start": np.array([0.5, 0.5]),
        "terminal": np.zeros(2, np.bool_),
    }
