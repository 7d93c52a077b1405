"""A small run, the questions to it, every agent's returns and figure 4 give what they gave when golden.json was made.

Whole numbers, names and choices must be the same. Numbers with a fraction may differ by 1e-6. Where the processor or a
library is another one than in golden.json (`machine`), trained networks round otherwise, and what is built on them
may differ: there the numbers of networks are allowed more, and what only follows from a network is left out.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.golden.freeze import GOLDEN
from tests.golden.measure import PARTS, machine

ALIKE = 1e-6
ELSEWHERE = 0.05
FROM_NETWORKS = ("dqn", "search", "structured", "qmdp", "pomdp")
"""Agents whose play follows from networks or the tables made of them."""
NUMBER = re.compile(r"-?\d+\.\d+(?:e-?\d+)?|-?\d+e-?\d+|\d+ %")


@pytest.fixture(scope="module")
def golden() -> dict[str, Any]:
    return dict(json.loads(GOLDEN.read_text(encoding="utf-8")))


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS)
def test_it_is_as_it_was(part: str, golden: dict[str, Any], tiny_run: Path, tmp_path: Path) -> None:
    same = golden["machine"] == machine()
    if not same and part in ("questions", "figure4"):
        pytest.skip("another processor or library than golden.json was made with: networks round otherwise")
    found = json.loads(json.dumps(PARTS[part](tiny_run, tmp_path)))
    expected = golden[part]
    if not same and part == "returns":
        found, expected = ({v: _certain(agents) for v, agents in each.items()} for each in (found, expected))
    if not same and part == "table":
        found, expected = (
            {
                name: {k: v for k, v in part.items() if k in ("parents", "rows", "met", "counts")}
                for name, part in each.items()
            }
            for each in (found, expected)
        )
    differing = list(differences(expected, found, part, ALIKE if same else ELSEWHERE))
    assert not differing, "\n".join(differing[:20])


def _certain(agents: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in agents.items() if name.split()[0] not in FROM_NETWORKS}


def differences(expected: Any, found: Any, where: str, tolerance: float) -> Any:
    """What differs, one line each; numbers in texts count as numbers, and infinities are alike."""
    if isinstance(expected, dict) and isinstance(found, dict):
        for name in expected.keys() | found.keys():
            if name not in expected or name not in found:
                yield f"{where}.{name}: {'new' if name in found else 'gone'}"
            else:
                yield from differences(expected[name], found[name], f"{where}.{name}", tolerance)
    elif isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found):
        for i, (old, new) in enumerate(zip(expected, found, strict=True)):
            yield from differences(old, new, f"{where}[{i}]", tolerance)
    elif isinstance(expected, str) and isinstance(found, str):
        if NUMBER.sub("#", expected) != NUMBER.sub("#", found):
            yield f"{where}: {expected!r}, now {found!r}"
        else:
            for old, new in zip(NUMBER.findall(expected), NUMBER.findall(found), strict=True):
                yield from differences(float(old.rstrip(" %")), float(new.rstrip(" %")), where, tolerance)
    elif isinstance(expected, float) and isinstance(found, int | float):
        if found != pytest.approx(expected, rel=tolerance, abs=tolerance, nan_ok=True):
            yield f"{where}: {expected}, now {found}"
    elif type(expected) is not type(found) or expected != found:
        yield f"{where}: {expected!r}, now {found!r}"


def test_a_difference_is_seen() -> None:
    old = {"a": [1, 0.5], "text": "3 rules, 0.25 of all"}
    assert not list(differences(old, {"a": [1, 0.5 + 1e-9], "text": "3 rules, 0.25 of all"}, "", ALIKE))
    assert list(differences(old, {"a": [2, 0.5], "text": "4 rules, 0.26 of all"}, "", ALIKE)) and not list(
        differences(old, old, "", ALIKE)
    )
    assert list(differences(old, {"a": [1, 0.51]}, "", ALIKE))
