"""The symbolic two-slice dynamic Bayesian network: data, inference, extraction, files.

Names are handed on lazily, so that reading a table never imports numba or scikit-learn.
"""

from __future__ import annotations

import importlib
from typing import Any

_WHERE = {
    "TwoSliceDBN": "nesy.dbn.model",
    "Codebook": "nesy.dbn.codebook",
    "Packed": "nesy.dbn.kernels",
    "ParticleFilter": "nesy.dbn.particles",
    "packed": "nesy.dbn.kernels",
    "sample_codes": "nesy.dbn.kernels",
    "FactoredUpdates": "nesy.dbn.factored",
    "predict_batch": "nesy.dbn.factored",
    "Search": "nesy.dbn.structure",
    "from_callable": "nesy.dbn.fitting",
    "from_experience": "nesy.dbn.fitting",
    "describe": "nesy.dbn.reading",
    "extract": "nesy.dbn.extraction",
    "extract_run": "nesy.dbn.extraction",
    "fidelity": "nesy.dbn.measures",
    "fidelity_report": "nesy.dbn.fidelity",
    "StepTable": "nesy.dbn.step_tables",
}

__all__ = sorted(_WHERE)


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        module = importlib.import_module(_WHERE[name])
        value = globals()[name] = getattr(module, name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
