"""Mutation tests of the files that move the robot: `python mutation/run.py [WORD ...] [--again]`.

WORDs select files by parts of their paths. A single pytest session collects the tests, and this process forks for each
mutant. The child substitutes the mutant in its own memory, without changing any file, and runs the tests that call the
changed function, fastest first, until one fails. A mutant that survives or cannot be substituted must be listed in
`survivors.toml` with the reason why no test can distinguish it from the original. Status 0 means that all mutants of
the files were tested, and either killed or explained.

mutmut generates the mutants but does not run them. It imports a copy of `src`, which the import hook of the editable
installation overrides. It omits constants and decorated functions. It also numbers the survivors, so the number of an
explained mutant would change with the next edit.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import json
import os
import signal
import sys
import threading
import time
import tomllib
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "mutation"))
import compiled  # noqa: E402
from mutants import Mutant, codes, is_same, loaded, mutants, transplant  # noqa: E402

EXPLAINED, LAST = ROOT / "mutation" / "survivors.toml", ROOT / "build" / "mutation.json"
BRIDGE = "src/armlab/bridge"
FILES = {  # file: its tests
    f"{BRIDGE}/control/limits.py": ["bridge/control/limits", "bridge/control/state_machine", "bridge/control/commands"],
    f"{BRIDGE}/control/torque.py": ["bridge/control/commands", "bridge/control/limits", "bridge/control/state_machine"],
    f"{BRIDGE}/control/realtime.py": ["bridge/control/realtime", "bridge/control/loop", "bridge/control/multi_arm"],
    f"{BRIDGE}/control/session.py": ["bridge/control/session"],
    f"{BRIDGE}/control/state_machine.py": [
        *("bridge/control/state_machine", "bridge/control/commands", "bridge/control/feedback"),
        *("bridge/control/arm", "bridge/control/multi_arm", "bridge/control/loop"),
    ],
    f"{BRIDGE}/arbiter.py": ["bridge/arbiter", "bridge/servers/ros/actions"],
    f"{BRIDGE}/control/loop.py": ["bridge/control/loop", "bridge/control/multi_arm"],
    f"{BRIDGE}/control/supervision.py": ["bridge/control/feedback"],
    f"{BRIDGE}/control/feedback.py": ["bridge/control/feedback"],
    f"{BRIDGE}/control/external_axes.py": ["bridge/control/commands"],
    f"{BRIDGE}/control/arm.py": [
        "bridge/control/arm",
        "bridge/control/multi_arm",
        "bridge/control/commands",
        "bridge/inputs/fusion",
    ],
    "native/math/motion/limits.cpp": ["kernels/limits"],
}
MARKED, NAMED = "not slow", "not (simulated or follows[)"  # excludes slow tests of complete simulated runs
NONE, FAILED = ("same", "no program"), "harness failed"  # outcomes without a mutant; outcome without a verdict
KINDS = "killed", "survived", "not reached", FAILED
CRASHES = -signal.SIGSEGV, -signal.SIGABRT, -signal.SIGBUS, -signal.SIGFPE, -signal.SIGILL
PATIENCE, AT_LEAST = 10.0, 5.0  # time limit: factor on the time without a mutant, and offset [s]


class Runner:
    """Pytest plugin that runs the collected tests for each mutant instead of once."""

    def __init__(self, files: list[str], only: set[tuple[str, ...]] | None) -> None:
        self.files, self.only = files, only
        self.results: list[tuple[Mutant, str]] = []
        self.failed = False

    def pytest_sessionstart(self) -> None:
        from hypothesis import Phase, settings  # after pytest, which rewrites its assertions

        usual = settings.get_profile("armlab")
        settings.register_profile("mutants", usual, phases=[Phase.explicit, Phase.generate])  # one failure suffices
        settings.load_profile("mutants")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.failed = self.failed or report.failed

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if session.testsfailed:
            raise SystemExit("Expected to collect the tests, got errors. Run them with pytest.")
        modules = {file: importlib.import_module(_module(file)) for file in self.files}
        watched = {one.__code__ for module in modules.values() for one in codes(module).values()}
        gc.collect()
        gc.freeze()  # keeps memory shared with the children
        told, _ = forked(lambda: self.without(session.items, watched))
        calls = json.loads(told or "null")
        if calls is None:
            raise SystemExit("Expected tests that pass without a mutant, got a failing test. Run them with pytest.")
        for file, module in modules.items():
            is_compiled = file.endswith(".cpp")
            items = [item for item in session.items if item.path in tests(file)]
            if is_compiled:
                same = compiled.prepare(ROOT / file, file)
                if forked(lambda one=same, at=module, of=items: self.outcome(one, at, of, calls))[0] != "survived":
                    raise SystemExit("Expected tests that pass with the file compiled alone, got a failing test.")
            for mutant in (compiled.mutants if is_compiled else mutants)(ROOT / file, file):
                if self.only is None or key(mutant) in self.only:
                    self.judge(mutant, module, items, calls)
        return True

    def judge(self, mutant: Mutant, module: ModuleType, items: list[pytest.Item], calls: dict[str, Any]) -> None:
        outcome, end = forked(lambda: self.outcome(mutant, module, items, calls))
        if not outcome:
            crashed = mutant.file.endswith(".cpp") and end in CRASHES
            ended = "killed by time" if end == -signal.SIGALRM else f"{FAILED}, status {end}"
            outcome = f"killed by a crash, status {end}" if crashed else ended
        if outcome in NONE:
            return
        self.results.append((mutant, outcome))
        if not outcome.startswith("killed") and key(mutant) not in explained():
            told = f"{mutant.file} {mutant.where}: {outcome}\n  - {mutant.before}\n  + {mutant.after}"
            print(told, flush=True)

    def without(self, items: list[pytest.Item], watched: set[CodeType]) -> str:
        """Run all tests without a mutant; return the time [s] and called functions of each, or "" on failure."""
        found = {}
        for item, following in zip(items, [*items[1:], None], strict=True):
            called: set[CodeType] = set()

            def watch(frame: Any, event: str, _: Any, called: set[CodeType] = called) -> None:
                if event == "call" and frame.f_code in watched:
                    called.add(frame.f_code)

            threading.setprofile(watch)
            sys.setprofile(watch)
            start = time.perf_counter()
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            sys.setprofile(None)
            threading.setprofile(None)  # type: ignore[arg-type]
            if self.failed:
                return ""
            found[item.nodeid] = time.perf_counter() - start, [name(code) for code in called]
        return json.dumps(found)

    def outcome(self, mutant: Mutant, module: ModuleType, items: list[pytest.Item], calls: dict[str, Any]) -> str:
        """Run the tests that reach a mutant in a child process, and return the outcome."""
        try:
            names = place(mutant, module)
        except SyntaxError:
            return "no program"
        if isinstance(names, str):
            return names
        seen = [item for item in items if names is None or names & set(calls[item.nodeid][1])]
        seen.sort(key=lambda item: calls[item.nodeid][0])
        if not seen:
            return "survived: no test calls it"
        for item, following in zip(seen, [*seen[1:], None], strict=True):
            signal.setitimer(signal.ITIMER_REAL, AT_LEAST + PATIENCE * calls[item.nodeid][0])  # SIGALRM ends the child
            try:
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            except KeyboardInterrupt:
                return f"killed by the interrupt of {item.nodeid}"
            if self.failed:
                return f"killed by {item.nodeid}"
        return "survived"


def place(mutant: Mutant, module: ModuleType) -> str | set[str] | None:
    """Substitute a mutant; return the names of code objects whose tests reach it (None: all), or why it failed.

    Raises
    ------
    SyntaxError : the mutant is not a valid program.
    """
    if mutant.file.endswith(".cpp"):
        return None if compiled.placed(mutant, module) else "same"
    names = {name(one.__code__) for one in codes(module).values()}
    if is_same(mutant, module):
        return "same"
    try:
        scratch = loaded(mutant, module)
    except Exception as error:
        return f"killed by its import: {error}"
    changed, has_more = transplant(scratch, module)
    if not changed and not has_more:
        return "not reached"
    return names if has_more else {name(code) for code in changed}


def _module(file: str) -> str:
    return "armlab.kernels._native" if file.endswith(".cpp") else file[4:-3].replace("/", ".")


def tests(file: str) -> list[Path]:
    """Return the test files for a source file."""
    return [ROOT / "tests" / Path(one).parent / f"test_{Path(one).name}.py" for one in FILES[file]]


def name(code: CodeType) -> str:
    """Return a name for a code object that is the same in every process."""
    return f"{code.co_filename}:{code.co_firstlineno}:{code.co_qualname}"


def key(mutant: Mutant) -> tuple[str, ...]:
    """Return the key under which a mutant is explained."""
    return mutant.file, mutant.where, mutant.before, mutant.after


def explained() -> set[tuple[str, ...]]:
    """Return the keys of the explained mutants."""
    found = tomllib.loads(EXPLAINED.read_text())["survivor"]
    return {(one["file"], one["where"], one["before"], one["after"]) for one in found}


def forked(work: Callable[[], str]) -> tuple[str | None, int]:
    """Run `work` in a child process; return its result, or None if it did not finish, and the exit status.

    A negative status is the number of the signal that ended the process.
    """
    source, sink = os.pipe()
    with warnings.catch_warnings(action="ignore"):  # running threads hold no armlab locks
        child = os.fork()
    if child == 0:
        status = 1
        try:
            os.setsid()
            os.close(source)
            null = os.open(os.devnull, os.O_RDWR)
            os.dup2(null, 1)
            os.dup2(null, 2)
            answer = work().encode()
            with os.fdopen(sink, "wb") as stream:
                stream.write(answer)
            status = 0
        finally:
            os._exit(status)
    os.close(sink)
    with os.fdopen(source, "rb") as stream:
        found = stream.read()
    _, status = os.waitpid(child, 0)
    return found.decode() if status == 0 else None, os.waitstatus_to_exitcode(status)


def main() -> int:
    """Run the command line; return 1 if a mutant survived without an explanation, or was not tested."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*")
    parser.add_argument("--again", action="store_true", help="test only the survivors of the last run")
    given = parser.parse_args()
    os.chdir(ROOT)
    files = [file for file in FILES if not given.words or any(word in file for word in given.words)]
    only = {tuple(one) for one in json.loads(LAST.read_text())} if given.again else None
    runner, start = Runner(files, only), time.monotonic()
    options = ["-pno:terminal", "-pno:xdist", "-pno:faulthandler", "-s", "-oaddopts=", "--import-mode=importlib"]
    chosen = sorted({str(test) for file in files for test in tests(file)})
    ended = pytest.main([*options, "-m", MARKED, "-k", NAMED, *chosen], [runner])
    is_whole = ended == pytest.ExitCode.OK
    if is_whole:
        keep(files, runner.results)
    else:
        print(f"Expected to test all mutants, got {ended!r} from pytest after {len(runner.results)}. Run it again.")
    status = report(files, runner.results) or int(not is_whole)
    print(f"{time.monotonic() - start:.0f} s")
    return status


