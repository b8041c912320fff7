"""Synthetic ground truth, and how the moving arm differs from it."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from armlab import robots
from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.robots import inertia
from armlab.sim.arm.arm import SimulatedArm
from armlab.sim.arm.mismatch import Mismatch, built_robot, built_truth, draw, position_gain, torque_gain
from armlab.sim.arm.truth import Truth, cylinder, no_masses, synthetic_truth

ROBOT = robots.load("yumi_left")
TRUTH = synthetic_truth(ROBOT)
T = 0.004032
GRAVITY = np.array([0.0, 0.0, -9.81])
G_LEFT = [6.20953, 5.37511, -0.02260, 0.53069, -0.00042, -0.02481, 0.0]
G_RIGHT = [-6.20953, 5.37511, 0.02260, 0.53069, 0.00042, -0.02481, 0.0]


@pytest.mark.parametrize(("name", "expected"), [("yumi_left", G_LEFT), ("yumi_right", G_RIGHT)])
def test_gravity_at_home_is_golden(name: str, expected: list[float]) -> None:
    robot = robots.load(name)
    zero = np.zeros(7)
    G = robot.chain.rnea(robot.q_home, zero, zero, GRAVITY, synthetic_truth(robot).pi)
    np.testing.assert_allclose(G, expected, atol=6e-6)


def test_yumi_parameters_follow_the_rule() -> None:
    np.testing.assert_array_equal(TRUTH.tau_max, [40, 40, 25, 25, 10, 10, 5])
    np.testing.assert_array_equal(TRUTH.pi[:, 0], [1.7, 1.6, 1.4, 1.1, 0.9, 0.5, 0.2])
    np.testing.assert_allclose(TRUTH.coulomb_pos, 0.0525 * TRUTH.tau_max)
    np.testing.assert_allclose(TRUTH.coulomb_neg, 0.0475 * TRUTH.tau_max)
    np.testing.assert_allclose(TRUTH.viscous * np.radians([180] * 4 + [400] * 3), 0.05 * TRUTH.tau_max)
    np.testing.assert_allclose(TRUTH.offset, 0.01 * TRUTH.tau_max * [1, -1, 1, -1, 1, -1, 1])
    np.testing.assert_allclose(TRUTH.ripple_cycles, [200, 200, 200, 200, 200, 202, 200])
    np.testing.assert_allclose(TRUTH.rotor, 0.1)
    np.testing.assert_allclose(TRUTH.static_ratio, 1.3)


@pytest.mark.parametrize("name", [name for name in robots.names() if not no_masses(robots.load(name))])
def test_every_simulated_robot_is_physical(name: str) -> None:
    robot = robots.load(name)
    truth = synthetic_truth(robot)
    for m, x, y, z, *rest in truth.pi:
        centre = np.array([x, y, z]) / m
        inertia = np.array([[rest[0], rest[1], rest[3]], [rest[1], rest[2], rest[4]], [rest[3], rest[4], rest[5]]])
        inertia -= m * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        moments = np.linalg.eigvalsh(inertia)
        assert moments[0] > 0
        assert moments[2] <= moments[0] + moments[1] + 1e-12
    zero = np.zeros(robot.n)
    G = robot.chain.rnea(robot.q_home, zero, zero, robot.gravity, truth.pi)
    assert (np.abs(G) < 0.5 * truth.tau_max).all(), "the drives can hold the arm"


def test_masses_are_those_of_the_description_and_drives_in_proportion_to_its_efforts() -> None:
    robot = robots.load("panda")
    truth = synthetic_truth(robot)
    np.testing.assert_array_equal(truth.pi, robot.inertias)
    np.testing.assert_array_equal(truth.tau_max, robot.tau_max)
    np.testing.assert_allclose(truth.coulomb_pos + truth.coulomb_neg, 0.1 * robot.tau_max)
    np.testing.assert_allclose(truth.ripple_cycles, 200.0)


def test_what_a_file_says_of_drives_takes_the_place_of_the_proportions(tmp_path: Path) -> None:
    drives = {"friction": [3.0, 0, 0, 0, 0, 0, 1.0], "damping": [2.0] * 7, "rotor": [0.5] * 7, "noise": [0.1] * 7}
    pairs = tuple((name, tuple(values)) for name, values in drives.items())
    robot = replace(robots.load("panda"), drives=pairs)
    robots.save(robot, tmp_path / "arm.toml")
    assert robots.load(tmp_path / "arm.toml") == robot
    truth = synthetic_truth(robots.load(tmp_path / "arm.toml"))
    np.testing.assert_allclose(truth.coulomb_pos / 1.05, [3.0, *(0.05 * robot.tau_max[1:6]), 1.0])
    np.testing.assert_array_equal([truth.viscous[0], truth.rotor[3], truth.tau_noise[6]], [2.0, 0.5, 0.1])
    assert robot.hash == robots.load("panda").hash
    for wrong, words in (
        (("gain", (1.0,) * 7), "among friction"),
        (("noise", (1.0,)), "7 finite, non-negative numbers"),
    ):
        with pytest.raises(RobotError, match=words):
            replace(robot, drives=(wrong,))


def test_without_efforts_the_drives_can_hold_the_stretched_arm() -> None:
    rng = np.random.default_rng(0)
    for name in ("panda", "ur5e"):
        robot = replace(robots.load(name), tau_max=np.full(robots.load(name).n, np.inf))
        truth, zero = synthetic_truth(robot), np.zeros(robot.n)
        for q in rng.uniform(robot.q_min, robot.q_max, (50, robot.n)):
            assert np.all(np.abs(robot.chain.rnea(q, zero, zero, robot.gravity, truth.pi)) < 0.5 * truth.tau_max)
        assert truth.tau_max.max() < 30 * truth.tau_max.min()


def test_an_arm_of_another_shape_does_not_get_masses_by_its_name() -> None:
    assert "no masses" in no_masses(robots.from_dh("yumi_left", np.zeros(3), np.ones(3), np.zeros(3)))


def test_cylinder_is_the_textbook_one() -> None:
    pi = cylinder(2.0, np.array([0.0, 0.0, 0.5]), 0.1, 0.06)
    across = 2.0 * (3 * 0.01 + 0.25) / 12 + 2.0 * 0.25**2
    np.testing.assert_allclose(pi, [2, 0, 0, 0.5, across, 0, across, 0, 0, 0.01], atol=1e-15)
    point = cylinder(2.0, np.zeros(3), 0.1, 0.3)
    np.testing.assert_allclose(point[[4, 6, 9]], [2 * (0.03 + 0.09) / 12] * 2 + [0.01])


def test_effects_can_be_switched_off() -> None:
    silent = TRUTH.without("noise", "ripple")
    assert not silent.tau_noise.any()
    assert not silent.q_step.any()
    assert not silent.ripple.any()
    assert TRUTH.tau_noise.all()
    assert silent.viscous.all()
    with pytest.raises(UnknownName, match="ripple"):
        TRUTH.without("rippel")


def test_payload_adds_a_point_mass() -> None:
    loaded = TRUTH.with_payload(0.5, np.array([0, 0, 0.1]))
    np.testing.assert_allclose(loaded.pi[-1] - TRUTH.pi[-1], [0.5, 0, 0, 0.05, 0.005, 0, 0.005, 0, 0, 0], atol=1e-15)
    np.testing.assert_array_equal(loaded.pi[:-1], TRUTH.pi[:-1])


def test_shapes_are_checked() -> None:
    fields = {name: getattr(TRUTH, name) for name in Truth.__dataclass_fields__}
    with pytest.raises(ShapeError, match="viscous"):
        Truth(**fields | {"viscous": np.ones(3)})
    with pytest.raises(ValueError, match="read-only"):
        TRUTH.pi[0, 0] = 1.0


MOVED = {
    "base_turn": 0.02,
    "link_length": 0.002,
    "joint_zero": np.deg2rad(0.1),
    "mass": 0.1,
    "centre": 0.01,
    "payload": 0.5,
    "friction": 0.3,
    "saturation": 0.9,
    "warm_up": 0.4,
    "load_friction": 0.5,
    "ripple_jump": 1.0,
    "offset_drift": 0.01,
}
REPORTED = {
    "elasticity": 1e-3,
    "torque_delay": 2,
    "torque_constant": 0.1,
    "gear_ratio": 0.05,
    "gear_sign": 2,
    "quantisation": 9.0,
}


def sway(arm: SimulatedArm, seconds: float = 0.5) -> np.ndarray:
    """Return data of a short sway (4, K, n): the exact torque, then the reported q, qd and tau."""
    rows = []
    for k in range(1, round(seconds / T)):
        w = 2 * np.pi * 0.5
        q = ROBOT.q_home + 0.15 * (1 - np.cos(w * k * T))
        arm.step(q, np.full(7, 0.15 * w * np.sin(w * k * T)), None)
        measured = arm.measure()
        rows.append((arm.sample.tau, measured.q, measured.qd, measured.tau))
    return np.array(rows).transpose(1, 0, 2)


@pytest.fixture(scope="module")
def plain() -> np.ndarray:
    return sway(SimulatedArm(ROBOT, TRUTH, seed=3))


def test_nothing_turned_nothing_changed(plain: np.ndarray) -> None:
    np.testing.assert_array_equal(sway(SimulatedArm(ROBOT, TRUTH, seed=3, mismatch=Mismatch(seed=5))), plain)
    assert built_robot(Mismatch(), ROBOT) is ROBOT
    assert built_truth(Mismatch(), TRUTH, ROBOT) is TRUTH


@pytest.mark.parametrize("knob", MOVED)
def test_the_arm_needs_another_torque(knob: str, plain: np.ndarray) -> None:
    found = sway(SimulatedArm(ROBOT, TRUTH, seed=3, mismatch=Mismatch(**{knob: MOVED[knob]})))
    assert np.abs(found[0] - plain[0]).max() > 1e-5


@pytest.mark.parametrize("knob", REPORTED)
def test_the_arm_moves_as_before_and_reports_otherwise(knob: str, plain: np.ndarray) -> None:
    found = sway(SimulatedArm(ROBOT, TRUTH, seed=3, mismatch=Mismatch(**{knob: REPORTED[knob]})))
    np.testing.assert_array_equal(found[0], plain[0])
    assert not np.array_equal(found[1:], plain[1:])


def test_every_knob_is_tested() -> None:
    assert {field.name for field in fields(Mismatch)} == {*MOVED, *REPORTED, "base_shift", "jitter", "lost", "seed"}


def test_draws_are_seeded_and_independent_of_each_other() -> None:
    one = Mismatch(torque_constant=0.05, seed=1)
    np.testing.assert_array_equal(draw(one, "torque_constant", 7), draw(one, "torque_constant", 7))
    np.testing.assert_array_equal(
        draw(replace(one, mass=0.1, friction=0.1), "torque_constant", 7), draw(one, "torque_constant", 7)
    )
    assert not np.array_equal(torque_gain(replace(one, seed=2), 7), torque_gain(one, 7))
    many = np.concatenate([torque_gain(Mismatch(torque_constant=0.05, seed=s), 7) for s in range(200)])
    assert 0.95 <= many.min() < 0.951
    assert 1.049 < many.max() <= 1.05
    assert many.mean() == pytest.approx(1.0, abs=0.004)


def test_torque_constants_scale_what_is_measured(plain: np.ndarray) -> None:
    mismatch = Mismatch(torque_constant=0.1, seed=4)
    found = sway(SimulatedArm(ROBOT, TRUTH, seed=3, mismatch=mismatch))
    np.testing.assert_array_equal(found[3], torque_gain(mismatch, 7) * plain[3])
    np.testing.assert_array_equal(found[1:3], plain[1:3])


def test_gears_keep_the_power(plain: np.ndarray) -> None:
    mismatch = Mismatch(gear_ratio=0.05, gear_sign=3, seed=4)
    found = sway(SimulatedArm(ROBOT, TRUTH, seed=3, mismatch=mismatch))
    assert np.count_nonzero(position_gain(mismatch, 7) < 0) == 3
    np.testing.assert_allclose(found[2] * found[3], plain[2] * plain[3], rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(found[1], position_gain(mismatch, 7) * plain[1])


def test_the_arm_as_built() -> None:
    """The true pose at reported q equals the nominal pose at q minus the offsets, except for displaced frames."""
    robot = ROBOT
    q = robot.q_home + 0.3
    mismatch = Mismatch(joint_zero=0.01, seed=2)
    offsets = draw(mismatch, "joint_zero", 7)
    np.testing.assert_allclose(
        built_robot(mismatch, robot).chain.forward(q), robot.chain.forward(q - offsets), atol=1e-14
    )
    shifted = Mismatch(base_shift=0.01, seed=2)
    moved = built_robot(shifted, robot).chain.forward(q)[:3, 3] - robot.chain.forward(q)[:3, 3]
    np.testing.assert_allclose(moved, draw(shifted, "base_shift", 3), atol=1e-14)
    turned = built_robot(Mismatch(base_turn=0.02), robot)
    np.testing.assert_array_equal(turned.T_base_mount[:3, 3], robot.T_base_mount[:3, 3])
    assert not np.allclose(turned.T_base_mount, robot.T_base_mount, atol=1e-3)
    longer = built_robot(Mismatch(link_length=0.002), robot)
    assert np.abs(longer.links[1:, :3, 3] - robot.links[1:, :3, 3]).max() <= 0.002
    np.testing.assert_array_equal(longer.links[:, :3, :3], robot.links[:, :3, :3])
    arm = SimulatedArm(robot, TRUTH, mismatch=Mismatch(link_length=0.002))
    np.testing.assert_allclose(arm.sample.T_base_tool, arm.built.chain.forward(arm.sample.q), atol=1e-12)
    assert arm.robot is robot


def test_bodies_and_parameters() -> None:
    def truth(**knobs: float) -> Truth:
        return built_truth(Mismatch(**knobs), TRUTH, ROBOT)  # type: ignore[arg-type]

    mass, centre, about = inertia.to_body(truth(mass=0.1).pi)
    old = inertia.to_body(TRUTH.pi)
    share = mass / old.mass
    assert np.all(np.abs(share - 1) <= 0.1)
    np.testing.assert_allclose(centre, old.centre, atol=1e-15)
    np.testing.assert_allclose(about, share[:, None, None] * old.inertia, atol=1e-15)
    shifted = inertia.to_body(truth(centre=0.01).pi)
    assert 0.005 < np.abs(shifted.centre - old.centre).max() <= 0.01
    np.testing.assert_allclose(shifted.inertia, old.inertia, atol=1e-12)
    loaded = truth(payload=0.5)
    body = inertia.to_body(loaded.pi[-1] - TRUTH.pi[-1])
    assert body.mass == pytest.approx(0.5)
    T_last_tool = ROBOT.frames[-1]
    np.testing.assert_allclose(body.centre, T_last_tool[:3, :3] @ [0, 0, 0.06] + T_last_tool[:3, 3], atol=1e-12)
    rubbing = truth(friction=0.3)
    np.testing.assert_allclose(rubbing.viscous / TRUTH.viscous, rubbing.coulomb_pos / TRUTH.coulomb_pos)
    np.testing.assert_allclose(truth(saturation=0.25).tau_max, 0.75 * TRUTH.tau_max)
    np.testing.assert_allclose(truth(quantisation=1.0).tau_step, 2 * TRUTH.tau_step)
