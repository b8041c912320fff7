"""Calibration of cameras, sensors and kinematics; every `fit_*` returns a `Fit` with covariance and excitation."""

from armlab.calibrate.board_images import BoardPoses, board_poses, fit_hand_eye_images
from armlab.calibrate.gravity_load.fit import fit_accelerometer, fit_force_sensor
from armlab.calibrate.hand_eye import fit_hand_eye
from armlab.calibrate.hand_eye_points import fit_hand_eye_points
from armlab.calibrate.kinematics.dual_arm import fit_dual_arm
from armlab.calibrate.kinematics.fit import fit_kinematics
from armlab.calibrate.laser_plane import fit_laser_plane

__all__ = [
    "BoardPoses", "board_poses", "fit_accelerometer", "fit_dual_arm", "fit_force_sensor", "fit_hand_eye",
    "fit_hand_eye_images", "fit_hand_eye_points", "fit_kinematics", "fit_laser_plane",
]  # fmt: skip
