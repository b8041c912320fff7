"""Signal processing: streaming operators for control loops, zero-phase filters and derivatives for recorded signals."""

from armlab.signals.offline import central_diff, decimate, filtfilt, lowpass_offline, smooth_diff
from armlab.signals.streaming import CausalDiff, Differentiator, ExpFilter, Integrator, LowPass2, Notch

__all__ = [
    "CausalDiff", "Differentiator", "ExpFilter", "Integrator", "LowPass2", "Notch", "central_diff", "decimate",
    "filtfilt", "lowpass_offline", "smooth_diff",
]  # fmt: skip
