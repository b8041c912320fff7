"""Accuracy of the estimated contact force; `accuracy.py` covers more seeds."""

from __future__ import annotations

from itertools import repeat

import force_protocol as protocol
import numpy as np
from all_cores import on_all_cores
from blocks import Contender, Table, figures

ROBOT = "yumi_left"
METHODS = ("map", "bounded", "observer", "kf")
GAINS = {0.0: 1.0, 0.05: 1.5}  # maximum unknown gain error per torque sensor: target [N]


def run(quick: bool) -> list[Table]:
    """Identify and estimate with every method on simulated logs; no peer supports such logs."""
    seeds = 1 if quick else 5
    text = (
        f"{seeds} seeds of the protocol of *Accuracy of the estimated force* on the simulated {ROBOT}: a model from "
        "60 s of motion, and 5 N pushes during 60 s of another motion. Values are RMS force errors of the worst axis "
        "during pushes, as medians over the seeds. The targets are the project's targets for `map`."
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
    """Return the error of the worst axis per method [N]."""
    logs = protocol.record(ROBOT, seed, gains)
    return [float(protocol.judge(logs, method).rms.max()) for method in METHODS]
