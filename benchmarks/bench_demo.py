"""Duration of `armlab demo`, most of which is paced by the clock of the simulated robot."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
from blocks import Contender, Table, table


def run(quick: bool) -> list[Table]:
    """Run the demo once, as a user would."""
    text = (
        "Wall-clock time of one complete demo: two real-time runs over EGM, computation, figures. The demo met its own "
        "targets; otherwise there would be no figure."
    )
    demo = Contender("armlab demo", lambda: _demo(quick), "armlab")
    return [table("The demo", text, "s", [demo], 1, warm=False)]


def _demo(quick: bool) -> np.ndarray:
    words = [sys.executable, "-m", "armlab", "demo", *(["--fast"] if quick else [])]
    with tempfile.TemporaryDirectory() as folder:
        start = perf_counter()
        done = subprocess.run([*words, "-o", str(Path(folder) / "demo")], capture_output=True, text=True, check=False)
        seconds = perf_counter() - start
    if done.returncode:
        raise RuntimeError(f"Expected a demo that meets its targets, got:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return np.array([seconds])
