"""Identification: excitation design, regressors, base parameters, rigid-body dynamics, friction, torque covariance."""

from armlab.identify.base_parameters import BaseParameters, base_parameters
from armlab.identify.consistency import Physical, physical, physical_load, pseudo_inertia
from armlab.identify.covariance import fit_velocity_covariance
from armlab.identify.dynamics import fit_dynamics
from armlab.identify.excitation import dither, excitation
from armlab.identify.expectation import Expectation, expectation
from armlab.identify.extrapolation import Extrapolation, extrapolation
from armlab.identify.friction import fit_friction
from armlab.identify.friction_run import friction_run
from armlab.identify.gravity import fit_gravity
from armlab.identify.group_lasso import GroupLasso, group_lasso, select_groups
from armlab.identify.payload import fit_payload
from armlab.identify.preparation import Prepared, prepare, with_velocity
from armlab.identify.rbf import rbf_centres, rbf_regressor
from armlab.identify.ripple import ripple_lines, ripple_regressor
from armlab.identify.trajectory import Trajectory, sequence
from armlab.identify.validation import predict
from armlab.identify.warm_up import fit_warm_up

__all__ = [
    "BaseParameters",
    "Expectation",
    "Extrapolation",
    "GroupLasso",
    "Physical",
    "Prepared",
    "Trajectory",
    "base_parameters",
    "dither",
    "excitation",
    "expectation",
    "extrapolation",
    "fit_dynamics",
    "fit_friction",
    "fit_gravity",
    "fit_payload",
    "fit_velocity_covariance",
    "fit_warm_up",
    "friction_run",
    "group_lasso",
    "physical",
    "physical_load",
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
