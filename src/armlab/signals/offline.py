"""Offline, zero-phase operators: they use the future and therefore have no `step`."""

from __future__ import annotations

import numpy as np

from armlab.errors import ShapeError

__all__ = ["central_diff", "lowpass_offline"]


def lowpass_offline(x: np.ndarray, rate: float, cutoff: float, order: int = 4) -> np.ndarray:
    """Filter along axis 0 with a Butterworth filter run forward and backward: no phase, twice the order.

    Parameters
    ----------
    x : (N, ...) samples, finite.
    rate : sampling rate [Hz].
    cutoff : corner frequency of one pass [Hz], below ``rate / 2``.
    order : order of one pass.

    Returns
    -------
    (N, ...) filtered samples.

    Raises
    ------
    ShapeError : when the record is too short for the filter, is not finite, or the cut-off is outside (0, rate / 2).
    """
    from scipy.signal import butter, sosfiltfilt

    x = np.asarray(x, dtype=float)
    if not 0.0 < cutoff < rate / 2:
        raise ShapeError(f"Expected a cut-off between 0 and {rate / 2:g} Hz (half the rate), got {cutoff:g} Hz.")
    sections = np.asarray(butter(order, cutoff / (rate / 2), output="sos"))
    needed = 6 * sections.shape[0] + 4
    if x.shape[0] < needed:
        raise ShapeError(f"Expected at least {needed} samples to filter, got {x.shape[0]}. Record for longer.")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=tuple(range(1, x.ndim))))
    if len(bad):
        raise ShapeError(
            f"Expected finite samples, got NaN or Inf in {len(bad)} rows, first {bad[:5].tolist()}: a filter would "
            "spread them over the whole record. Drop the rows or cut the record there."
        )
    return sosfiltfilt(sections, x, axis=0)


def central_diff(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Differentiate along axis 0: second-order central differences on the true time stamps, one-sided at the ends.

    Parameters
    ----------
    x : (N, ...) samples.
    t : (N,) times [s], strictly increasing.

    Returns
    -------
    (N, ...) derivative [unit of x per second].
    """
    t = np.asarray(t, dtype=float)
    if t.ndim != 1 or len(t) != len(x) or len(t) < 3 or not np.all(np.diff(t) > 0):
        raise ShapeError(
            f"Expected at least 3 strictly increasing times for {len(x)} samples, got an array of shape {t.shape}. "
            "Drop repeated and backward stamps first."
        )
    return np.gradient(np.asarray(x, dtype=float), t, axis=0, edge_order=2)
