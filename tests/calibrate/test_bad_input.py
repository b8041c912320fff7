"""Wrong input to every calibration: errors name the mistake, and defects of the original program do not return."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab import sim
from armlab.calibrate import (
    fit_accelerometer,
    fit_dual_arm,
    fit_force_sensor,
    fit_hand_eye,
    fit_hand_eye_points,
    fit_kinematics,
    fit_laser_plane,
)
from armlab.errors import ConfigError, NotConverged, NotExcited, ShapeError, UnknownName
from armlab.estimation import Fit
from armlab.lie import quaternion, se3, so3
from armlab.sim.experiments import sensors

CELL = sim.cell(1)
CAMERA, ARM, LINE = (0.5e-3, 1e-3), (1e-4, 2e-4), (0.5e-3, 9e-3)
LEDS = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])
G = np.array([0.0, 0.0, -9.82])
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
HALF_TURN = se3.from_rp(so3.exp([0.0, 0.0, np.pi]), [0.3, 0.0, 0.2])

EYE, SEEN = CELL.hand_eye(), CELL.marker_points(N=40, missing=0.0)
WEIGHED, MOVED = CELL.force(N=60, torque=0.005), CELL.accelerometer()
TABLE, PAIR, SCANS = CELL.kinematics(), CELL.two_arms(), CELL.laser()


def millimetres(T: np.ndarray) -> np.ndarray:
    return T * np.array([[1.0, 1.0, 1.0, 1e3]] * 3 + [[1.0] * 4])


def gap(values: np.ndarray) -> np.ndarray:
    values = np.array(values)
    values[3] = np.nan
    return values


def bent(T: np.ndarray) -> np.ndarray:
    T = np.array(T)
    T[5, 0, 1] += 0.1
    return T


def left_handed(T: np.ndarray) -> np.ndarray:
    return T * np.array([1.0, -1.0, 1.0] + [1.0] * (T.shape[-1] - 3))


def turned(axis: Any, N: int = 40, angle: float = 2.0) -> np.ndarray:
    R = so3.exp(np.linspace(0.0, angle, N)[:, None] * np.asarray(axis, dtype=float))
    return se3.from_rp(R, np.random.default_rng(1).uniform(-0.5, 0.5, (N, 3)))


def mixed(values: np.ndarray) -> np.ndarray:
    return values[np.random.default_rng(0).permutation(len(values))]


def stay(values: np.ndarray, N: int = 20) -> np.ndarray:
    return np.repeat(values[:1], N, axis=0)


def eye(A=EYE.A, B=EYE.B, **more: Any) -> Fit[Any]:
    return fit_hand_eye(A, B, **more)


def points(A=SEEN.A, p=SEEN.p, marker: Any = LEDS, **more: Any) -> Fit[Any]:
    return fit_hand_eye_points(A, p, marker=marker, **more)


def force(R=WEIGHED.RA, y=WEIGHED.y, gravity: Any = G, **more: Any) -> Fit[Any]:
    return fit_force_sensor(R, y, gravity=gravity, **more)


def acc(R=MOVED.RA, y=MOVED.y, **more: Any) -> Fit[Any]:
    return fit_accelerometer(R, y, **more)


def arm(q=TABLE.q, pose: Any = TABLE.pose, **more: Any) -> Fit[Any]:
    return fit_kinematics(TABLE.robot, q, pose=pose, **more)


def dual(q_a=PAIR.q_a, q_b=PAIR.q_b, pose: Any = PAIR.pose, **more: Any) -> Fit[Any]:
    return fit_dual_arm(PAIR.robot_a, PAIR.robot_b, q_a, q_b, pose=pose, **more)


def laser(A=SCANS.A, scans: Any = SCANS.scans, plane=SCANS.plane, **more: Any) -> Fit[Any]:
    return fit_laser_plane(A, scans, plane, **more)


def weigh(T: np.ndarray) -> np.ndarray:
    u = WEIGHED.weight @ T[:, :3, :3] @ WEIGHED.R
    exact = np.hstack([u, np.cross(WEIGHED.centre, u)]) + WEIGHED.bias
    return exact + np.random.default_rng(3).standard_normal(exact.shape) * np.repeat([0.1, 0.005], 3)


def see(A: np.ndarray) -> np.ndarray:
    return se3.inv(EYE.Y) @ A @ EYE.X


def see_points(A: np.ndarray) -> np.ndarray:
    T = se3.inv(SEEN.Y) @ A @ SEEN.X
    return np.einsum("nij,kj->nki", T[:, :3, :3], LEDS) + T[:, None, :3, 3]


MM, SHARES = [1e3, 1e3, 1, 1], np.repeat([1.0, 1e3], 3)
ABOUT_X, SHORT_ARC = turned([1, 0, 0]), turned([1, 0, 0], angle=0.1)
SWAY = np.sin(np.arange(60)[:, None] * [0.10, 0.13, 0.07] + [0.0, np.pi / 2, 0.0])
SMOOTH = se3.from_rp(so3.exp(SWAY), 0.5 * SWAY)
PROFILES = [s[:2] + np.linspace(-0.1, 0.1, 5)[:, None] * s[2:] for s in SCANS.scans]
Q_STILL, ONE_JOINT = stay(TABLE.q, 30), stay(TABLE.q, 30) + np.linspace(0, 1, 30)[:, None] * np.eye(6)[2]

NEVER = np.ones((40, 3), dtype=bool) * [True, True, False] > 0

MIRRORED = [
    (lambda: eye(B=left_handed(EYE.B)), ShapeError, "T_cam_marker, got left-handed axes in rows 0, 1"),
    (lambda: eye(B=MIRROR @ EYE.B @ MIRROR), NotConverged, "have opposite handedness: one axis of the camera"),
    (lambda: points(p=left_handed(SEEN.p)), NotConverged, "axes of the camera are left-handed"),
    (lambda: force(y=WEIGHED.y * [1, -1, 1, -1, 1, -1]), NotConverged, "An axis is mirrored or the sign is reversed"),
    (lambda: acc(y=left_handed(MOVED.y)), NotConverged, "An axis is mirrored or the sign is reversed"),
    (lambda: acc(y=-MOVED.y), NotConverged, "An axis is mirrored or the sign is reversed"),
    (lambda: arm(pose=left_handed(TABLE.pose)), ShapeError, "rotations in pose, got left-handed axes in rows 0, 1"),
    (lambda: arm(pose=None, position=(MIRROR @ TABLE.pose)[:, :3, 3]), NotConverged, "a kinematic model that fits"),
]
UNEXCITED = [
    (lambda: eye(stay(EYE.A), stay(EYE.B)), NotExcited, "got no rotation"),
    (lambda: points(stay(SEEN.A), stay(SEEN.p)), NotExcited, "got no rotation"),
    (lambda: force(stay(WEIGHED.RA), stay(WEIGHED.y)), NotExcited, "gravity in tool axes is constant"),
    (lambda: arm(Q_STILL, stay(TABLE.pose, 30)), NotExcited, "joint 1 did not move; joint 2 did not"),
    (lambda: arm(ONE_JOINT, TABLE.truth.forward(ONE_JOINT)), NotExcited, "joint 2 did not move; joint 4 did not"),
    (lambda: dual(stay(PAIR.q_a), PAIR.q_b[:20], PAIR.relative(stay(PAIR.q_a), PAIR.q_b[:20])), NotExcited,
     "joint 1 of arm a did not move"),
    (lambda: dual(stay(PAIR.q_a, 60), stay(PAIR.q_b, 60), None, position=stay(PAIR.pose, 60)[:, :3, 3]), NotExcited,
     "joint 6 of arm b did not move"),
    (lambda: force(ABOUT_X, weigh(ABOUT_X), "unknown"), NotExcited, "tool axis x, weight and bias along it"),
    (lambda: acc(MOVED.RA[:2], MOVED.y[:2]), NotExcited, "at least 3 samples .*, got 2"),
    (lambda: arm(TABLE.q[:3], TABLE.pose[:3]), NotExcited, "at least 31 values .*, got 18"),
    (lambda: dual(PAIR.q_a[:2], PAIR.q_b[:2], PAIR.pose[:2]), NotExcited, "at least 3 samples .*, got 2"),
    (lambda: laser(SCANS.A[:2], SCANS.scans[:2], SCANS.plane[:2]), NotExcited, "13 values and two scans"),
    (lambda: dual(visible=np.arange(60) < 2), NotExcited, "at least 3 samples"),
    (lambda: dual(visible=np.arange(60) < 8, noise=ARM), NotExcited, r"at least 54 values .* got 48"),
    (lambda: points(visible=NEVER), NotExcited, "points 2 are never visible"),
    (lambda: points(marker=LEDS[[0, 0, 0]] + LEDS[1] * [[1], [2], [3]]), NotExcited, "non-collinear"),
    (lambda: force(stay(WEIGHED.RA), stay(WEIGHED.y), "unknown"), NotExcited, "the tool orientation does not"),
    (lambda: force(WEIGHED.RA[:4], WEIGHED.y[:4], "unknown"), NotExcited, "at least 5 samples .*, got 4"),
    (lambda: force(SHORT_ARC, weigh(SHORT_ARC)), NotExcited, "tool axis .*, bias and centre of mass along it"),
]  # fmt: skip
UNITS = [
    (lambda: eye(B=millimetres(EYE.B)), NotConverged, r"scaled by 0\.001; perhaps millimetres"),
    (lambda: eye(A=millimetres(EYE.A)), NotConverged, r"scaled by 1e\+03; perhaps millimetres"),
    (lambda: points(p=1e3 * SEEN.p), NotConverged, r"points would fit if scaled by 0\.001; perhaps millimetres"),
    (lambda: points(A=millimetres(SEEN.A)), NotConverged, r"points would fit if scaled by 1e\+03; perhaps millimetres"),
    (lambda: points(marker=1e3 * LEDS), NotConverged, r"marker would fit if scaled by 0\.001; perhaps millimetres"),
    (lambda: points(millimetres(SEEN.A), 1e3 * SEEN.p), NotConverged, r"marker would fit if scaled by 1e\+03"),
    (lambda: force(y=WEIGHED.y * SHARES), NotConverged, "Torques seem to be in N mm"),
    (lambda: force(y=WEIGHED.y[:, :3], mass=1e3), NotConverged, "readings are .* times as large as expected"),
    (lambda: acc(y=MOVED.y / 9.80665), NotConverged, r"readings are 0\.102 times as large"),
    (lambda: acc(y=1e3 * MOVED.y, robust=True), NotConverged, r"readings are 1e\+03 times as large"),
    (lambda: arm(pose=millimetres(TABLE.pose)), ShapeError, "seem to be in millimetres"),
    (lambda: arm(np.rad2deg(TABLE.q)), ShapeError, "seem to be in degrees"),
    (lambda: arm(pose=None, position=1e3 * TABLE.pose[:, :3, 3]), ShapeError, "seem to be in millimetres"),
    (lambda: arm(pose=None, position=1e-3 * TABLE.pose[:, :3, 3]), ShapeError, "robot description, .* in millimetres"),
    (lambda: dual(np.rad2deg(PAIR.q_a)), ShapeError, "got values up to .* in q_a. The values seem to be in degrees"),
    (lambda: laser(scans=SCANS.scans * MM), NotConverged, r"scans would fit .* scaled by 0\.00\d+; perhaps milli"),
    (lambda: laser(A=millimetres(SCANS.A)), NotConverged, "would fit with lengths scaled .* perhaps millimetres"),
]
PAIRING = [
    (lambda: eye(EYE.A[1:], EYE.B[:-1]), "shifted by 1 sample relative"),
    (lambda: eye(SMOOTH[2:], see(SMOOTH)[:-2]), "shifted by 2 samples"),
    (lambda: eye(EYE.A[:-2], EYE.B[2:], robust=True), "shifted by 2 samples"),
    (lambda: eye(B=EYE.B[::-1]), "reverse order"),
    (lambda: eye(A=se3.inv(EYE.A), robust=True), "the other setup applies"),
    (lambda: eye(B=se3.inv(EYE.B), noise=CAMERA), "contains inverse poses"),
    (lambda: eye(EYE.A[:5], mixed(EYE.B[:5])), "sample i was taken at the same time in both records"),
    (lambda: eye(B=mixed(EYE.B)), "sample i was taken at the same time in both records"),
    (lambda: eye(B=mixed(EYE.B), noise=CAMERA, robust=True), "sample i was taken at the same time in both records"),
    (lambda: points(SEEN.A[:-3], SEEN.p[3:], None), "shifted by 3 samples"),
    (lambda: points(p=SEEN.p[::-1], noise=5e-4), "reverse order"),
    (lambda: points(A=se3.inv(SEEN.A)), "the other setup applies"),
    (lambda: points(p=mixed(SEEN.p), marker=None), "sample i was taken at the same time in both records"),
    (lambda: points(SMOOTH[1:], see_points(SMOOTH)[:-1]), "shifted by 1 sample relative"),
    (lambda: points(marker=LEDS[[1, 2, 0]]), "Check the order of the points"),
    (lambda: force(WEIGHED.RA[1:], WEIGHED.y[:-1]), "Check that sample i was taken at the same time in both"),
    (lambda: force(WEIGHED.RA[1:], WEIGHED.y[:-1, :3], noise=0.1), "readings that follow gravity"),
    (lambda: force(WEIGHED.RA[1:], WEIGHED.y[:-1], "unknown"), "sample i was taken at the same time in both records"),
    (lambda: force(WEIGHED.RA[1:], WEIGHED.y[:-1, :3], noise=0.1, robust=True), "of 59 samples were excluded"),
    (lambda: acc(MOVED.RA[1:], MOVED.y[:-1]), "sample i was taken at the same time in both records"),
    (lambda: arm(TABLE.q[1:], TABLE.pose[:-1]), "the pairing of samples and joint positions"),
    (lambda: arm(TABLE.q[1:], TABLE.pose[:-1], noise=ARM, robust=True), "outliers among 49"),
    (lambda: arm(TABLE.q[:, ::-1], noise=ARM), "the joint order"),
]
BROKEN = [
    (lambda: eye(A=gap(EYE.A)), "T_base_tool, got NaN or Inf in 1 rows: 3"),
    (lambda: points(p=gap(SEEN.p)), "NaN or Inf in 1 rows: 3"),
    (lambda: force(y=gap(WEIGHED.y)), "wrench, got NaN or Inf in 1 rows: 3"),
    (lambda: acc(y=gap(MOVED.y)), "acc, got NaN or Inf in 1 rows: 3"),
    (lambda: arm(q=gap(TABLE.q)), "q, got NaN or Inf in 1 rows: 3"),
    (lambda: arm(pose=gap(TABLE.pose)), "pose, got NaN or Inf in 1 rows: 3.*visible"),
    (lambda: dual(q_a=gap(PAIR.q_a)), "q_a, got NaN or Inf in 1 rows: 3"),
    (lambda: laser(A=gap(SCANS.A)), "T_base_tool, got NaN or Inf in 1 rows: 3"),
    (lambda: laser(scans=gap(SCANS.scans)), "scans, got NaN or Inf in 1 rows: 3"),
    (lambda: eye(A=bent(EYE.A)), "rotations in T_base_tool, got matrices that deviate by up to .* in rows 5"),
    (lambda: arm(pose=bent(TABLE.pose)), "rotations in pose, got matrices that deviate by up to .* in rows 5"),
    (lambda: laser(start=np.diag([1.0, 1.0, -1.0, 1.0])), "rotations in start, got left-handed axes"),
    (lambda: eye(A=EYE.A[1:]), "equal numbers of robot and marker poses, got 29 and 30"),
    (lambda: eye(A=EYE.A[0]), r"T_base_tool of shape \(N, 4, 4\), got \(4, 4\)"),
    (lambda: eye(A="robot"), "T_base_tool to be real numbers"),
    (lambda: eye(B=1.01 * EYE.B), "last row of every pose in T_cam_marker"),
    (lambda: eye(B=np.swapaxes(EYE.B, 1, 2)), "transposed"),
    (lambda: eye(noise=0.001), "one number in metres and one in radians"),
    (lambda: eye(noise=(0.0, 0.001)), "noise above zero"),
    (lambda: eye(noise=(np.nan, 0.001)), "one number in metres"),
    (lambda: eye(noise=-np.eye(6)), "positive semidefinite"),
    (lambda: eye(noise_robot=0.001), "noise_robot of poses as"),
    (lambda: points(A=SEEN.A[1:]), "equal numbers of robot poses and point samples, got 39 and 40"),
    (lambda: points(p=SEEN.p[:, :, :2]), r"p_cam of shape \(N, K, 3\)"),
    (lambda: points(marker=LEDS[:2]), r"marker to be \(3, 3\)"),
    (lambda: points(visible=np.ones((40, 3))), "visible to be booleans"),
    (lambda: points(noise=(0.001, 0.001)), "noise of points as one standard deviation"),
    (lambda: points(noise=0.0), "above zero"),
    (lambda: points(noise=-np.eye(3)), "positive semidefinite"),
    (lambda: points(limits=(0.2, 0.0)), "two positive numbers"),
    (lambda: force(y=WEIGHED.y[1:]), r"shape \(60, 3\) or \(60, 6\)"),
    (lambda: force(R=WEIGHED.RA[0]), r"of shape \(N, 4, 4\) or \(N, 3, 3\)"),
    (lambda: force(sign=2), r"as \+1 or -1"),
    (lambda: force(gravity=(0, 0, 0)), "not all zero"),
    (lambda: force(gravity="up"), "gravity to be real numbers"),
    (lambda: force(mass=-1.0), "a mass > 0 kg"),
    (lambda: force(mass=1.0, gravity="unknown"), "together with known gravity"),
    (lambda: force(noise=0.1), "sd of force"),
    (lambda: force(y=WEIGHED.y[:, :3], noise=-0.1), "one positive standard deviation"),
    (lambda: force(limits=(0.2, 0.3)), "limits as three positive numbers"),
    (lambda: acc(y=MOVED.y[:, :2]), r"readings of shape \(50, 3\)"),
    (lambda: arm(TABLE.q[:, :5]), r"q of shape \(N, 6\)"),
    (lambda: arm(pose=TABLE.pose[:-1]), r"pose of shape \(50, 4, 4\)"),
    (lambda: arm(pose=TABLE.pose.swapaxes(1, 2)), "transposed"),
    (lambda: arm(noise=1e-4), "noise of pose"),
    (lambda: arm(noise=(0.0, 1.0)), "noise of pose"),
    (lambda: arm(noise=(np.inf, np.inf)), "noise of pose"),
    (lambda: arm(noise=-np.eye(6)), "noise of pose"),
    (lambda: arm(visible=np.ones(3, dtype=bool)), "visible"),
    (lambda: arm(free=np.ones((6, 6)) > 0), r"free as Booleans of shape \(7, 6\)"),
    (lambda: arm(joint_terms=np.ones((50, 6))), r"joint_terms of shape \(50, 6, L\)"),
    (lambda: arm(pose=None, pair_distance=([1], [1], [0.2])), "distinct sample indices"),
    (lambda: dual(q_b=np.zeros((59, 6))), "equal numbers of rows of q_a"),
    (lambda: dual(q_b=np.full((60, 6), np.nan)), "finite q_b, got NaN or Inf in 60 rows: 0"),
    (lambda: laser(SCANS.A[:59], plane=SCANS.plane[:59]), "Expected 59 scans"),
    (lambda: laser(scans=SCANS.scans[:, :3]), r"lines of shape \(60, 4\)"),
    (lambda: laser(plane=SCANS.plane[:5]), "one label per scan"),
    (lambda: laser(plane=SCANS.plane * 0.5), "integers or strings"),
    (lambda: laser(scans=SCANS.scans * [1, 1, 2, 2]), "unit directions"),
    (lambda: laser(scans=[*PROFILES[:59], PROFILES[59] * np.nan]), "NaN or Inf in 1 rows: 59"),
    (lambda: laser(scans=[*PROFILES[:59], PROFILES[59][:1]]), "profiles with at least two points"),
    (lambda: laser(scans=[*PROFILES[:59], np.eye(2)[[0, 1, 0]] * [[1], [1], [-1]]]), "not straight lines in rows 59"),
    (lambda: laser(noise=5e-4), "sd of line angles"),
    (lambda: laser(scans=PROFILES, noise=LINE), "one sd of raw points"),
    (lambda: laser(limits=(0.2,)), "limits as two positive numbers"),
]
CHOICES = [
    (lambda: arm(pose=None), ConfigError, "at least one of pose, position"),
    (lambda: arm(pose=None, distance=np.ones(50)), ConfigError, "initial guess of the fixed point"),
    (lambda: arm(position=TABLE.pose[:, :3, 3], noise=ARM), ConfigError, "separate noise for each kind"),
    (lambda: arm(harmonics=(1, 1)), ConfigError, "harmonics"),
    (lambda: arm(weak="prior", prior=0.0), ConfigError, "prior"),
    (lambda: arm(model="poe", free="offsets"), ConfigError, "free='all' with model='poe'"),
    (lambda: arm(model="dh"), UnknownName, "Known: local_poe, poe"),
    (lambda: arm(weak="ignore"), UnknownName, "Known: prior, refuse"),
    (lambda: arm(free="tool"), UnknownName, "Known: all, base_tool, offsets"),
    (lambda: arm(visible={"position": np.ones(50) > 0}), UnknownName, "position"),
    (lambda: dual(pose=None), ConfigError, "either the pose or the position"),
    (lambda: dual(pose=None, position=PAIR.pose[:, :3, 3], closed=True), ConfigError, "no position for a closed"),
    (lambda: dual(noise=ARM, absolute_a=PAIR.pose), ConfigError, "noise and noise_absolute together"),
]
REPORTED = [
    (lambda: eye(A=EYE.A.round(6)), "rotations in T_base_tool deviated by up to"),
    (lambda: arm(pose=TABLE.pose.round(6)), "50 rotations in pose deviated by up to"),
    (lambda: eye(EYE.A[:8], EYE.B[:8], noise=(0.02, 0.3), limits=(9.0, 9.0)), "first-order"),
    (lambda: force(y=WEIGHED.y * np.repeat([1.0, 50.0], 3), limits=(0.2, 0.3, 99.0)), "are torques in N mm"),
    (lambda: force(WEIGHED.RA[:5], WEIGHED.y[:5, :3], robust=True), "weakest: rotation about tool axis"),
    (lambda: force(R=WEIGHED.RA * (1.0 + 1e-6)), "60 rotations in T_base_tool deviated by up to"),
    (lambda: eye(millimetres(EYE.A), millimetres(EYE.B)), "were millimetres given as metres?"),
    (lambda: points(millimetres(SEEN.A), 1e3 * SEEN.p, None), "were millimetres given as metres?"),
    (lambda: force(y=1e3 * WEIGHED.y), "are forces in a unit other than N?"),
    (lambda: force(gravity=[0.0, 0.0, -1.0]), "is it given in units of g?"),
    (lambda: force(y=-WEIGHED.y, gravity="unknown"), "mirrored axis with reversed weight would fit equally"),
    (lambda: force(ABOUT_X, weigh(ABOUT_X)[:, :3]), "handedness and sign of the sensor are undecided"),
    (lambda: acc(y=MOVED.y / 9.80665, scale=True), "are readings or gravity in a unit other than m/s^2?"),
    (lambda: arm(pose=MIRROR @ TABLE.pose @ MIRROR), "from its description: possible causes are a reversed joint"),
    (lambda: laser(millimetres(SCANS.A), SCANS.scans * MM), "m: were millimetres given as metres?"),
]
REFUSED = [*CHOICES, *MIRRORED, *UNEXCITED, *UNITS, *((case, NotConverged, words) for case, words in PAIRING)]
REFUSED += [(case, ShapeError, words) for case, words in BROKEN]


@pytest.mark.parametrize(("case", "error", "words"), REFUSED, ids=[words[:50] for *_, words in REFUSED])
def test_is_refused_by_name(case: Callable[[], Fit[Any]], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words) as caught:
        case()
    assert str(caught.value).startswith("Expected ")
    assert str(caught.value).endswith((".", "?"))  # "Did you mean ...?"


@pytest.mark.parametrize(("case", "words"), REPORTED, ids=[words[:40] for _, words in REPORTED])
def test_is_named_in_the_report(case: Callable[[], Fit[Any]], words: str) -> None:
    assert words in case().report()


def test_good_data_are_not_suspected() -> None:
    for fit in (eye(), points(), points(marker=None), force(), acc(), acc(scale=True), arm(), dual(), laser()):
        assert "?" not in fit.report()
        assert "undecided" not in fit.report()


@pytest.mark.slow  # 15 s: all alternatives are tried before an error is raised
@pytest.mark.parametrize(("case", "words"), [
    (lambda: dual(PAIR.q_a[1:26], PAIR.q_b[1:26], PAIR.pose[:25]), "the pairing of samples and joint positions"),
    (lambda: dual(PAIR.q_a[1:], PAIR.q_b[:-1], PAIR.pose[1:], noise=ARM, robust=True), "outliers among 59"),
    (lambda: dual(PAIR.q_a[:25], PAIR.q_b[:25], MIRROR @ PAIR.pose[:25] @ MIRROR), "a kinematic model that fits the"),
    (lambda: laser(SCANS.A[1:], SCANS.scans[:-1], SCANS.plane[:-1]), "Check the plate labels"),
], ids=["shifted poses", "shifted arm", "mirrored", "shifted scans"])  # fmt: skip
def test_records_of_two_arms_and_of_scans_that_do_not_belong_together(case: Callable[[], Any], words: str) -> None:
    with pytest.raises(NotConverged, match=words):
        case()


class TestHalfATurn:
    def test_of_a_scanner(self) -> None:
        right = laser(noise=LINE)
        for start in (SCANS.X @ HALF_TURN, SCANS.X @ se3.exp([0, 0, 0, np.pi, 0, 0])):
            found = laser(start=start, noise=LINE)
            np.testing.assert_allclose(found.value.T_tool_sensor, right.value.T_tool_sensor, atol=1e-6)

    def test_a_scanner_with_a_reversed_axis_is_one_that_is_turned(self) -> None:
        right, other = laser(), laser(scans=SCANS.scans * [-1, 1, -1, 1])
        seen = other.value.points(np.array([[-0.02, 0.1]]), SCANS.A[0])
        np.testing.assert_allclose(seen, right.value.points(np.array([[0.02, 0.1]]), SCANS.A[0]), atol=1e-6)

    def test_of_the_base_and_the_tool_of_an_arm(self) -> None:
        measured = [{"pose": HALF_TURN @ TABLE.pose}, {"pose": TABLE.pose @ HALF_TURN}]
        for given in (*measured, {"position": (HALF_TURN @ TABLE.pose)[:, :3, 3]}):
            found = fit_kinematics(TABLE.robot, TABLE.q, **given)
            assert found.sigma[0] < 1.2e-4
            assert "?" not in found.report()

    def test_of_a_joint(self) -> None:
        with pytest.raises(NotConverged, match="a kinematic model that fits"):
            arm(TABLE.q + np.pi * np.eye(6)[2], noise=ARM)
        reversed_ = arm(TABLE.q * [1, 1, -1, 1, 1, 1], None, position=TABLE.pose[:, :3, 3])
        assert "link 2 deviates by" in reversed_.report()

    def test_of_an_anchor(self) -> None:
        run = CELL.distances()
        anchor, distance = run.anchor, run.distance
        found = fit_kinematics(run.robot, run.q, distance=distance, anchor=anchor * [-1, -1, 1], noise=5e-5)
        assert "from its description" in found.report()
        with pytest.raises(ShapeError, match="initial guess of a fixed point, seems to be in millimetres"):
            fit_kinematics(run.robot, run.q, distance=distance, anchor=1e3 * anchor)
        with pytest.raises(ShapeError, match="length_offset=True"):
            fit_kinematics(run.robot, run.q, distance=-distance, anchor=anchor)


def shaken(T: np.ndarray, size: tuple[float, float] = (2e-4, 5e-4)) -> np.ndarray:
    """Return poses (N, 4, 4) or orientations (N, 3, 3) with robot noise."""
    rng = np.random.default_rng(7)
    turns = so3.exp(size[1] * rng.standard_normal((len(T), 3)))
    if T.shape[-1] == 3:
        return T @ turns
    return se3.from_rp(T[:, :3, :3] @ turns, T[:, :3, 3] + size[0] * rng.standard_normal((len(T), 3)))


def test_what_must_be_refused_by_name_from_noisy_poses() -> None:
    one_way = se3.from_rp(shaken(stay(SCANS.A[:, :3, :3], 60)), SCANS.A[:, :3, 3])
    vertical, short = turned([0, 0, 1]), turned([1, 0, 0], angle=np.radians(3.0))
    with pytest.raises(NotExcited, match=r"rotation about tool axis|rotations about the ve"):
        force(shaken(vertical), weigh(vertical))
    with pytest.raises(NotExcited, match=r"rotation about tool axis .*, bias and centre of"):
        force(shaken(short), weigh(short))
    with pytest.raises(NotExcited, match="translation of the sensor along tool axis"):
        laser(one_way, noise=LINE)


def test_small_tilts_cost_degrees_not_half_turns() -> None:
    """calib_force was off by 58 to 178 degrees at tilts below 30 degrees; the bound is 0.544 degrees."""
    squares = []
    for run in range(25):
        data = sensors.weighed([3000, run], tilt=np.radians(30.0))
        fit = fit_force_sensor(**data.given, noise=0.1)
        squares.append(so3.angle(fit.value.R_tool_sensor, data.R) ** 2)
    assert np.degrees(np.sqrt(np.max(squares))) < 3.0
    assert np.degrees(np.sqrt(np.mean(squares))) < 0.544 * 1.3


@pytest.mark.parametrize("half", [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])])
def test_sensors_turned_by_half_a_turn_are_like_others(half) -> None:
    """calib_force2 was singular at these orientations."""
    data = sensors.weighed(1, 20, 0.0)
    fit = fit_force_sensor(data.RA, 0.7 * G @ data.RA @ half + [1.0, 2.0, 3.0], gravity=G)
    np.testing.assert_allclose(fit.value.R_tool_sensor, half, atol=1e-12)
    np.testing.assert_allclose(fit.value.bias[:3], [1.0, 2.0, 3.0], atol=1e-11)


def test_a_line_is_used_where_it_was_measured() -> None:
    """calibNAXP took a second point 1 m along each line, where the angle noise has a hundred times the effect."""
    data = sensors.scanned(4)
    turned = data.exact.copy()  # lines rotated about their points, as by angle noise alone
    turn = 8.66e-3 * np.random.default_rng(0).standard_normal(60)
    turned[:, 2] = np.cos(turn) * data.exact[:, 2] - np.sin(turn) * data.exact[:, 3]
    turned[:, 3] = np.sin(turn) * data.exact[:, 2] + np.cos(turn) * data.exact[:, 3]
    fit = fit_laser_plane(data.A, turned, data.plane, noise=(1e-6, 8.66e-3))
    assert np.abs(fit.residuals[:, 0]).max() < 1e-5  # the points stay where they are
    np.testing.assert_allclose(fit.value.T_tool_sensor, data.X, atol=0.01)


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
    A = EYE.A if setup == "eye_to_hand" else se3.inv(EYE.A)
    for who, (a, b) in {
        "T_base_tool": (wrong(A), EYE.B),
        "T_cam_marker": (A, wrong(EYE.B)),
        "T_base_tool and T_cam_marker": (wrong(A), wrong(EYE.B)),
    }.items():
        with pytest.raises(NotConverged, match=f"of {who} are.*{text.removeprefix('are ')}") as caught:
            fit_hand_eye(a, b, setup=setup)
        assert caught.value.reason == "mismatch"
    fit_hand_eye(A, EYE.B, setup=setup)


def test_quaternions_of_both_records_in_another_order_leave_rotations_that_fit() -> None:
    """Only the positions reveal the wrong order, here by a tenth of their spread; fits were once silently 0.4 m off."""
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
    """Transposed tilts of 30 degrees look nearly like tilts rotated by half a turn about the vertical."""
    for tilt in (None, np.deg2rad(30.0)):
        weighed = sim.cell(2).force(tilt=tilt)
        T = se3.from_rp(weighed.RA, np.zeros((len(weighed.RA), 3)))
        with pytest.raises(NotConverged, match=f"T_base_tool are.*{text.removeprefix('are ')}"):
            fit_force_sensor(WRONG[text](T), weighed.y, gravity=G)
        fit_force_sensor(T, weighed.y, gravity=G)


def test_residuals_that_no_sensor_has_are_doubted_in_the_report() -> None:
    B, p = EYE.B.copy(), SEEN.p.copy()
    B[:10] = B[:10] @ se3.exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.5])
    p[:12] += [0.2, 0.0, 0.0]
    for report in (eye(B=B).report(), points(p=p, marker=None).report()):
        assert "are some samples wrong?" in report
    assert eye(B=B, robust=True).outliers.tolist() == [True] * 10 + [False] * 20
