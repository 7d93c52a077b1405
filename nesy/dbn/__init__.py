"""The symbolic two-slice dynamic Bayesian network: data, inference, extraction, files.

Names are handed on lazily, so that reading a table never imports numba.
"""

from __future__ import annotations

import importlib
from typing import Any

_WHERE = {
    "TwoSliceDBN": "nesy.dbn.model",
    "Codebook": "nesy.dbn.codebook",
    "Packed": "nesy.dbn.inference.kernels",
    "ParticleFilter": "nesy.dbn.inference.particles",
    "packed": "nesy.dbn.inference.kernels",
    "sample_codes": "nesy.dbn.inference.kernels",
    "FactoredUpdates": "nesy.dbn.inference.factored",
    "predict_batch": "nesy.dbn.inference.factored",
    "Search": "nesy.dbn.learning.structure",
    "from_callable": "nesy.dbn.learning.fitting",
    "from_experience": "nesy.dbn.learning.fitting",
    "describe": "nesy.dbn.reading.text",
    "extract": "nesy.dbn.learning.extraction",
    "extract_run": "nesy.dbn.learning.extraction",
    "fidelity": "nesy.dbn.evaluation.measures",
    "fidelity_report": "nesy.dbn.evaluation.fidelity",
    "StepTable": "nesy.dbn.step_tables",
}

__all__ = sorted(_WHERE)


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        module = importlib.import_module(_WHERE[name])
        value = globals()[name] = getattr(module, name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
