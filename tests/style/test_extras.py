"""Imports are declared; extras are imported where they are used, and named when they are missing."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "armlab"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
MODULES = {
    "eclipse-zenoh": "zenoh",
    "opencv-contrib-python-headless": "cv2",
    "protobuf": "google",
    "ruamel.yaml": "ruamel",
    "tomli-w": "tomli_w",
}  # packages that are imported under another name
NOT_IMPORTED = {"pycollada", "example-robot-data"}  # trimesh imports it to read .dae; files only
BROUGHT = {"attrs", "mpl_toolkits", "trimesh"}  # by cyclopts, for its help; by matplotlib; by viser, for its scenes
NAMED = re.compile(r"^\s*(?:import|from) (\w+)|(?:import_module|needed)\(\"(\w+)", flags=re.M)
BLOCKED = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Block())
import importlib
for name in {packages!r}:
    importlib.import_module(name)
print("all")
"""


def modules(requirements: list[str]) -> set[str]:
    """Names by which required packages are imported."""
    names = {re.split(r"[\[<>=]", one)[0] for one in requirements} - NOT_IMPORTED
    return {MODULES.get(name, name) for name in names}


REQUIRED = modules(PROJECT["dependencies"])
EXTRAS = {
    extra: modules(names)
    for extra, names in PROJECT["optional-dependencies"].items()
    if extra not in ("dev", "fuzz", "mutation", "wheel")
}
OPTIONAL = {module: extra for extra, names in EXTRAS.items() for module in names}


def named(source: str) -> set[str]:
    """Return possible names of imported modules, rather too many than too few; faster than parsing every file."""
    return {one or other for one, other in NAMED.findall(source)}


def imports(node: ast.AST, answers: str = "") -> Iterator[tuple[str, int, str]]:
    """Yield the module, the line and the source of the enclosing `try` handlers of each import that is executed."""
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return
    names: list[str] = []
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        names = [node.module or ""]
    elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("import_module", "needed"):
        names = [arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant)]
        if node.func.id == "needed":  # type: ignore[attr-defined]
            answers = (SOURCE / "log" / "file_formats" / "opening.py").read_text(encoding="utf-8")
    yield from ((name.partition(".")[0], getattr(node, "lineno", 0), answers) for name in names)
    for child in ast.iter_child_nodes(node):
        inside = isinstance(node, ast.Try) and child in node.body
        yield from imports(child, "".join(map(ast.unparse, node.handlers)) if inside else answers)  # type: ignore[attr-defined]


def faults(source: str) -> list[str]:
    known = sys.stdlib_module_names | REQUIRED | BROUGHT | {"armlab"}
    if named(source) <= known:
        return []
    found = []
    for module, line, answers in imports(ast.parse(source)):
        if module in known:
            continue
        if module not in OPTIONAL:
            found.append(f"line {line}: {module} is imported, but not declared in pyproject.toml")
        elif "MissingExtra" not in answers or f"armlab[{OPTIONAL[module]}]" not in answers:
            found.append(f"line {line}: where {module} is missing, MissingExtra must name armlab[{OPTIONAL[module]}]")
    return found


def test_every_import_is_declared_and_every_missing_extra_is_named() -> None:
    found = {str(path.relative_to(ROOT)): faults(path.read_text(encoding="utf-8")) for path in SOURCE.rglob("*.py")}
    assert {path: wrong for path, wrong in found.items() if wrong} == {}


def test_the_rule_can_fail() -> None:
    assert "not declared" in faults("import pandas")[0]
    assert "must name armlab[motion]" in faults("def f():\n    import ruckig")[0]
    wrong = "try:\n    import ruckig\nexcept ImportError:\n    raise MissingExtra('armlab[data]')"
    assert "must name armlab[motion]" in faults(wrong)[0]
    assert faults(wrong.replace("data", "motion")) == []
    assert faults("h5py = needed('h5py', 'to see')") == []


def test_extras_are_those_that_are_used_and_the_tests_have_them_all() -> None:
    used = set().union(*(named(path.read_text(encoding="utf-8")) for path in SOURCE.rglob("*.py")))
    assert set(OPTIONAL) <= used
    assert used >= REQUIRED
    assert set(OPTIONAL) <= modules(PROJECT["optional-dependencies"]["dev"])


@pytest.mark.slow
def test_every_package_is_imported_without_any_extra() -> None:
    packages = [".".join(path.parent.relative_to(ROOT / "src").parts) for path in SOURCE.rglob("__init__.py")]
    assert len(packages) > 20
    others = modules(PROJECT["optional-dependencies"]["dev"]) | set(OPTIONAL) | {"websockets", "IPython"}
    program = BLOCKED.format(names=others - REQUIRED, packages=sorted(packages))
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.stdout == "all\n", result.stderr
