"""Public functions answer random arguments with a result, an `ArmlabError` or a `TypeError`, and nothing else."""

from __future__ import annotations

import importlib
import inspect
import random
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, is_typeddict

import numpy as np
import pytest

from armlab import log, robots
from armlab.errors import ArmlabError

PACKAGES = (
    "calibrate", "contact", "estimation", "frames", "glossary", "identify", "kernels", "kinematics", "lie", "log",
    "models", "motion", "plots", "robots", "signals", "wire",
)  # fmt: skip
"""All but those that open sockets or start programs."""

CALLS = 25  # of each function
PLAIN = {
    "ArrayLike", "Collection", "Iterable", "Literal", "Mapping", "None", "Path", "Sequence", "bool", "bytes", "dict",
    "float", "int", "integer", "list", "ndarray", "np", "str", "tuple",
}  # fmt: skip


class Thing:
    """An object from another program."""


HOSTILE: list[Any] = [
    None, "text", "", b"x", [[1.0], [2.0, 3.0]], [], (), {}, {"a": 1}, np.zeros((3, 2)), np.zeros(0), np.array("a"),
    np.zeros((2, 3, 4, 5)), np.array([None, 1], dtype=object), np.array([1j, 2]), np.array([1, 2, 3], dtype=np.int8),
    np.full(6, np.nan), np.full((4, 4), np.inf), float("nan"), float("inf"), -1, 0, 2**70, -2.5, 1e308, True, Thing(),
    Thing, len, np.float64, np.array(3.0), [np.zeros(3)] * 2, range(3), np.zeros(7), np.eye(4), np.eye(3), 3,
    np.array(["a", "b"]), np.datetime64("2020-01-01"), ["a", 1],
]  # fmt: skip


def functions(package: ModuleType, name: str, seen: set[int]) -> Iterator[tuple[str, Callable[..., Any]]]:
    """Functions and classes that a package lists, and class methods that create instances."""
    for key in package.__all__:
        thing, path = getattr(package, key), f"{name}.{key}"
        if inspect.ismodule(thing):
            yield from functions(thing, path, seen)
        elif callable(thing) and id(thing) not in seen and not is_typeddict(thing):
            seen.add(id(thing))
            yield path, thing
            for made, method in vars(thing).items() if inspect.isclass(thing) else ():
                if isinstance(method, classmethod | staticmethod) and not made.startswith("_"):
                    yield f"{path}.{made}", getattr(thing, made)


ROBOT = robots.load("yumi_right")
TIMES = 0.004 * np.arange(50)
TABLE = log.Table(TIMES, {name: np.outer(np.sin(9 * TIMES), np.ones(7)) for name in ("q", "qd", "tau")})


def argument(parameter: inspect.Parameter, choose: random.Random) -> Any:
    """A hostile value for a parameter of plain type, a real robot or table, or NotImplemented for other types."""
    words = set(re.findall(r"[A-Za-z_]\w*", re.sub(r"Literal\[[^]]*\]", "", str(parameter.annotation))))
    if words <= PLAIN:
        return choose.choice(HOSTILE)
    return ROBOT if "Robot" in words else TABLE if "Table" in words else NotImplemented


def arguments(function: Callable[..., Any], choose: random.Random) -> tuple[list[Any], dict[str, Any]] | None:
    """Arguments of one call, or None if a parameter needs an armlab object that is neither robot nor table."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of C++
        return [choose.choice(HOSTILE) for _ in range(choose.randint(0, 4))], {}
    given = {}
    for one in parameters:
        if one.kind in (one.VAR_POSITIONAL, one.VAR_KEYWORD) or (
            one.default is not one.empty and choose.random() < 0.6
        ):
            continue
        value = argument(one, choose)
        if value is not NotImplemented:
            given[one.name] = value
        elif one.default is one.empty:
            return None
    return [], given


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("package", PACKAGES)
def test_hostile_arguments_are_refused_in_words(package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # some of them write files
    choose, wrong = random.Random(0), []
    module = importlib.import_module(f"armlab.{package}")
    for path, function in functions(module, package, set()):
        for _ in range(CALLS if package != "plots" else 5):  # each draws a figure
            call = arguments(function, choose)
            if call is None or path == "kernels.Datagrams":  # which takes a socket
                break
            try:
                function(*call[0], **call[1])
            except (ArmlabError, TypeError) as error:
                if type(error) is not TypeError and "ufunc" in str(error):
                    wrong.append(f"{path}: {error!r}")
            except Exception as error:
                wrong.append(f"{path}: {error!r} of {call}"[:300])
    assert not wrong, "\n".join(wrong)
