"""Orientations in another convention: misread poses are refused by the name of the reading."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from armlab import sim
from armlab.calibrate import fit_force_sensor, fit_hand_eye, fit_hand_eye_points
from armlab.errors import NotConverged
from armlab.lie import quaternion, se3, so3

G = np.array([0.0, 0.0, -9.82])


def rolled(T: np.ndarray, by: int) -> np.ndarray:
    R = quaternion.to_matrix(np.roll(quaternion.from_matrix(T[:, :3, :3]), by, axis=1))
    return se3.from_rp(R, T[:, :3, 3])


def transposed(T: np.ndarray) -> np.ndarray:
    return se3.from_rp(np.ascontiguousarray(T[:, :3, :3].transpose(0, 2, 1)), T[:, :3, 3])


WRONG: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "x, y, z, w but were read": lambda T: rolled(T, -1),
    "w, x, y, z but were read": lambda T: rolled(T, 1),
    "are transposed": transposed,
}


@pytest.mark.parametrize("text", WRONG)
@pytest.mark.parametrize("setup", ["eye_to_hand", "eye_in_hand"])
def test_records_of_poses_in_another_reading_are_refused_by_name(text: str, setup: str) -> None:
    wrong = WRONG[text]
    seen = sim.cell(1).hand_eye()
    A = seen.A if setup == "eye_to_hand" else se3.inv(seen.A)
    for who, (a, b) in {
        "T_base_tool": (wrong(A), seen.B),
        "T_cam_marker": (A, wrong(seen.B)),
        "T_base_tool and T_cam_marker": (wrong(A), wrong(seen.B)),
    }.items():
        with pytest.raises(NotConverged, match=f"of {who} are.*{text.removeprefix('are ')}") as caught:
            fit_hand_eye(a, b, setup=setup)
        assert caught.value.reason == "mismatch"
    fit_hand_eye(A, seen.B, setup=setup)


def test_quaternions_of_both_records_in_another_order_leave_rotations_that_fit() -> None:
    """Positions alone tell, here with a tenth of the spread between them: once fitted in silence, 0.4 m off."""
    rng = np.random.default_rng(39)
    X, Y = se3.exp(0.1 * rng.standard_normal(6)), se3.exp(rng.standard_normal(6))
    A = se3.from_rp(so3.exp(rng.standard_normal((30, 3))), rng.uniform(-0.5, 0.5, (30, 3)))
    B = se3.inv(Y) @ A @ X @ se3.exp(5e-4 * rng.standard_normal((30, 6)))
    with pytest.raises(NotConverged, match=r"T_base_tool and T_cam_marker are x, y, z, w.* 0\.0\d+ rad|0\.0\d+ rad.*"):
        fit_hand_eye(rolled(A, -1), rolled(B, -1))


@pytest.mark.parametrize(("text", "setup"), [*zip(WRONG, ("eye_to_hand", "eye_in_hand", "eye_in_hand"))])
def test_points_with_poses_in_another_reading_are_refused_by_name(text: str, setup: str) -> None:
    seen = sim.cell(3).marker_points(N=40, missing=0.0)
    A = seen.A if setup == "eye_to_hand" else se3.inv(seen.A)
    with pytest.raises(NotConverged, match=f"T_base_tool are.*{text.removeprefix('are ')}"):
        fit_hand_eye_points(WRONG[text](A), seen.p, setup=setup)


@pytest.mark.parametrize("text", WRONG)
def test_forces_with_orientations_in_another_reading_are_refused_by_name(text: str) -> None:
    """Tilts of 30 degrees look nearly the same transposed: half a turn about the vertical."""
    for tilt in (None, np.deg2rad(30.0)):
        weighed = sim.cell(2).force(tilt=tilt)
        T = se3.from_rp(weighed.RA, np.zeros((len(weighed.RA), 3)))
        with pytest.raises(NotConverged, match=f"T_base_tool are.*{text.removeprefix('are ')}"):
            fit_force_sensor(WRONG[text](T), weighed.y, gravity=G)
        fit_force_sensor(T, weighed.y, gravity=G)


def test_residuals_that_no_sensor_has_are_doubted_in_the_report() -> None:
    seen = sim.cell(1).hand_eye()
    assert "are some samples" not in fit_hand_eye(seen.A, seen.B).report()
    B = seen.B.copy()
    B[:10] = B[:10] @ se3.exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.5])
    assert "are some samples wrong?" in fit_hand_eye(seen.A, B).report()
    assert fit_hand_eye(seen.A, B, robust=True).outliers.tolist() == [True] * 10 + [False] * 20
    sights = sim.cell(1).marker_points(N=40, missing=0.0)
    p = sights.p.copy()
    assert "are some samples" not in fit_hand_eye_points(sights.A, p).report()
    p[:12] += [0.2, 0.0, 0.0]
    assert "are some samples wrong?" in fit_hand_eye_points(sights.A, p).report()
