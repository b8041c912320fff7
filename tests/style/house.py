"""The size and shape of the code base: `make house` prints each measurement beside its goal.

Everything is read from the sources, except the call traces of one datagram and of `fit_dynamics`. Import cycles of any
kind count: at import, inside functions, or for type hints.
"""

from __future__ import annotations

import ast
import socket
import sys
import time
from collections import Counter
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import numpy as np

from armlab import log, robots
from armlab.bridge import Limits
from armlab.bridge.control.loop import Loop
from armlab.bridge.control.realtime import Waiting
from armlab.bridge.control.run import End, assemble
from armlab.bridge.control.supervision import Settings
from armlab.bridge.net.sockets import Port
from armlab.identify import fit_dynamics
from armlab.state import Command
from armlab.wire.egm import EgmCodec
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec

__all__ = ["GOALS", "Goal", "circles", "measured", "table"]

ROOT = Path(__file__).parents[2]
SOURCE, TESTS, NATIVE = ROOT / "src" / "armlab", ROOT / "tests", ROOT / "native"
GENERATED = {SOURCE / "wire/egm/armlab_egm_pb2.py"}


class Goal(NamedTuple):
    """One line of the table: the quantity measured, its value when the goals were set, and its upper limit."""

    name: str
    before: int
    most: int


GOALS = (
    Goal("Python in src, lines", 92_700, 70_000),
    Goal("Python in src, files", 642, 320),
    Goal("tests, lines", 86_000, 60_000),
    Goal("tests, files", 694, 330),
    Goal("C++, lines", 10_400, 10_000),
    Goal("widest folder, modules", 66, 15),
    Goal("import circles", 14, 0),
    Goal("public names", 1_435, 900),
    Goal("one datagram: files", 26, 12),
    Goal("one datagram: Python calls", 85, 45),
    Goal("fit_dynamics, files visited", 43, 14),
    Goal("fit_dynamics, files deep", 16, 9),
)


def lines(paths: list[Path]) -> int:
    """Return the lines of files."""
    return sum(path.read_bytes().count(b"\n") for path in paths)


