"""Identification: excitation design, regressors, base parameters, rigid-body dynamics, friction, torque covariance."""

from armlab.identify.consistency import PhysicallyConsistent, physically_consistent, physically_consistent_load
from armlab.identify.drives.friction import fit_friction, rbf_centres, rbf_regressor
from armlab.identify.drives.ripple import ripple_lines
from armlab.identify.drives.warm_up import fit_warm_up
from armlab.identify.dynamics import fit_dynamics, fit_gravity
from armlab.identify.excite import (
    PredictedUncertainty,
    Trajectory,
    design_excitation,
    dither,
    friction_run,
    predicted_uncertainty,
    sequence,
)
from armlab.identify.payload import fit_payload
from armlab.identify.prediction import Extrapolation, extrapolation, predict
from armlab.identify.record import prepare, with_velocity
from armlab.identify.validation import fit_velocity_covariance

__all__ = [
    "Extrapolation",
    "PhysicallyConsistent",
    "PredictedUncertainty",
    "Trajectory",
    "design_excitation",
    "dither",
    "extrapolation",
    "fit_dynamics",
    "fit_friction",
    "fit_gravity",
    "fit_payload",
    "fit_velocity_covariance",
    "fit_warm_up",
    "friction_run",
    "physically_consistent",
    "physically_consistent_load",
    "predict",
    "predicted_uncertainty",
    "prepare",
    "rbf_centres",
    "rbf_regressor",
    "ripple_lines",
    "sequence",
    "with_velocity",
]
