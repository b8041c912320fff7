"""Figures. Each function returns its Axes or Figure; nothing is shown or saved. matplotlib loads on first use."""

from __future__ import annotations

from armlab.plots.arms import robot
from armlab.plots.beliefs import hypotheses
from armlab.plots.calibrations import calibration
from armlab.plots.columns import table
from armlab.plots.covariances import velocity_covariance
from armlab.plots.coverages import coverage, observability
from armlab.plots.distributions import promp
from armlab.plots.drives import friction_map, spectrum
from armlab.plots.ellipsoids import manipulability
from armlab.plots.excitations import excitation
from armlab.plots.frictions import friction
from armlab.plots.latencies import latency
from armlab.plots.pictures import png, show
from armlab.plots.pose_primitives import pose_dmp
from armlab.plots.primitives import dmp, dmp_phase
from armlab.plots.recoveries import two_dof
from armlab.plots.residuals import autocorrelation, residual_speed
from armlab.plots.rhythms import periodic_dmp
from armlab.plots.scenes import scene
from armlab.plots.torques import torque_fit
from armlab.plots.trajectories import poses
from armlab.plots.workspaces import workspace
from armlab.plots.wrenches import wrench, wrenches

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
    "png",
    "pose_dmp",
    "poses",
    "promp",
    "residual_speed",
    "robot",
    "scene",
    "show",
    "spectrum",
    "table",
    "torque_fit",
    "two_dof",
    "velocity_covariance",
    "workspace",
    "wrench",
    "wrenches",
]
