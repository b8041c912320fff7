"""Identification: excitation design, regressors, base parameters, rigid-body dynamics, friction, torque covariance."""

from armlab.identify.base_parameters import BaseParameters, base_parameters
from armlab.identify.consistency import (
    PhysicallyConsistent,
    physically_consistent,
    physically_consistent_load,
    pseudo_inertia,
)
from armlab.identify.drives.friction import fit_friction, rbf_centres, rbf_regressor
from armlab.identify.drives.regularised import GroupLasso, group_lasso, select_groups
from armlab.identify.drives.ripple import ripple_lines, ripple_regressor
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
from armlab.identify.record import Record, prepare, with_velocity
from armlab.identify.residuals import fit_velocity_covariance
from armlab.identify.validation import Extrapolation, extrapolation, predict

__all__ = [
    "BaseParameters",
    "PredictedUncertainty",
    "Extrapolation",
    "GroupLasso",
    "PhysicallyConsistent",
    "Record",
    "Trajectory",
    "base_parameters",
    "dither",
    "design_excitation",
    "predicted_uncertainty",
    "extrapolation",
    "fit_dynamics",
    "fit_friction",
    "fit_gravity",
    "fit_payload",
    "fit_velocity_covariance",
    "fit_warm_up",
    "friction_run",
    "group_lasso",
    "physically_consistent",
    "physically_consistent_load",
    "predict",
    "prepare",
    "pseudo_inertia",
    "rbf_centres",
    "rbf_regressor",
    "ripple_lines",
    "ripple_regressor",
    "select_groups",
    "sequence",
    "with_velocity",
]
