"""Processor time of imports (excluding Python and NumPy) and of the commands' help."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable

import numpy as np
from blocks import Contender, Table, table

BAR = 0.5  # relative to importing Pinocchio
HELP_BAR = 2.0  # relative to importing its libraries alone
LIBRARIES = "import numpy, cyclopts, rich"
VERBS = (
    "",
    "demo",
    "run",
    "record",
    "identify",
    "estimate",
    "calibrate hand-eye",
    "dmp fit",
    "log show",
    "plot",
    "bridge",
    "sim",
)
PROGRAM = """
import numpy
from time import process_time
start = process_time()
import {module}
print(process_time() - start)
"""


def run(quick: bool) -> list[Table]:
    """Measure ``import armlab`` and ``import armlab.kinematics`` after NumPy, and ``armlab VERB --help``, each in a new
    process.
    """
    contenders = [
        Contender("armlab.kinematics", _importing("armlab.kinematics"), "armlab"),
        Contender("armlab", _importing("armlab"), "armlab"),
        Contender("pinocchio", _importing("pinocchio"), bar=BAR),
        Contender("roboticstoolbox", _importing("roboticstoolbox")),
    ]
    helps = [
        Contender(
            " ".join(["armlab", *verb.split(), "--help"]),
            _running("-m", "armlab", *verb.split(), "--help"),
            "armlab",
            HELP_BAR,
            over=LIBRARIES,
        )
        for verb in VERBS
    ]
    helps.append(Contender(LIBRARIES, _running("-c", LIBRARIES), "limit"))
    times = 3 if quick else 7
    text = (
        "Processor time of the import in a fresh interpreter that has already imported NumPy; compiled files are "
        "cached."
    )
    help_text = "Processor time of the whole process, including the start of the interpreter."
    return [
        table("Import", text, "ms", contenders, times, warm=False),
        table("Help", help_text, "ms", helps, times, warm=False),
    ]


def _importing(module: str) -> Callable[[], np.ndarray]:
    command = [sys.executable, "-c", PROGRAM.format(module=module)]

    def block() -> np.ndarray:
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=_environment())
        return np.array([float(done.stdout.split()[-1])])

    block()
    return block


def _running(*words: str) -> Callable[[], np.ndarray]:
    def block() -> np.ndarray:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *words], check=True, capture_output=True, env=_environment())
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return np.array([after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime])

    block()
    return block


def _environment() -> dict[str, str]:
    """Return a user's environment with compiled files; an editable installation compiles them on first import, unlike
    pip.
    """
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
