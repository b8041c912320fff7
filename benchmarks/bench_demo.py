"""How long `armlab demo` takes, which paces itself by the clock of the simulated robot for most of the time."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
from blocks import Contender, Table, table

BAR = 120.0


def run(quick: bool) -> list[Table]:
    """Run the demo once, as a user does."""
    text = (
        "The whole demo by the clock on the wall, once: two runs over EGM in real time, what is computed, the figures. "
        "It met its own bars, or it would be no figure here."
    )
    demo = Contender("armlab demo", lambda: _demo(quick), "armlab", BAR)
    return [table("The demo", text, "s", [demo], 1, warm=False)]


def _demo(quick: bool) -> np.ndarray:
    words = [sys.executable, "-m", "armlab", "demo", *(["--fast"] if quick else [])]
    with tempfile.TemporaryDirectory() as folder:
        start = perf_counter()
        done = subprocess.run([*words, "-o", str(Path(folder) / "demo")], capture_output=True, text=True, check=False)
        seconds = perf_counter() - start
    if done.returncode:
        raise RuntimeError(f"Expected a demo that meets its bars, got:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return np.array([seconds])
