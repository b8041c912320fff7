"""The kernels in plain NumPy: the specification that the compiled ones are held to.

Every name here exists in `armlab.kernels._native` with the same signature and the same results to 1e-12.
"""

from __future__ import annotations

from armlab.kernels._reference.chain import Chain
from armlab.kernels._reference.datagrams import Datagrams
from armlab.kernels._reference.drive import Drive, basis_weights, model_torque, presliding
from armlab.kernels._reference.egm import EgmReader, EgmWriter
from armlab.kernels._reference.estimator import WrenchEstimator
from armlab.kernels._reference.euler import euler_from_rpy, euler_to_rpy
from armlab.kernels._reference.hand_eye import hand_eye_rows
from armlab.kernels._reference.inverse import InverseSolver
from armlab.kernels._reference.json_text import JsonText
from armlab.kernels._reference.lie import (
    quaternion_from_matrix,
    quaternion_multiply,
    quaternion_slerp,
    quaternion_to_matrix,
    se3_adjoint,
    se3_exp,
    se3_interpolate,
    se3_inv,
    se3_left_jacobian,
    se3_left_jacobian_inv,
    se3_log,
    se3_transform_wrench,
    so3_angle,
    so3_exp,
    so3_interpolate,
    so3_left_jacobian,
    so3_left_jacobian_inv,
    so3_log,
)
from armlab.kernels._reference.lie_arguments import poses, rotations
from armlab.kernels._reference.limits import limit_reference
from armlab.kernels._reference.messages import MessageCopier
from armlab.kernels._reference.momentum import momentum_step
from armlab.kernels._reference.momentum_estimator import MomentumEstimator
from armlab.kernels._reference.nearest import so3_nearest
from armlab.kernels._reference.obstacles import Obstacles
from armlab.kernels._reference.path import follow_path
from armlab.kernels._reference.primitive import Primitive
from armlab.kernels._reference.primitive_stepper import PrimitiveStepper
from armlab.kernels._reference.records import RecordMaker
from armlab.kernels._reference.rotation_primitive import RotationStepper, rotation_rollout
from armlab.kernels._reference.row_encoder import RowEncoder
from armlab.kernels._reference.row_messages import RowMessages
from armlab.kernels._reference.row_packer import RowPacker
from armlab.kernels._reference.signals import SignalOperator
from armlab.kernels._reference.two_dof import TwoDof
from armlab.kernels._reference.weight import turned_weight
from armlab.kernels._reference.wrench import solve_wrench, wrench_interval

__all__ = [
    "Chain",
    "Datagrams",
    "Drive",
    "EgmReader",
    "EgmWriter",
    "InverseSolver",
    "JsonText",
    "MessageCopier",
    "MomentumEstimator",
    "Obstacles",
    "Primitive",
    "PrimitiveStepper",
    "RecordMaker",
    "RotationStepper",
    "RowEncoder",
    "RowMessages",
    "RowPacker",
    "SignalOperator",
    "TwoDof",
    "WrenchEstimator",
    "euler_from_rpy",
    "euler_to_rpy",
    "basis_weights",
    "follow_path",
    "hand_eye_rows",
    "limit_reference",
    "model_torque",
    "momentum_step",
    "poses",
    "presliding",
    "quaternion_from_matrix",
    "quaternion_multiply",
    "quaternion_slerp",
    "quaternion_to_matrix",
    "rotation_rollout",
    "rotations",
    "se3_adjoint",
    "se3_exp",
    "se3_interpolate",
    "se3_inv",
    "se3_left_jacobian",
    "se3_left_jacobian_inv",
    "se3_log",
    "se3_transform_wrench",
    "so3_angle",
    "so3_exp",
    "so3_interpolate",
    "so3_left_jacobian",
    "so3_left_jacobian_inv",
    "so3_log",
    "so3_nearest",
    "solve_wrench",
    "turned_weight",
    "wrench_interval",
]
