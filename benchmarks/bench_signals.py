"""One step of the streaming operators, and a long record, compared with SciPy and plain NumPy."""

from __future__ import annotations

import numpy as np
from blocks import Contender, Table, agree, loop, once, table
from plain import oracles
from scipy.signal import lfilter

from armlab.signals import CausalDiff, ExpFilter, Integrator, LowPass2, Notch

DT = 0.004
BAR = 2.0  # relative to a copy of the array, for one step of 7 joints
COPY = "a Python function that copies the array"
JOINTS = 7


def run(quick: bool) -> list[Table]:
    """Measure `step` for 7 joints, and `run` for a record of 1e6 samples."""
    rng = np.random.default_rng(0)
    samples = list(rng.standard_normal((1000, JOINTS)))
    operators = [LowPass2(10.0, DT), Integrator(DT), ExpFilter(0.1, DT), CausalDiff(10.0, DT), Notch(30.0, 2.0, DT)]
    reference = oracles.SignalOperator("lowpass", 2 * np.pi * 10.0, np.sqrt(0.5), DT)
    worst = agree("LowPass2", operators[0].run(np.array(samples)), reference.run(np.array(samples)), 1e-10)
    steps = [
        *(
            Contender(f"armlab {type(one).__name__}.step(x)", loop(one.step, samples), "armlab", BAR, over=COPY)
            for one in operators
        ),
        Contender("armlab's reference kernel, LowPass2", loop(reference.step, samples), note="plain NumPy"),
        Contender(COPY, loop(lambda x: x.copy(), samples), "limit"),
    ]
    text = f"One sample of {JOINTS} joints. Results agree with the reference to {worst:.1g}."
    record = rng.standard_normal((100_000 if quick else 1_000_000, JOINTS))
    alpha = np.exp(-DT / 0.1)
    filtered, scipy = ExpFilter(0.1, DT, init=0.0), _scipy(alpha)
    worst = agree("ExpFilter", filtered.run(record[:1000]), scipy(record[:1000]), 1e-10)

    def fresh() -> np.ndarray:
        filtered.reset()
        return filtered.run(record)

    long = [
        Contender("armlab ExpFilter.run(x)", once(fresh), "armlab"),
        Contender("scipy.signal.lfilter", once(lambda: scipy(record))),
        Contender("a copy of the record", once(record.copy), "limit"),
    ]
    what = f"First-order low-pass of {len(record)} samples x {JOINTS}; agreement to {worst:.1g}."
    return [
        table("Signals: one step", text, "µs", steps, 5 if quick else 50),
        table("Signals: a record", what, "ms", long, 3 if quick else 20),
    ]


def _scipy(alpha: float):
    return lambda x: lfilter([1.0 - alpha], [1.0, -alpha], x, axis=0)
