"""Processor time of imports, beyond those of Python and NumPy, and of the help of the commands."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable

import numpy as np
from blocks import Contender, Table, table

BAR = 0.030
HELP_BAR = 0.300
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
    """Measure ``import armlab`` and ``import armlab.kinematics`` after NumPy, and ``armlab VERB --help``, each anew."""
    contenders = [
        Contender("armlab.kinematics", _importing("armlab.kinematics"), "armlab", BAR),
        Contender("armlab", _importing("armlab"), "armlab", BAR),
        Contender("pinocchio", _importing("pinocchio")),
        Contender("roboticstoolbox", _importing("roboticstoolbox")),
    ]
    helps = [
        Contender(f"armlab {verb} --help".replace("  ", " "), _helping(*verb.split()), "armlab", HELP_BAR)
        for verb in VERBS
    ]
    times = 3 if quick else 7
    text = "Processor time of the import in a fresh interpreter that has NumPy already; files are compiled and cached."
    help_text = "Processor time of the whole process, the interpreter's own start included."
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


def _helping(*words: str) -> Callable[[], np.ndarray]:
    def block() -> np.ndarray:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-m", "armlab", *words, "--help"]
        subprocess.run(command, check=True, capture_output=True, env=_environment())
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return np.array([after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime])

    block()
    return block


def _environment() -> dict[str, str]:
    """Return that of a user: pip compiles what it copies; of an editable armlab the first import does."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
