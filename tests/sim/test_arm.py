"""The simulated arms: equation of motion, tracking, sensors, friction, drives, recordings."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import identify, robots
from armlab.robots import Robot, inertia
from armlab.sim.arm.arm import (
    INTEGRAL_TIME,
    POSITION_GAIN,
    VELOCITY_GAIN,
    WARM_TIME,
    JointDrives,
    JointFriction,
    LaggingArm,
    SensorReading,
    SimulatedArm,
    TrueState,
    WornFriction,
    record,
)
from armlab.sim.arm.mismatch import Mismatch, load_share
from armlab.sim.arm.truth import Truth, synthetic_truth

T = 0.004032
YUMI = robots.load("yumi_left")
TRUTH = synthetic_truth(YUMI)
NOISELESS, SMOOTH = TRUTH.without("noise"), TRUTH.without("ripple", "offset")


def sway(robot: Robot, t: float, share: float = 0.6, hertz: float = 0.35) -> tuple[np.ndarray, np.ndarray]:
    """A motion that begins at rest; peak speed is `share` of the limits, at most 0.6 rad wide."""
    w = 2 * np.pi * hertz
    width = np.minimum(share * robot.qd_max / w, 0.6)
    return robot.q_home + width * (1 - np.cos(w * t)), width * w * np.sin(w * t)


def equation(robot: Robot, truth: Truth, sample: TrueState) -> np.ndarray:
    """Torque required by the motion, from the kernels' inverse dynamics."""
    rigid = robot.chain.rnea(sample.q, sample.qd, sample.qdd, robot.gravity, truth.pi)
    return rigid + truth.rotor * sample.qdd + sample.tau_friction - robot.chain.jacobian(sample.q).T @ sample.wrench


def drive_along(arm: SimulatedArm, robot: Robot, seconds: float, wrench: np.ndarray | None = None) -> list[TrueState]:
    samples = []
    for k in range(1, round(seconds / T)):
        arm.step(*sway(robot, k * T), wrench)
        samples.append(arm.sample)
    return samples


@pytest.mark.parametrize("name", ["yumi_left", "irb2400"])
def test_samples_satisfy_the_equation_of_motion(name: str) -> None:
    robot = robots.load(name)
    truth = synthetic_truth(robot)
    arm = SimulatedArm(robot, truth)
    scale = truth.tau_max.max()
    wrench = scale / 10 * np.array([1.0, -0.6, 0.4, 0.02, 0.04, -0.02])
    for sample in drive_along(arm, robot, 0.5, wrench)[10::20]:
        np.testing.assert_allclose(sample.tau, equation(robot, truth, sample), atol=1e-11 * scale)
        np.testing.assert_allclose(sample.T_base_tool, robot.chain.forward(sample.q), atol=1e-12)


def test_a_payload_appears_as_its_weight() -> None:
    """1 kg at the tool point, unknown to the model: f_z = -9.81 N at rest."""
    tool = YUMI.frames[-1][:3, 3]
    arm = SimulatedArm(YUMI, TRUTH.with_payload(1.0, tool).without("friction", "ripple"))
    for _ in range(1000):
        arm.step(YUMI.q_home, np.zeros(7), None)
    tau_e = equation(YUMI, TRUTH, arm.sample) - arm.sample.tau
    estimate = np.linalg.lstsq(YUMI.chain.jacobian(arm.sample.q).T, tau_e, rcond=None)[0]
    np.testing.assert_allclose(estimate, [0, 0, -9.80665, 0, 0, 0], atol=1e-4)


def test_energy_is_kept_without_drives_and_friction() -> None:
    """A free double swing: kinetic plus potential energy, from the kernels' terms, is conserved."""
    free = TRUTH.without("friction", "ripple", "offset")
    arm = SimulatedArm(YUMI, free, q=YUMI.q_home + 0.5)
    arm.drive.torque = lambda *args: args[-1].fill(0.0)  # type: ignore[method-assign]
    arm.place(YUMI.q_home + 0.5)

    def energy(sample: TrueState) -> tuple[float, float]:
        q, qd, zero = sample.q, sample.qd, np.zeros(7)
        M_qd = YUMI.chain.rnea(q, zero, qd, np.zeros(3), free.pi) + free.rotor * qd
        heights = sum(
            pi[0] * T_base_link[2, 3] + T_base_link[2, :3] @ pi[1:4]
            for pi, T_base_link in zip(free.pi, YUMI.chain.link_transforms(q))
        )
        return 0.5 * qd @ M_qd, 9.80665 * heights

    energies = []
    for _ in range(500):
        arm.step(YUMI.q_home, np.zeros(7), None)
        energies.append(energy(arm.sample))
    kinetic, potential = np.array(energies).T
    assert kinetic.max() > 5.0
    assert np.ptp(kinetic + potential) < 2e-4 * kinetic.max()


