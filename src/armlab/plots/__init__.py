"""Figures. Each function returns Axes or a Figure without showing or saving it. Matplotlib is imported on first use."""

from __future__ import annotations

from armlab.plots.arm import manipulability, robot, workspace
from armlab.plots.calibration_quality import calibration
from armlab.plots.contact import coverage, hypotheses, observability, wrench, wrenches
from armlab.plots.drives import friction, friction_map, spectrum
from armlab.plots.model import autocorrelation, excitation, residual_speed, torque_fit, velocity_covariance
from armlab.plots.motion import dmp, dmp_phase, periodic_dmp, pose_dmp, promp, two_dof
from armlab.plots.recording import latency, poses, table
from armlab.plots.space import scene

__all__ = [
    "hypotheses",
    "autocorrelation",
    "calibration",
    "coverage",
    "dmp",
    "dmp_phase",
    "excitation",
    "friction",
    "friction_map",
    "latency",
    "manipulability",
    "observability",
    "periodic_dmp",
    "pose_dmp",
    "poses",
    "promp",
    "residual_speed",
    "robot",
    "scene",
    "spectrum",
    "table",
    "torque_fit",
    "two_dof",
    "velocity_covariance",
    "workspace",
    "wrench",
    "wrenches",
]
