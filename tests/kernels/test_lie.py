"""Lie groups: broadcasting, large rotations and refusals; values are covered by tables (tests/numerics) and laws."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armlab import kernels
from armlab.errors import ShapeError

FUNCTIONS = {  # name and options: kinds of the arguments
    "so3_exp": ("w",),
    "so3_log": ("R",),
    "so3_angle": ("R", "R2"),
    "so3_left_jacobian": ("w",),
    "so3_left_jacobian_inv": ("w",),
    "se3_exp": ("xi",),
    "se3_log": ("T",),
    "se3_inv": ("T",),
    "se3_adjoint": ("T",),
    "se3_left_jacobian": ("xi",),
    "se3_left_jacobian_inv": ("xi",),
    "so3_interpolate": ("R", "R2", "s"),
    "se3_interpolate": ("T", "T2", "s"),
    "se3_interpolate screw": ("T", "T2", "s"),
    "se3_transform_wrench": ("T", "xi"),
    "euler_from_rpy zyx": ("w",),
    "euler_from_rpy zyz": ("w",),
    "euler_to_rpy zyx": ("R",),
    "euler_to_rpy xyz": ("R",),
    "euler_to_rpy zyz": ("R",),
    "quaternion_from_matrix": ("R",),
    "quaternion_to_matrix": ("q",),
    "quaternion_multiply": ("q", "q2"),
    "quaternion_slerp": ("q", "q2", "s"),
}
BROADCAST = [name for name, kinds in FUNCTIONS.items() if len(kinds) > 1]
TAILS = {"R": 2, "R2": 2, "T": 2, "T2": 2, "s": 0, "q": 1, "q2": 1, "xi": 1}


def rotations(w: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(*w.shape, 3)


def inputs(batch: tuple[int, ...], turns: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((*batch, 3))
    w = turns[..., None] * u / np.linalg.norm(u, axis=-1, keepdims=True)
    xi = np.concatenate([rng.standard_normal((*batch, 3)), w], axis=-1)
    R, R2 = (rotations(v) for v in (w, rng.standard_normal((*batch, 3))))
    q, q2 = (kernels.quaternion_from_matrix(M) for M in (R, R2))
    T, T2 = np.zeros((2, *batch, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, xi[..., :3], 1.0
    T2[..., :3, :3], T2[..., :3, 3], T2[..., 3, 3] = R2, w, 1.0
    return {"w": w, "xi": xi, "R": R, "R2": R2, "T": T, "T2": T2, "q": q, "q2": -q2, "s": turns / 3}


def function(module: Any, name: str) -> Callable[..., np.ndarray]:
    """The function for a name in `FUNCTIONS`."""
    name, _, chosen = name.partition(" ")
    if chosen == "screw":
        return partial(getattr(module, name), screw=True)
    if chosen:
        first, middle, last = ("xyz".index(letter) for letter in chosen)
        return partial(getattr(module, name), first=first, middle=middle, last=last)
    return getattr(module, name)


@pytest.fixture
def batch() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    return inputs((2, 35), rng.uniform(0, np.pi, (2, 35)) * rng.integers(0, 2, (2, 35)), 2)


@pytest.mark.parametrize("name", BROADCAST)
def test_leading_axes_broadcast(batch: dict[str, np.ndarray], name: str) -> None:
    call, arguments = function(kernels, name), [batch[kind] for kind in FUNCTIONS[name]]
    arguments[0] = arguments[0][:, :1]
    arguments[1] = arguments[1][0]
    tails = [TAILS[kind] for kind in FUNCTIONS[name]]
    full = [np.broadcast_to(a, (2, 35, *a.shape[a.ndim - t :])) for a, t in zip(arguments, tails)]
    np.testing.assert_array_equal(call(*arguments), call(*full))
    if len(arguments) == 3:
        arguments[2], full[2] = arguments[2][0], arguments[2]
    arguments[0], full[0] = arguments[0][0, 0], np.broadcast_to(full[0][0, 0], full[0].shape)
    np.testing.assert_array_equal(call(*arguments), call(*[array[0] for array in full]))


def test_rotations_and_poses_are_returned_as_they_are(batch: dict[str, np.ndarray]) -> None:
    assert kernels.rotations(batch["R"], "R") is batch["R"]
    assert kernels.poses(batch["T"], "T") is batch["T"]
    assert kernels.rotations(np.eye(3, dtype=int).tolist(), "R").dtype == np.float64


def matrices(*changes: tuple[tuple[int, ...], float]) -> np.ndarray:
    return poses(*changes)[..., :3, :3]


def poses(*changes: tuple[tuple[int, ...], float]) -> np.ndarray:
    T = np.tile(np.eye(4), (5, 3, 1, 1))
    for index, value in changes:
        T[index] = value
    return T


EYES = np.tile(np.eye(3), (3, 1, 1))
NO_ROTATION = "Expected R{} to be a rotation within 1e-05, got {}. Project it first"
NOT_UNIT = "Expected {} of length 1 within 0.001 (wxyz), got length {}."
LAST_ROW = "Expected (0, 0, 0, 1) as the last row of T{}, got an error of {}."
REFUSED = [
    ("rotations", (np.zeros((2, 3)), "R_x"), "Expected R_x of shape (..., 3, 3), got (2, 3)."),
    ("rotations", ("north", "R"), "Expected R to be an array of real numbers, got str"),
    ("rotations", (1j * np.eye(3), "R"), "Expected R to be an array of real numbers, got "),
    ("rotations", (2 * np.eye(3), "R"), NO_ROTATION.format("", "max|R^T R - I| = 3")),
    ("rotations", (-np.eye(3), "R"), NO_ROTATION.format("", "determinant = -1")),
    ("rotations", (matrices(((3, 1, 0, 0), np.inf)), "R"), NO_ROTATION.format("[3, 1]", "max|R| = inf")),
    (
        "rotations",
        (matrices(((1, 1, 0, 1), np.nan), ((4, 2, 0, 1), 1.1e-5)), "R"),
        NO_ROTATION.format("[4, 2]", "max|R^T R - I| = 1.1e-05"),
    ),
    ("poses", (poses(((4, 0, 1, 1), 1.1)), "T"), "Expected the rotation of T[4, 0] to be a rotation within"),
    ("poses", (poses(((2, 2, 3, 1), 0.5)), "T"), LAST_ROW.format("[2, 2]", "0.5")),
    ("poses", (poses(((2, 1, 3, 3), np.nan)), "T"), LAST_ROW.format("[2, 1]", "nan")),
    ("se3_log", (np.eye(3),), "Expected T of shape (..., 4, 4), got (3, 3)."),
    ("se3_adjoint", (2 * np.eye(4),), "Expected the rotation of T_a_b to be a rotation"),
    ("se3_exp", (np.zeros(3),), "Expected xi of shape (..., 6), got (3,)."),
    ("so3_exp", (1.0,), "Expected w of shape (..., 3), got ()."),
    ("so3_angle", (np.eye(3), np.zeros((3, 3))), "Expected R_b to be a rotation"),
    (
        "so3_angle",
        (EYES, EYES[:2]),
        "Expected leading axes that broadcast, got R_a of shape (3, 3, 3), R_b of shape (2, 3, 3).",
    ),
    ("quaternion_to_matrix", ([[1, 0, 0, 0], [1, 0.1, 0, 0]],), NOT_UNIT.format("quaternion[1]", "1.00499")),
    ("quaternion_slerp", ([1, 0, 0, 0], [3, 0, 0, 0], 0.5), NOT_UNIT.format("b", "3")),
    ("quaternion_multiply", (np.zeros((2, 4)), np.zeros((3, 4))), "Expected leading axes that broadcast, got p of"),
]


@pytest.mark.parametrize(("name", "arguments", "sentence"), REFUSED)
def test_refusals(name: str, arguments: tuple[Any, ...], sentence: str) -> None:
    with pytest.raises(ShapeError, match="^.*" + re.escape(sentence)):
        getattr(kernels, name)(*arguments)


def test_a_missing_number_passes_and_hides_nothing_else() -> None:
    T = poses(((1, 1, 0, 1), np.nan), ((1, 1, 3, 1), np.nan), ((0, 2, 0, 3), np.nan))
    assert np.isnan(kernels.se3_inv(T)[1, 1]).any()
    assert np.isfinite(kernels.se3_inv(T)[2:]).all()


def test_far_turns_have_values() -> None:
    """Where squares over- or underflow, lengths come from the C library; ``J w = w`` and ``J hat(w) = exp(w) - I``."""
    w = np.array([[1e200, 0, 0], [3e-170, 4e-170, 0], [0, 0, -1e8], [0.1, 0.2, 0.3]])
    R, J = kernels.so3_exp(w), kernels.so3_left_jacobian(w)
    assert np.isfinite([R, J]).all()
    np.testing.assert_allclose(R[1:], rotations(w[1:]), rtol=0, atol=1e-8)
    np.testing.assert_allclose((J @ w[..., None])[1:, :, 0], w[1:], rtol=1e-12, atol=1e-8)
    hats = np.cross(w[:, None], np.eye(3)).swapaxes(1, 2)
    np.testing.assert_allclose((J @ hats)[1:], R[1:] - np.eye(3), rtol=0, atol=1e-8)
    assert np.isnan(kernels.so3_exp([np.inf, 0, 0])).any()
