"""Dependencies flow one way, and starting is cheap."""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path

import networkx
import pytest

ROOT = Path(__file__).resolve().parent.parent
# package -> what it may import of our own code
GENERAL = tuple(f"planners.{name}" for name in (
    "agents", "baselines", "config", "dqn", "explicit", "models", "perception", "search", "shielding"
))  # fmt: skip
ALLOWED = {
    "domains": ("domains",),
    "nesy": ("nesy", "domains.core"),
    "nesy/cli": ("nesy", "domains", "planners"),
    "planners": (*GENERAL, "nesy", "domains.core"),
    "planners/person_following": (*GENERAL, "planners.person_following", "nesy", "domains.core"),
    "planners/comparison": ("planners", "nesy", "domains.core"),
}


def _imports(path: Path) -> set[str]:
    return _imported(ast.parse(path.read_text(encoding="utf-8")))


def _imported(tree: ast.Module) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in line {node.lineno}"
            found.add(node.module or "")
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def _files() -> list[Path]:
    return sorted(path for package in ("domains", "nesy", "planners") for path in (ROOT / package).rglob("*.py"))


def _layer(path: Path) -> str:
    relative = path.relative_to(ROOT).as_posix()
    if relative == "nesy/__main__.py":
        return "nesy/cli"
    inner = "/".join(relative.split("/")[:2])
    return inner if inner in ALLOWED else relative.split("/")[0]


@pytest.mark.parametrize("path", _files(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_dependencies_flow_one_way(path: Path) -> None:
    allowed = ALLOWED[_layer(path)]
    for name in _imports(path):
        if name.split(".")[0] not in ("domains", "nesy", "planners"):
            continue
        # `from domains import core` names both the package and the module
        if name in ("domains", "planners") and any(prefix.startswith(name) for prefix in allowed):
            continue
        assert any(name == prefix or name.startswith(prefix + ".") for prefix in allowed), (
            f"{path.relative_to(ROOT)} imports {name}; {_layer(path)} may import {', '.join(allowed)}"
        )
        if _layer(path) == "nesy":
            assert not name.startswith("nesy.cli"), f"{path.relative_to(ROOT)} imports the command line"


def test_no_modules_import_each_other_in_a_cycle() -> None:
    paths = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in _files()
    }
    graph = networkx.DiGraph()
    for module, path in paths.items():
        tree = _without_typing(ast.parse(path.read_text(encoding="utf-8")))
        imported = {name for name in _imported(tree) if name in paths} - {module}
        # `from package import module` imports the module, and runs the package, which every file in it may do
        graph.add_edges_from((module, name) for name in imported if not module.startswith(name + "."))
    cycles = [sorted(part) for part in networkx.strongly_connected_components(graph) if len(part) > 1]
    assert not cycles, cycles


def _without_typing(tree: ast.Module) -> ast.Module:
    """The module without what only type checkers import."""

    class Cut(ast.NodeTransformer):
        def visit_If(self, node: ast.If) -> ast.AST | None:
            return None if "TYPE_CHECKING" in ast.dump(node.test) else self.generic_visit(node)

    return Cut().visit(tree)


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


@pytest.mark.parametrize("path", sorted((ROOT / "scripts").glob("*.py")), ids=lambda path: path.name)
def test_what_scripts_import_is_there(path: Path) -> None:
    """Nobody else looks: scripts are run by hand, and type checkers are not asked about them."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("domains", "nesy", "planners"):
            module = importlib.import_module(str(node.module))
            missing = [
                a.name for a in node.names if not hasattr(module, a.name) and not _is_module(node.module, a.name)
            ]
            assert not missing, f"{node.module} has no {', '.join(missing)}"


def _is_module(package: str | None, name: str) -> bool:
    return importlib.util.find_spec(f"{package}.{name}") is not None
