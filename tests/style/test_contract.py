"""Every public `fit_*` is held to the statistical contract by a test, in the directory of its package."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE, TESTS = ROOT / "src" / "armlab", ROOT / "tests"


def fits() -> Iterator[tuple[str, str]]:
    """Yield package and name of every function `fit_*` that a package exports."""
    for path in sorted(PACKAGE.glob("*/__init__.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
                names = (name for name in ast.literal_eval(node.value) if name.startswith("fit_"))
                yield from ((path.parent.name, name) for name in names)


def judged(source: str) -> set[str]:
    """Return the names in a test that calls `check_estimator`, and in functions and tables of the module it uses."""
    names = {}
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef):
            names[node.name] = set(words(node))
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            names[node.targets[0].id] = set(words(node.value))
    found: set[str] = set()
    for inside in names.values():
        if "check_estimator" in inside:
            found |= inside.union(*(names[one] for one in inside & names.keys()))
    return found


@cache
def covered(package: str) -> set[str]:
    """Return the names that the tests of a package hold to the contract."""
    sources = (path.read_text(encoding="utf-8") for path in (TESTS / package).glob("test_*.py"))
    return set().union(*(judged(source) for source in sources if "check_estimator" in source))


def words(node: ast.AST) -> Iterator[str]:
    for part in ast.walk(node):
        if isinstance(part, ast.Name):
            yield part.id
        elif isinstance(part, ast.Attribute):
            yield part.attr


FITS = sorted(fits())


def test_there_are_fits() -> None:
    assert len(FITS) > 15
    assert {package for package, _ in FITS} >= {"calibrate", "frames", "identify"}


def test_every_fit_is_held_to_the_contract() -> None:
    left = [f"{package}.{name}" for package, name in FITS if name not in covered(package)]
    assert not left, f"no test in tests/ of the package hands {left} to estimation.check_estimator"


def test_the_reader_sees_what_it_must_see() -> None:
    source = (
        "def a(): check_estimator(fit_x)\ndef b(): return check_estimator(c)\ndef c(): frames.fit_y()\ndef d(): fit_z()"
    )
    assert judged(source) >= {"fit_x", "fit_y"}
    assert "fit_z" not in judged(source)
