# ruff: noqa: F401  other packages import the kernels from here
"""Compiled kernels for single samples and large batches.

`_native.pyi` documents the kernels; their C++ sources are in native/. The tests compare each kernel with a plain NumPy
implementation (tests/oracles).
"""

from __future__ import annotations

from armlab.errors import MissingExtra

try:
    from armlab.kernels._native import (
        Chain,
        Datagrams,
        Drive,
        EgmMessages,
        InverseSolver,
        MessageCopier,
        MomentumEstimator,
        Obstacles,
        Primitive,
        PrimitiveStepper,
        RigidBody,
        RotationStepper,
        RowEncoder,
        RowPacker,
        SignalOperator,
        TwoDof,
        WrenchEstimator,
        await_datagram,
        basis_weights,
        euler_from_rpy,
        euler_to_rpy,
        filled,
        filtered_velocity,
        follow_path,
        following_error,
        implausible,
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
        solve_wrench,
        wrench_interval,
    )
except ImportError as error:
    raise MissingExtra(
        f"Expected the compiled kernels of this armlab version, got none ({error}). Install an armlab wheel, or "
        "install a C++ compiler and run `make -B setup` or `pip install .` in the source folder."
    ) from error

__all__ = ()
