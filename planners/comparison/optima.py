"""What the exact optimum gets on a variant, worked out once and kept in the folder of results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from domains.core import Domain, DomainError
from nesy.run_folder import read_json, write_json

Optimum = dict[str, Any]
"""`mean_return`, `success`, and, where maps can be listed, `maps`: [{map_id, return, success}]."""


def map_optimum(folder: Path, domain: Domain, variant: str) -> Optimum | None:
    """Return and success of the exact optimum, by map too; worked out once and kept. None where it is out of reach."""
    path, discount = folder / f"optimum-{variant}.json", domain.spec.discount(variant)
    if path.is_file() and is_optimum(kept := read_json(path)) and kept.get("discount") == discount:
        return dict(kept)
    try:
        oracle = domain.optimum(variant)
        grids, _ = domain.maps(variant)
    except DomainError:
        return None
    maps = []
    if len(grids) == len(oracle.map_return):
        env: Any = domain.make(domain.spec.main_task, len(grids), variant=variant, seed=0, maps=grids, cycle=True)
        env.reset(seed=0)
        maps = [
            {"map_id": int(name), "return": float(value), "success": float(success)}
            for name, value, success in zip(env.map_ids(), oracle.map_return, oracle.map_success, strict=True)
        ]
        env.close()
    value = {"discount": discount, "mean_return": oracle.mean_return, "success": oracle.success, "maps": maps}
    write_json(path, value)
    return value


def count_maps(domain: Domain, variant: str) -> int:
    """How many maps a variant has; 0 where they are too many to be listed."""
    try:
        return len(domain.maps(variant)[0])
    except DomainError:
        return 0


def is_optimum(value: Any) -> bool:
    """Whether a file holds what `map_optimum` writes; else it is worked out again."""
    return (
        isinstance(value, dict)
        and all(_is_number(value.get(key)) for key in ("mean_return", "success"))
        and isinstance(value.get("maps"), list)
        and all(
            isinstance(entry, dict) and all(_is_number(entry.get(k)) for k in ("map_id", "return", "success"))
            for entry in value["maps"]
        )
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))
