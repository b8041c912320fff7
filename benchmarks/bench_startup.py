"""Processor time of imports, beyond those of Python and NumPy."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable

import numpy as np
from blocks import Contender, Table, table

BAR = 0.030
PROGRAM = """
import numpy
from time import process_time
start = process_time()
import {module}
print(process_time() - start)
"""


def run(quick: bool) -> list[Table]:
    """Measure ``import armlab`` and ``import armlab.kinematics`` in fresh interpreters, after NumPy."""
    contenders = [
        Contender("armlab.kinematics", _importing("armlab.kinematics"), "armlab", BAR),
        Contender("armlab", _importing("armlab"), "armlab", BAR),
        Contender("pinocchio", _importing("pinocchio")),
        Contender("roboticstoolbox", _importing("roboticstoolbox")),
    ]
    text = "Processor time of the import in a fresh interpreter that has NumPy already; files are compiled and cached."
    return [table("Import", text, "ms", contenders, 3 if quick else 10)]


def _importing(module: str) -> Callable[[], np.ndarray]:
    command = [sys.executable, "-c", PROGRAM.format(module=module)]
    # pip compiles what it copies; of an editable armlab the first import does, unless the shell forbids it.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}

    def block() -> np.ndarray:
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
        return np.array([float(done.stdout.split()[-1])])

    block()
    return block
