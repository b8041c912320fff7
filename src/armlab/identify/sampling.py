"""What the sampling of a log is fast enough for: friction as a whole, and a line of torque ripple."""

from __future__ import annotations

import numpy as np

from armlab.errors import ShapeError

__all__ = ["MIN_RATE", "SLOW_SHARE", "check_rate", "slow_enough"]

MIN_RATE = 40.0  # Hz: four samples in a period of the 10 Hz that models and estimators keep
SLOW_SHARE = 0.25  # of the sampling rate: a faster ripple line folds back


def check_rate(t: np.ndarray) -> None:
    """Refuse a log whose sampling is too slow for friction: below `MIN_RATE`.

    Parameters
    ----------
    t : (N,) times [s], increasing.

    Raises
    ------
    ShapeError : with the rate that came.
    """
    rate = 1.0 / float(np.median(np.diff(t)))
    if rate < MIN_RATE * (1.0 - 1e-6):
        hint = " If t is in milliseconds, divide it by 1000." if rate < 10.0 else ""
        raise ShapeError(
            f"Expected a log of at least {MIN_RATE:g} Hz, got {rate:.4g} Hz: friction changes within one sample when a "
            f"joint turns round.{hint} Record faster; resampling does not bring it back."
        )


def slow_enough(qd: np.ndarray, rate: float, cycles: np.ndarray) -> np.ndarray:
    """Return where (N, n) a ripple line passes below a quarter of the sampling rate; a faster one folds back.

    ``cycles |qd| / (2 pi) < rate / 4``

    Parameters
    ----------
    qd : (N, n) velocity [rad/s]. rate : of sampling [Hz]. cycles : (n,) line [rad/rad].
    """
    return np.abs(qd) * cycles < 2 * np.pi * SLOW_SHARE * rate