def keep(files: list[str], results: list[tuple[Mutant, str]]) -> None:
    """Save the surviving mutants for `--again`."""
    LAST.parent.mkdir(exist_ok=True)
    others = [one for one in json.loads(LAST.read_text()) if one[0] not in files] if LAST.exists() else []
    LAST.write_text(json.dumps(others + [key(one) for one, outcome in results if not outcome.startswith("killed")]))


def report(files: list[str], results: list[tuple[Mutant, str]]) -> int:
    """Print the counts for each file; return 1 if a mutant was neither killed nor explained."""
    known, table = explained(), {file: Counter[str]() for file in files}
    for mutant, outcome in results:
        kind = next(one for one in KINDS if outcome.startswith(one))
        if kind in ("survived", "not reached") and key(mutant) in known:
            kind = "explained"
        table[mutant.file][kind] += 1
        if kind == "killed" and key(mutant) in known:
            print(f"Explained, but {outcome}: {mutant.before} -> {mutant.after}")
    for file, counts in table.items():
        words = ", ".join(f"{counts[kind]} {kind}" for kind in ("killed", "explained", *KINDS[1:]))
        print(f"{file}: {counts.total()} mutants, {words}")
    return int(not results or any(counts[kind] for counts in table.values() for kind in KINDS[1:]))


if __name__ == "__main__":
    sys.exit(main())
