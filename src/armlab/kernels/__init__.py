"""The compiled core: kernels that run per sample or per million samples.

`backend` says which implementation is in use: "native", the C++ extension, or "reference", the same mathematics in
NumPy. The environment variable ``ARMLAB_KERNELS`` chooses one; without it the extension is used when it is there.
Both offer the same names, and a contract test holds one to the other.
"""

from __future__ import annotations

import os
import warnings
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

from armlab.errors import ConfigError

if TYPE_CHECKING:
    from armlab.kernels._reference import (
        Chain,
        Datagrams,
        Drive,
        EgmReader,
        EgmWriter,
        InverseSolver,
        JsonText,
        MessageCopier,
        MomentumEstimator,
        Obstacles,
        Primitive,
        PrimitiveStepper,
        RecordMaker,
        RotationStepper,
        RowEncoder,
        RowMessages,
        RowPacker,
        SignalOperator,
        TwoDof,
        WrenchEstimator,
        basis_weights,
        euler_from_rpy,
        euler_to_rpy,
        follow_path,
        hand_eye_rows,
        limit_reference,
        model_torque,
        momentum_step,
        poses,
        presliding,
        quaternion_from_matrix,
        quaternion_multiply,
        quaternion_slerp,
        quaternion_to_matrix,
        rotation_rollout,
        rotations,
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
        so3_nearest,
        solve_wrench,
        turned_weight,
        wrench_interval,
    )

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
    "backend",
    "basis_weights",
    "euler_from_rpy",
    "euler_to_rpy",
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


_BUILD = "`make -B setup` or `pip install .` in the sources"


def _fall_back(reason: str) -> tuple[str, ModuleType]:
    warnings.warn(
        f"armlab runs its NumPy reference kernels, ten to a thousand times slower: {reason}.",
        RuntimeWarning,
        stacklevel=3,
    )
    return "reference", import_module("armlab.kernels._reference")


def _choose() -> tuple[str, ModuleType]:
    wanted = os.environ.get("ARMLAB_KERNELS", "")
    if wanted not in ("", "native", "reference"):
        raise ConfigError(f"Expected ARMLAB_KERNELS to be native or reference, got {wanted!r}. Correct it or unset it.")
    if wanted == "reference":
        return _fall_back("ARMLAB_KERNELS=reference asks for them")
    try:
        native = import_module("armlab.kernels._native")
    except ImportError as error:
        fault = f"the extension cannot be imported ({error}); with a C++ compiler build it, {_BUILD}"
    else:
        if not set(__all__) - {"backend"} - vars(native).keys():
            return "native", native
        fault = f"the extension is older than the sources; build it again, {_BUILD}"
    if wanted == "native":
        raise ConfigError(f"Expected the compiled kernels, as ARMLAB_KERNELS=native asks, got none: {fault}.")
    return _fall_back(fault)


backend, _module = _choose()
globals().update({name: getattr(_module, name) for name in __all__ if name != "backend"})