def modules() -> dict[str, Path]:
    """Return the modules of the package by dotted name."""
    found = {}
    for path in sorted(SOURCE.rglob("*.py")):
        parts = path.relative_to(SOURCE.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(path: Path, known: dict[str, Path]) -> Iterator[str]:
    """Yield the modules of the package that a file imports anywhere: a name from a package counts as its module."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module in known:
            for alias in node.names:
                inside = f"{node.module}.{alias.name}"
                yield inside if inside in known else node.module


@cache
def circles() -> list[list[str]]:
    """Return the groups of modules that import one another, each a strongly connected component (Tarjan)."""
    known = modules()
    facade = {"armlab"}  # imports everything, and is imported for its version
    graph = {name: sorted(set(imports(path, known)) - {name} - facade) for name, path in known.items()}
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(start: str) -> None:
        work = [(start, iter(graph[start]))]
        index[start] = low[start] = len(index)
        stack.append(start)
        while work:
            name, rest = work[-1]
            for other in rest:
                if other not in index:
                    index[other] = low[other] = len(index)
                    stack.append(other)
                    work.append((other, iter(graph[other])))
                    break
                if other in stack:
                    low[name] = min(low[name], index[other])
            else:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[name])
                if low[name] == index[name]:
                    group = stack[stack.index(name) :]
                    del stack[stack.index(name) :]
                    if len(group) > 1:
                        found.append(sorted(group))

    for name in graph:
        if name not in index:
            visit(name)
    return found


def public_names() -> int:
    """Return how many names the packages export."""
    listed = Path(__file__).with_name("public_api.txt").read_text(encoding="utf-8").splitlines()
    return len(listed)


def datagram() -> tuple[int, int]:
    """Return the files and calls of the package from a received datagram to its reply and row, in a steady cycle."""
    robot, port, calls, cycles = robots.load("yumi_right"), Port("127.0.0.1", 0), list[str](), list[tuple[int, int]]()
    quiet: dict[str, Any] = {"extra": None, "attachments": {}, "feeds": (), "sources": ()}
    arms = assemble(
        [End(robot, port, EgmCodec(robot))],
        [Limits.of(robot)],
        Settings(),
        commands=True,
        answer_stream=True,
        record=None,
        **quiet,
    )
    waiting = Waiting([port], [arms[0].prediction], "block")
    loop = Loop(arms, waiting, lambda state: Command(state.q_start), Settings())

    def count(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(str(SOURCE)):
            calls.append(frame.f_code.co_filename)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        for number in range(50):
            now = time.time_ns()
            message = RobotMessage(number, now // 1_000_000 % 2**32, robot.q_home, robot.q_home, robot_ns=now)
            peer.sendto(RobotSideCodec(robot).encode_robot(message), (port.host, port.port))
            calls.clear()
            sys.setprofile(count)
            loop.cycle()
            sys.setprofile(None)
            cycles.append((len(set(calls)), len(calls)))
            time.sleep(2e-3)
    port.close()
    return sorted(cycles)[len(cycles) // 2]


def short_log() -> tuple[Any, Any]:
    """Return an arm of two joints and 20 s of its free motion."""
    turned, beside = np.eye(4), np.eye(4)
    turned[:3, :3], beside[0, 3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]], 0.3
    robot = robots.from_links("short", [np.eye(4), turned, beside])
    rng = np.random.default_rng(99)
    t, w = np.arange(2000) / 100.0, 2 * np.pi * np.array([0.11, 0.23, 0.37, 0.61, 0.83])[:, None, None]
    a, x = rng.uniform(0.1, 0.3, (5, 1, 2)) / w, w * t[:, None] + rng.uniform(0, 6, (5, 1, 2))
    q, qd, qdd = (y.sum(axis=0) for y in (a * np.sin(x), a * w * np.cos(x), -a * w**2 * np.sin(x)))
    links = np.tile([1.5, 0.25, 0.05, 0.02, 0.05, 0.01, 0.2, 0, 0.01, 0.22], (2, 1))
    tau = robot.chain.rnea(q, qd, qdd, robot.gravity, links) + 0.2 * qdd + qd + 2 * np.tanh(qd / 0.02)
    return robot, log.Table(t, {"q": q, "qd": qd, "tau": tau + 0.2 * rng.standard_normal(q.shape)})


@cache
def fit_walk() -> tuple[int, int]:
    """Return how many files `fit_dynamics` visits, and through how many files its calls nest at most."""
    robot, table = short_log()
    fit_dynamics(table, robot)  # lazy imports are not part of the trace
    files: set[str] = set()
    stack: list[str] = []
    deepest = 0

    def look(frame: FrameType, event: str, _: object) -> None:
        nonlocal deepest
        name = frame.f_code.co_filename
        if event == "call" and name.startswith(str(SOURCE)):
            stack.append(name)
            files.add(name)
            deepest = max(deepest, 1 + sum(one != other for one, other in pairwise(stack)))
        elif event == "return" and name.startswith(str(SOURCE)) and stack:
            stack.pop()

    sys.setprofile(look)
    try:
        fit_dynamics(table, robot)
    finally:
        sys.setprofile(None)
    return len(files), deepest


@cache
def measured() -> dict[str, int]:
    """Return each figure by its name."""
    source = [path for path in SOURCE.rglob("*.py") if path not in GENERATED]
    tests = list(TESTS.rglob("*.py"))
    native = [path for path in NATIVE.rglob("*") if path.suffix in (".cpp", ".h")]
    widest = Counter(path.parent for path in source).most_common(1)[0][1]
    figures = (
        lines(source), len(source), lines(tests), len(tests), lines(native), widest, len(circles()), public_names(),
        *datagram(),
        *fit_walk(),
    )  # fmt: skip
    return dict(zip((goal.name for goal in GOALS), figures, strict=True))


def table() -> str:
    """Return the table."""
    figures = measured()
    rows = [f"{'':28} {'was':>8} {'now':>8} {'goal':>8}"]
    for goal in GOALS:
        now = figures[goal.name]
        rows.append(f"{goal.name:28} {goal.before:>8} {now:>8} {goal.most:>8}{'' if now <= goal.most else '  not met'}")
    rows += [f"circle: {', '.join(group)}" for group in circles()]
    return "\n".join(rows)


if __name__ == "__main__":
    print(table())
