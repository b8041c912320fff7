"""Block of `bench_recorder` over a simulated link in real time: measures the cost of each row to the loop."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from recorder_rows import signals

from armlab import bridge, robots
from armlab.log import Recorder, Tick
from armlab.state import Command, State


def in_the_loop(folder: Path, robot: str, seconds: float) -> np.ndarray:
    """Return the time of each call of `Recorder.row` in a run whose controller commands and records at every tick."""
    taken, real, rng = [], Recorder.row, np.random.default_rng(0)

    def timed(self: Recorder, state: State, command: Command | None, tick: Tick) -> bool:
        start = time.perf_counter()
        kept = real(self, state, command, tick)
        taken.append(time.perf_counter() - start)
        return kept

    def controller(state: State) -> Command:
        record = {
            "wrench_hat": rng.normal(size=6),
            "wrench_hat_cov": rng.normal(size=(6, 6)),
            "grip": rng.normal(size=3),
        }
        return Command(state.q, 0.0 * state.qd, record=record)

    Recorder.row = timed  # type: ignore[method-assign]
    try:
        with bridge.connect(f"sim://{robot}", robots.load(robot), patience=20.0) as link:
            run = link.run(controller, seconds, record=folder / "loop.mcap", extra=signals())
    finally:
        Recorder.row = real  # type: ignore[method-assign]
    (folder / "loop.mcap").unlink()
    if len(taken) < run.statistics["replies"]:
        raise RuntimeError(f"Expected a row for each of {run.statistics['replies']} replies, got {len(taken)}.")
    return np.array(taken)
