"""Calibration of what is on and around a robot: every `fit_*` returns a `Fit` with covariance, outliers, excitation."""

from armlab.calibrate.dual_arm import fit_dual_arm
from armlab.calibrate.hand_eye import fit_hand_eye
from armlab.calibrate.hand_eye_points import fit_hand_eye_points
from armlab.calibrate.kinematics import fit_kinematics

__all__ = ["fit_dual_arm", "fit_hand_eye", "fit_hand_eye_points", "fit_kinematics"]