def test_tracking_at_sixty_percent_speed() -> None:
    arm = SimulatedArm(YUMI, TRUTH)
    samples = drive_along(arm, YUMI, 3.0)
    peak = np.max([np.abs(s.qd) / YUMI.qd_max for s in samples], axis=0)
    assert peak[:4].min() > 0.4
    errors = np.degrees([s.q - s.q_ref for s in samples])
    assert np.abs(errors).max() < 1.0
    assert arm.drive.saturated == 0


def test_noise_is_white_with_the_stated_size() -> None:
    arm = SimulatedArm(YUMI, TRUTH, seed=7)
    errors_tau, errors_qd = [], []
    for k in range(1, 1500):
        arm.step(*sway(YUMI, k * T, 0.3), None)
        measured = arm.measure()
        errors_tau.append(measured.tau - equation(YUMI, TRUTH, arm.sample))
        errors_qd.append(measured.qd - arm.sample.qd)
        assert isinstance(measured, SensorReading)
        assert np.abs(measured.q - arm.sample.q).max() <= 0.5e-5 + 1e-12
    tau, qd = np.array(errors_tau), np.array(errors_qd)
    np.testing.assert_allclose(tau.std(0), np.hypot(TRUTH.tau_noise, TRUTH.tau_step / np.sqrt(12)), rtol=0.06)
    np.testing.assert_allclose(qd.std(0), 1e-3, rtol=0.06)
    assert (np.abs(tau.mean(0)) < 4 * TRUTH.tau_noise / np.sqrt(len(tau))).all()
    for lag in (1, 2, 5):
        rho = (tau[lag:] * tau[:-lag]).mean(0) / tau.var(0)
        assert np.abs(rho).max() < 4 / np.sqrt(len(tau))


