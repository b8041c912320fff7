"""Accuracy of the estimated contact force; `accuracy.py` covers more seeds."""

from __future__ import annotations

from itertools import repeat

import force_protocol as protocol
import numpy as np
from all_cores import on_all_cores
from blocks import Contender, Table, figures

ROBOT = "yumi_left"
METHODS = ("map", "bounded", "observer", "kf")
GAINS = {0.0: 1.0, 0.05: 1.5}  # largest unknown gain error of each torque sensor, and target [N]


def run(quick: bool) -> list[Table]:
    """Identify and estimate with every method on logs of the simulated arm; no peer supports such logs."""
    seeds = 1 if quick else 5
    text = (
        f"{seeds} seeds of the protocol of *Accuracy of the estimated force* on the simulated {ROBOT}: a model from "
        "60 s of motion, and pushes of 5 N during another motion of 60 s. Values are the RMS force error of the worst "
        "axis during pushes. Medians are over the seeds. The targets are those of the project for `map`."
    )
    tables = []
    for gains, bar in GAINS.items():
        rms = np.array(on_all_cores(_rms, range(seeds), repeat(gains)))
        contenders = [
            Contender(f"armlab contact.Estimator, {method}", lambda: np.zeros(0), "armlab",
                      bar if method == METHODS[0] else None)
            for method in METHODS
        ]  # fmt: skip
        title = f"Force error{', torque sensors off by up to 5 %' if gains else ''}"
        tables.append(Table(title, text, "N", figures(contenders, list(rms.T[..., None])), seeds))
    return tables


def _rms(seed: int, gains: float) -> list[float]:
    """Return the error of the worst axis for each method [N]."""
    logs = protocol.record(ROBOT, seed, gains)
    return [float(protocol.judge(logs, method).rms.max()) for method in METHODS]
