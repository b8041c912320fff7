"""Signals: zero-phase offline filters and derivatives with true time stamps."""

from armlab.signals.offline import central_diff, lowpass_offline

__all__ = ["central_diff", "lowpass_offline"]