def mujoco_model(robot: Robot, truth: Truth) -> tuple[object, object]:
    """The same arm for MuJoCo: one body per link frame, a site at the tool point."""
    import mujoco

    def pose(T: np.ndarray) -> dict[str, np.ndarray]:
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(T[:3, :3]).ravel())
        return {"pos": T[:3, 3], "quat": quat}

    spec = mujoco.MjSpec()
    spec.option.gravity = robot.gravity
    body = spec.worldbody
    for i in range(robot.n):
        body = body.add_body(**pose(robot.frames[i]))
        kind = mujoco.mjtJoint.mjJNT_SLIDE if robot.prismatic[i] else mujoco.mjtJoint.mjJNT_HINGE
        body.add_joint(type=kind, axis=[0, 0, 1], armature=truth.rotor[i])
        mass, centre, about = inertia.to_body(truth.pi[i])
        body.mass, body.ipos, body.explicitinertial = mass, centre, True
        body.fullinertia = about[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.add_site(**pose(robot.frames[-1]))
    model = spec.compile()
    return model, mujoco.MjData(model)


@pytest.mark.parametrize("name", ["yumi_left", "panda"])
def test_bodies_move_as_those_of_mujoco(name: str) -> None:
    import mujoco

    robot = robots.load(name)
    truth, wrench = synthetic_truth(robot), np.array([3.0, -5.0, 4.0, 0.3, -0.2, 0.1])
    arm = SimulatedArm(robot, truth)
    model, data = mujoco_model(robot, truth)
    for k in range(1, 60):
        arm.step(*sway(robot, k * T), wrench)
    now = arm.sample
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = now.q, now.qd, now.tau - now.tau_friction
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_applyFT(model, data, wrench[:3], wrench[3:], data.site_xpos[0], robot.n, data.qfrc_applied)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(now.qdd, data.qacc, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(now.T_base_tool[:3, 3], data.site_xpos[0], rtol=0, atol=1e-12)


def walk(arm: SimulatedArm, k: int) -> None:
    arm.step(YUMI.q_home + 0.1 * (1 - np.cos(3 * k * T)), np.full(7, 0.3 * np.sin(3 * k * T)), None)


def test_torque_comes_late_and_position_does_not() -> None:
    arm = SimulatedArm(YUMI, NOISELESS, mismatch=Mismatch(torque_delay=3))
    exact = [arm.sample.tau]
    for k in range(1, 30):
        walk(arm, k)
        exact.append(arm.sample.tau)
        measured = arm.measure()
        np.testing.assert_array_equal(measured.tau, exact[max(k - 3, 0)])
        np.testing.assert_array_equal(measured.q, arm.sample.q)


def test_an_elastic_gear_turns_by_what_it_carries() -> None:
    """At rest the gear carries gravity; the reported velocity is the derivative of the reported position."""
    arm = SimulatedArm(YUMI, NOISELESS, mismatch=Mismatch(elasticity=1e-2))
    carried = YUMI.chain.rnea(arm.sample.q, np.zeros(7), np.zeros(7), YUMI.gravity, NOISELESS.pi)
    np.testing.assert_allclose(arm.measure().q - arm.sample.q, 1e-2 * carried / NOISELESS.tau_max, atol=1e-6)
    rows = []
    for k in range(1, 200):
        walk(arm, k)
        measured = arm.measure()
        rows.append((measured.q, measured.qd))
    q, qd = np.array(rows).transpose(1, 0, 2)
    np.testing.assert_allclose(np.diff(q, axis=0)[20:] / T, 0.5 * (qd[1:] + qd[:-1])[20:], atol=2e-3)


UR5E = robots.load("ur5e")


def test_a_step_comes_after_two_cycles_through_a_lag_of_8_ms() -> None:
    arm = LaggingArm(UR5E, 0.004)
    goal, seen = UR5E.q_home + 0.1, []
    for _ in range(12):
        arm.step(goal, np.zeros(6), None)
        seen.append(arm.measure().q - UR5E.q_home)
    expected = np.where(np.arange(12) < 2, 0.0, 0.1 * (1 - np.exp(-0.004 * (np.arange(12) - 1) / 0.008)))
    np.testing.assert_allclose(np.array(seen)[:, 0], expected, atol=1e-12)
    measured = arm.measure()
    assert np.isnan(measured.tau).all()
    assert not arm.has_torque
    np.testing.assert_allclose(arm.sample.T_base_tool, UR5E.chain.forward(measured.q))


SWAY = identify.dither(YUMI.q_home, 2.0)


def mismatched(**knobs: float) -> SimulatedArm:
    return SimulatedArm(YUMI, TRUTH, seed=1, mismatch=Mismatch(**knobs))  # type: ignore[arg-type]


def test_a_record_follows_the_motion() -> None:
    table = record(mismatched(), SWAY)
    assert len(table) == int(2.0 / T)
    np.testing.assert_allclose(np.diff(table.t), T, rtol=1e-9)
    np.testing.assert_allclose(table["q"], SWAY.sample(table.t)[0], atol=2e-3)
    np.testing.assert_array_equal(record(mismatched(), SWAY)["tau"], table["tau"])
    assert "wrench_true" not in table


def test_a_push_is_in_the_torques() -> None:
    force = np.array([0, 0, -5.0, 0, 0, 0])
    pushed = record(mismatched(), SWAY, lambda t: np.outer(t > 1.0, force))
    np.testing.assert_array_equal(pushed["wrench_true"][-1], force)
    J = YUMI.chain.jacobian(pushed["q"][-1])
    change = (pushed["tau"] - record(mismatched(), SWAY)["tau"])[-100:].mean(axis=0)
    np.testing.assert_allclose(change, -J.T @ force, atol=0.5)


def test_stamps_jitter_and_samples_are_lost() -> None:
    table = record(mismatched(jitter=1e-3), SWAY)
    plain = record(mismatched(), SWAY)
    np.testing.assert_array_equal(table["tau"], plain["tau"])
    error = table.t - plain.t
    assert 0.9e-3 < np.abs(error).max() <= 1e-3
    lossy = record(mismatched(lost=0.1), SWAY)
    assert 0.85 * len(plain) < len(lossy) < 0.95 * len(plain)
    assert np.isin(lossy.t, plain.t).all()


STEP = 1e-3


def slide(friction: JointFriction, speed: float, distance: float) -> np.ndarray:
    """Move all joints at one speed; return the friction torque at the end."""
    qd = np.full(7, speed)
    for _ in range(max(1, round(distance / abs(speed) / STEP))):
        friction.advance(qd * STEP, qd)
    return friction.torque(np.zeros(7), qd, np.empty(7))


@pytest.mark.parametrize("speed", [0.02, 0.1, 1.0])
def test_constant_speed_gives_the_stribeck_curve(speed: float) -> None:
    bump = 1 + 0.3 * np.exp(-((speed / 0.05) ** 2))
    np.testing.assert_allclose(
        slide(JointFriction(SMOOTH), speed, 0.01), SMOOTH.coulomb_pos * bump + SMOOTH.viscous * speed, rtol=1e-6
    )
    np.testing.assert_allclose(
        slide(JointFriction(SMOOTH), -speed, 0.01), -SMOOTH.coulomb_neg * bump - SMOOTH.viscous * speed, rtol=1e-6
    )


def test_break_away_is_at_static_friction() -> None:
    """A slowly growing torque on a free mass: it creeps within the presliding distance, then breaks away."""
    friction, inertia = JointFriction(SMOOTH), np.full(7, 0.2)
    qd, q, broke = np.zeros(7), np.zeros(7), np.full(7, np.nan)
    for share in np.linspace(0.0, 1.6, 20000):
        tau = share * SMOOTH.coulomb_pos
        qd += STEP * (tau - friction.torque(q, qd, np.empty(7))) / inertia
        q += STEP * qd
        friction.advance(STEP * qd, qd)
        moved = np.isnan(broke) & (qd > 0.02)
        broke[moved] = share
    np.testing.assert_allclose(broke, 1.3, atol=0.05)


def test_presliding_is_a_spring() -> None:
    friction = JointFriction(SMOOTH)
    friction.advance(np.full(7, 1e-8), np.zeros(7))
    np.testing.assert_allclose(friction.bristle, SMOOTH.coulomb_pos / SMOOTH.delta * 1e-8, rtol=1e-3)


def test_ripple_and_offset() -> None:
    friction, q = JointFriction(TRUTH), np.linspace(-1, 1, 7)
    expected = TRUTH.offset + TRUTH.ripple * np.sin(TRUTH.ripple_cycles * q + np.arange(7))
    np.testing.assert_allclose(friction.torque(q, np.zeros(7), np.empty(7)), expected, rtol=1e-12)
    turn = friction.torque(q + 2 * np.pi / TRUTH.ripple_cycles, np.zeros(7), np.empty(7))
    np.testing.assert_allclose(turn, expected, rtol=1e-9)


WORN_TRUTH = TRUTH.without("offset")


def slide_worn(friction: JointFriction, speed: np.ndarray, step: float = 0.01, count: int = 50) -> np.ndarray:
    """Torque after sliding `count` steps."""
    for _ in range(count):
        friction.advance(speed * step, speed)
    return friction.torque(np.zeros(7), speed, np.empty(7))


def test_a_warm_drive_has_lost_its_share_of_viscous_friction() -> None:
    """At a quarter of full speed the warmth settles at 1, with the time constant of 12 minutes."""
    smooth, speed = SMOOTH, 0.25 * YUMI.qd_max
    friction = WornFriction(smooth, Mismatch(warm_up=0.4), 1.0, np.zeros(7))
    cold = slide_worn(JointFriction(smooth), speed, 1.0)
    slide_worn(friction, speed, 1.0, round(WARM_TIME))
    assert np.all(friction.warmth > 0.5)
    assert np.all(friction.warmth < 1 - np.exp(-1.0) + 0.01)
    warm = slide_worn(friction, speed, 1.0, 7 * round(WARM_TIME))
    assert np.all(friction.warmth > 0.9)
    lost = 0.4 * np.minimum(friction.warmth, 1.0) * smooth.viscous * speed
    np.testing.assert_allclose(cold - warm, lost, rtol=1e-3)


def test_load_presses_on_the_bearings() -> None:
    speed, smooth = np.full(7, 1.0), SMOOTH
    mismatch = Mismatch(load_friction=0.06)
    loaded, share = WornFriction(smooth, mismatch, 0.01, -smooth.tau_max), load_share(mismatch, 7)
    growth = slide_worn(loaded, speed) - slide_worn(JointFriction(smooth), speed)
    np.testing.assert_allclose(growth, share * smooth.tau_max, rtol=1e-3)
    assert 0.0 < share.min() < share.max() < 0.06


def test_offsets_swing() -> None:
    speed, smooth = np.full(7, 1.0), SMOOTH
    drifting = WornFriction(smooth, Mismatch(offset_drift=0.02), 0.5, np.zeros(7))
    along = np.array([slide_worn(drifting, speed, 0.5, 1) for _ in range(400)])
    away = (along - slide_worn(JointFriction(smooth), speed)) / smooth.tau_max
    np.testing.assert_allclose(away[250:].mean(axis=0), 0.0, atol=0.006)
    np.testing.assert_allclose(away[200:], away[:200], atol=1e-4)
    assert 0.005 < np.abs(away).max() < 0.02 * np.sqrt(2.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_ripple_jumps_at_reversal(sign: float) -> None:
    """Forward, the ripple is unchanged; backward, its phase is shifted by `ripple_jump`."""
    speed = np.full(7, sign)
    jumping = slide_worn(WornFriction(WORN_TRUTH, Mismatch(ripple_jump=1.0), 0.01, np.zeros(7)), speed)
    rest = slide_worn(JointFriction(SMOOTH), speed)
    phase = WORN_TRUTH.ripple_phase + (0.0 if sign > 0 else 1.0)
    np.testing.assert_allclose(jumping - rest, WORN_TRUTH.ripple * np.sin(phase), atol=0.06 * WORN_TRUTH.ripple.max())


INERTIA, TAU_MAX = np.array([0.2, 0.1]), np.array([40.0, 5.0])
ZERO = np.zeros(2)


def drive() -> JointDrives:
    return JointDrives(INERTIA, TAU_MAX, np.array([0.9, 0.9]), 1e-3)


def test_saturation_stops_the_integral() -> None:
    unit, far = drive(), np.array([0.0, 1.0])
    for _ in range(1000):
        tau = unit.torque(far, ZERO, ZERO, ZERO, ZERO, ZERO, np.empty(2))
    assert tau[1] == TAU_MAX[1]
    assert unit.saturated == 1000
    back = unit.torque(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, np.empty(2))
    np.testing.assert_allclose(back, 0.0, atol=1e-9)


def test_integral_removes_a_constant_load() -> None:
    """A free mass under a constant load returns to its reference."""
    unit, q, qd, load = drive(), np.zeros(2), np.zeros(2), np.array([-3.0, 1.0])
    largest = np.zeros(2)
    for _ in range(3000):
        tau = unit.torque(ZERO, ZERO, ZERO, q, qd, ZERO, np.empty(2))
        qd += 1e-3 * (tau + load) / INERTIA
        q += 1e-3 * qd
        largest = np.maximum(largest, np.abs(q))
    assert (largest > 1e-4).all()
    np.testing.assert_allclose(q, 0.0, atol=1e-9)
    np.testing.assert_allclose(tau, -load, rtol=1e-6)


def test_scaled_gains_and_added_torque_follow_the_law() -> None:
    unit = drive()
    unit.assist(np.array([0.5, -0.2]), np.array([0.5, 0.0]), np.array([2.0, 0.0]))
    lag, speed, bias = np.array([1e-3, 2e-3]), np.array([0.01, 0.02]), np.array([2.0, 1.0])
    e = np.array([2.0, 0.0]) * speed + np.array([0.5, 0.0]) * POSITION_GAIN * lag
    integral = np.array([0.5, 0.0]) ** 2 * e * 1e-3 / INTEGRAL_TIME
    expected = INERTIA * (np.array([2.0, 0.0]) * 3.0 + VELOCITY_GAIN * (e + integral)) + 0.9 * bias + [0.5, -0.2]
    tau = unit.torque(lag, speed, np.full(2, 3.0), ZERO, ZERO, bias, np.empty(2))
    np.testing.assert_allclose(tau, expected, rtol=1e-12)
    assert tau[1] == 0.9 * 1.0 - 0.2, "both scales zero: feed-forward and the added torque alone"
