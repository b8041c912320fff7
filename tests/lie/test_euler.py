"""Roll, pitch, yaw: the conventions' own numbers, SciPy, gimbal lock, refusals."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from armlab.errors import ShapeError, UnknownName
from armlab.lie import euler, quaternion, so3

LOCKED = {"zyx": (-np.pi / 2, np.pi / 2), "xyz": (-np.pi / 2, np.pi / 2), "zyz": (0.0, np.pi)}


def random_rotations(count: int) -> np.ndarray:
    q = np.random.default_rng(0).standard_normal((count, 4))
    return quaternion.to_matrix(q / np.linalg.norm(q, axis=1, keepdims=True))


@pytest.mark.parametrize(
    ("convention", "expected"),
    [
        ("zyx", (0.983347443256, 0.143572175027, 0.106020511062, 0.034270798550)),
        ("xyz", (0.981856172866, 0.064071347706, 0.091157549343, 0.153439302024)),
        ("zyz", (0.975170327202, 0.009966711079, 0.099334665398, 0.197676811654)),
    ],
)
def test_reference_quaternions(convention, expected: tuple[float, ...]) -> None:
    """(0.1, 0.2, 0.3) in the conventions of ABB, Nikon and zyz."""
    np.testing.assert_allclose(
        quaternion.from_matrix(euler.from_rpy((0.1, 0.2, 0.3), convention)), expected, rtol=0, atol=1e-12
    )


def test_conventions_as_products() -> None:
    r, p, y = 0.1, 0.2, 0.3
    np.testing.assert_allclose(euler.from_rpy((r, p, y), "zyx"), euler.rot_z(r) @ euler.rot_y(p) @ euler.rot_x(y))
    np.testing.assert_allclose(euler.from_rpy((r, p, y), "xyz"), euler.rot_x(r) @ euler.rot_y(p) @ euler.rot_z(y))
    np.testing.assert_allclose(euler.from_rpy((r, p, y), "zyz"), euler.rot_z(r) @ euler.rot_y(p) @ euler.rot_z(y))
    assert get_args(euler.Convention) == euler.CONVENTIONS


def test_turns_about_one_axis() -> None:
    angles = np.linspace(-4, 4, 9)
    for turn, axis in ((euler.rot_x, (1, 0, 0)), (euler.rot_y, (0, 1, 0)), (euler.rot_z, (0, 0, 1))):
        np.testing.assert_allclose(turn(angles), so3.exp(angles[:, None] * np.array(axis)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(euler.rot_z(np.pi / 2) @ [1, 0, 0], [0, 1, 0], rtol=0, atol=1e-16)
    assert euler.rot_x(np.zeros((2, 3))).shape == (2, 3, 3, 3)


@pytest.mark.parametrize("convention", euler.CONVENTIONS)
@pytest.mark.parametrize("off", [0.0, 1e-16, 1e-13, -1e-12, 1e-9, 1e-6])
def test_to_rpy_at_and_near_gimbal_lock(convention, off: float) -> None:
    rng = np.random.default_rng(2)
    for lock in LOCKED[convention]:
        angles = rng.uniform(-np.pi, np.pi, (1000, 3))
        angles[:, 1] = lock + off
        R = euler.from_rpy(angles, convention)
        np.testing.assert_allclose(euler.from_rpy(euler.to_rpy(R, convention), convention), R, rtol=0, atol=1e-12)


def test_gimbal_lock_gives_the_last_angle_everything() -> None:
    for convention, lock, total in (("zyx", np.pi / 2, 0.2), ("xyz", np.pi / 2, 0.4), ("zyz", 0.0, 0.4)):
        angles = euler.to_rpy(euler.from_rpy((0.1, lock, 0.3), convention), convention)
        np.testing.assert_allclose(angles, (0, lock, total), rtol=0, atol=1e-15)


def test_an_unknown_convention_is_refused() -> None:
    with pytest.raises(UnknownName, match=r"Expected the name of a rotation convention, got 'zxz'\."):
        euler.to_rpy(np.eye(3), "zxz")  # type: ignore[arg-type]
    with pytest.raises(UnknownName, match="rotation convention"):
        euler.from_rpy((0, 0, 0), "")  # type: ignore[arg-type]
    with pytest.raises(UnknownName, match="xyz, zyx, zyz"):
        euler.from_rpy((0, 0, 0), [0, 1, 2])  # type: ignore[arg-type]


def test_the_convention_has_no_default() -> None:
    """The ancestor had one for each direction, and they were not the same."""
    with pytest.raises(TypeError, match="convention"):
        euler.from_rpy((0.1, 0.2, 0.3))  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="convention"):
        euler.to_rpy(np.eye(3))  # type: ignore[call-arg]


def test_bad_input_is_a_sentence() -> None:
    with pytest.raises(ShapeError, match="Expected rpy of shape"):
        euler.from_rpy((0, 0), "zyx")
    with pytest.raises(ShapeError, match="Expected R to be a rotation"):
        euler.to_rpy(2 * np.eye(3), "zyx")


def test_missing_stays_missing() -> None:
    R = euler.from_rpy([(0.1, 0.2, 0.3), (0.1, np.nan, 0.3)], "zyx")
    angles = euler.to_rpy(R, "zyx")
    np.testing.assert_allclose(angles[0], (0.1, 0.2, 0.3), rtol=0, atol=1e-15)
    assert np.isnan(angles[1]).any()
