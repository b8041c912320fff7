"""Calibration of what is on and around a robot: every `fit_*` returns a `Fit` with covariance, outliers, excitation."""

from armlab.calibrate.accelerometer import fit_accelerometer
from armlab.calibrate.dual_arm import fit_dual_arm
from armlab.calibrate.force_sensor import fit_force_sensor
from armlab.calibrate.hand_eye import fit_hand_eye
from armlab.calibrate.hand_eye_points import fit_hand_eye_points
from armlab.calibrate.kinematics import fit_kinematics
from armlab.calibrate.laser_plane import fit_laser_plane

__all__ = [
    "fit_accelerometer",
    "fit_dual_arm",
    "fit_force_sensor",
    "fit_hand_eye",
    "fit_hand_eye_points",
    "fit_kinematics",
    "fit_laser_plane",
]
