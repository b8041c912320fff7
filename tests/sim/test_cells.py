"""The cell with known ground truth: its random draws and their order, and fits that recover the truth."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import calibrate, sim
from armlab.errors import ConfigError
from armlab.lie import se3, so3
from armlab.sim.experiments.cell import CalibrationCell, cell


def distance(T_a: np.ndarray, T_b: np.ndarray) -> tuple[float, float]:
    return float(np.linalg.norm((T_a - T_b)[:3, 3])), float(so3.angle(T_a[:3, :3], T_b[:3, :3]))


def test_a_cell_is_its_seed() -> None:
    assert sim.cell(3) == CalibrationCell(3)
    one, same, other = (cell(seed).hand_eye(2) for seed in (7, 7, 8))
    np.testing.assert_array_equal(one.B, same.B)
    assert np.abs(one.B - other.B).max() > 0.1
    with pytest.raises(ConfigError, match="seed of at least 0, got -1"):
        cell(-1)


def test_hand_eye_draws_in_the_order_of_the_specification() -> None:
    rng = np.random.default_rng([1000, 4])

    def rotations(count: int) -> np.ndarray:
        w, x, y, z = (q := rng.standard_normal((count, 4))).T / np.linalg.norm(q, axis=1)
        rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
        rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
        rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
        return np.stack(rows, axis=1).reshape(count, 3, 3)

    X = se3.from_rp(rotations(1)[0], 0.1 * rng.standard_normal(3))
    Y = se3.from_rp(rotations(1)[0], rng.standard_normal(3))
    A = se3.from_rp(rotations(30), rng.uniform(-0.5, 0.5, (30, 3)))
    exact = se3.inv(Y) @ A @ X
    R = exact[:, :3, :3] @ so3.exp(np.radians(0.05) * rng.standard_normal((30, 3)))
    B = se3.from_rp(R, exact[:, :3, 3] + 0.5e-3 * rng.standard_normal((30, 3)))
    drawn = cell(1000).hand_eye(4)
    for found, wanted in ((drawn.X, X), (drawn.Y, Y), (drawn.A, A), (drawn.B_exact, exact), (drawn.B, B)):
        np.testing.assert_allclose(found, wanted, atol=1e-14)


def test_the_fits_find_the_truth_of_every_experiment() -> None:
    made = cell(11)
    seen = made.hand_eye(wrong=3)
    eye = calibrate.fit_hand_eye(**seen.given, robust=True)
    assert np.flatnonzero(eye.outliers).tolist() == [0, 1, 2]
    assert distance(eye.value.Y, seen.Y) < (2e-3, np.radians(0.1))
    leds = made.marker_points()
    points = calibrate.fit_hand_eye_points(**leds.given, visible=leds.visible)
    assert distance(points.value.Y, leds.Y) < (1e-3, np.radians(0.1))
    weighed = made.force(torque=0.005, contacts=5)
    sensor = calibrate.fit_force_sensor(**weighed.given, robust=True)
    assert np.flatnonzero(sensor.outliers)[:5].tolist() == [0, 1, 2, 3, 4]
    assert so3.angle(sensor.value.R_tool_sensor, weighed.R) < np.radians(0.5)
    np.testing.assert_allclose(sensor.value.centre, weighed.centre, atol=1e-3)
    rest = made.accelerometer()
    acc = calibrate.fit_accelerometer(rest.RA, rest.y)
    assert so3.angle(acc.value.R_tool_sensor, rest.R) < np.radians(0.2)
    scans = made.laser(wrong=3)
    laser = calibrate.fit_laser_plane(**scans.given, robust=True)
    assert laser.outliers[:3].all()
    assert distance(laser.value.T_tool_sensor, scans.X) < (2e-3, np.radians(0.6))


def test_arms_are_near_their_table_and_not_on_it() -> None:
    made = cell(5)
    for drawn in (made.kinematics(), made.kinematics(truth="dh"), made.distances()):
        off = np.abs(drawn.pose[:, :3, 3] - drawn.truth.forward(drawn.q)[:, :3, 3]).max()
        assert off < 1e-3
        assert 1e-3 < np.abs(drawn.truth.forward(drawn.q) - _nominal(drawn)).max() < 3e-2
    dual = made.two_arms()
    np.testing.assert_allclose(dual.pose, dual.relative(dual.q_a, dual.q_b), atol=2e-3)


def test_the_fits_find_the_truth_of_arms() -> None:
    made = cell(5)
    arm = made.kinematics(wrong=3)
    one = calibrate.fit_kinematics(**arm.given, noise=arm.noise, robust=True)
    assert np.flatnonzero(one.outliers)[:3].tolist() == [0, 1, 2]
    assert arm.error(one.value.forward(arm.q_valid))[0] < 0.2
    for T_a, T_b in zip(made.kinematics().pose[:3], arm.pose[:3]):
        np.testing.assert_allclose(distance(T_a, T_b), (0.02, np.radians(2.0)), rtol=1e-9)
    seen = made.distances()
    far = calibrate.fit_kinematics(**seen.given, noise=seen.noise_distance)
    np.testing.assert_allclose(np.linalg.norm(far.value.anchor - seen.guess), 0.0, atol=0.05)
    dual = made.two_arms(wrong=3)
    two = calibrate.fit_dual_arm(**dual.given, noise=dual.noise, robust=True)
    assert np.flatnonzero(two.outliers)[:3].tolist() == [0, 1, 2]
    Z = two.value.forward(dual.q_valid_a, dual.q_valid_b)
    np.testing.assert_allclose(Z, dual.relative(dual.q_valid_a, dual.q_valid_b), atol=1e-3)


def _nominal(drawn) -> np.ndarray:
    from armlab.kinematics import forward

    return forward(drawn.robot, drawn.q)


def test_the_clock_jitters_and_runs_forwards() -> None:
    t = cell(2).clock(N=500, period=0.1, jitter=1e-3)
    e = t - 0.1 * np.arange(500)
    assert 0.9e-3 < e.std() < 1.1e-3
    assert np.all(np.diff(cell(2).clock(N=500, period=0.01, jitter=0.1)) > 0)


def test_a_camera_with_a_clock_of_its_own_sees_an_arm_that_moves(tmp_path) -> None:
    """Joints interpolated to the image times leave only camera noise; assuming regular image times leaves more."""
    from armlab import log
    from armlab.kinematics import forward

    moving = cell(1).moving_hand_eye()
    files = [log.write(table, tmp_path / f"{name}.mcap", moving.robot)
             for name, table in (("arm", moving.arm), ("camera", moving.camera))]  # fmt: skip
    arm, camera = log.read(files[0]).select("q"), log.read(files[1]).select("T_cam_marker")
    seen = camera.join(arm, fill="linear", max_age=0.02)
    fit = calibrate.fit_hand_eye(forward(moving.robot, seen["q"]), seen["T_cam_marker"])
    assert fit.sigma == pytest.approx([0.5e-3, np.radians(0.05)], rel=0.2)
    np.testing.assert_allclose(fit.value.T_base_cam, moving.T_base_cam, atol=2e-3)
    regular = moving.arm.between(0.1, 7.0).rows(np.arange(25, 1525, 25))["q"]
    wrong = calibrate.fit_hand_eye(forward(moving.robot, regular), seen["T_cam_marker"])
    assert np.all(wrong.sigma > 3.0 * fit.sigma)
