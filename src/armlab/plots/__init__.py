"""Figures. Each function returns its Axes or Figure; nothing is shown or saved. matplotlib loads on first use."""

from __future__ import annotations

from armlab.plots.columns import table
from armlab.plots.covariances import velocity_covariance
from armlab.plots.latencies import latency
from armlab.plots.torques import torque_fit
from armlab.plots.wrenches import wrench

__all__ = ["latency", "table", "torque_fit", "velocity_covariance", "wrench"]
