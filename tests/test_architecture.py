"""Dependencies flow one way, and starting is cheap."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
# package -> what it may import of our own code
ALLOWED = {
    "domains": ("domains",),
    "nesy": ("nesy", "domains.core"),
    "nesy/cli": ("nesy", "domains", "planners"),
    "planners": ("planners", "nesy", "domains.core"),
}


def _imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.add(node.module or "")
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def _files() -> list[Path]:
    return sorted(path for package in ("domains", "nesy", "planners") for path in (ROOT / package).rglob("*.py"))


def _layer(path: Path) -> str:
    relative = path.relative_to(ROOT).as_posix()
    return "nesy/cli" if relative.startswith(("nesy/cli/", "nesy/__main__.py")) else relative.split("/")[0]


@pytest.mark.parametrize("path", _files(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_dependencies_flow_one_way(path: Path) -> None:
    allowed = ALLOWED[_layer(path)]
    for name in _imports(path):
        if name.split(".")[0] not in ("domains", "nesy", "planners"):
            continue
        # `from domains import core` names both the package and the module
        if name == "domains" and "domains.core" in allowed:
            continue
        assert any(name == prefix or name.startswith(prefix + ".") for prefix in allowed), (
            f"{path.relative_to(ROOT)} imports {name}; {_layer(path)} may import {', '.join(allowed)}"
        )
        if _layer(path) == "nesy":
            assert not name.startswith("nesy.cli"), f"{path.relative_to(ROOT)} imports the command line"


def test_submodules_are_found_when_they_are_asked_for() -> None:
    code = (
        "import nesy, planners, sys; assert 'torch' not in sys.modules; "
        "nesy.formats.export; nesy.asp.KnowledgeBase; nesy.perspective.shift; planners.explicit.TabularPOMDP; "
        "assert not hasattr(nesy, 'nothing')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("package", ["nesy", "planners", "domains", "nesy.cli.main", "planners.config"])
def test_importing_is_cheap(package: str) -> None:
    heavy = ("torch", "numba", "clingo", "pomdp_py", "matplotlib", "sklearn", "scipy")
    program = f"import sys, {package}; print([name for name in {heavy!r} if name in sys.modules])"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    assert loaded.stdout.strip() == "[]"
