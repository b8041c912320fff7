"""The torque model and its parts: friction, ripple, warm-up, coupled motors, noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import contact, identify, models, robots
from armlab.errors import ModelMismatchError, ShapeError
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import TorqueModel, load, save, velocity_covariance
from armlab.models.friction import Friction, FrictionBound, FrictionMap, RadialBasis, RippleLines, WarmUp, speed_basis
from armlab.models.torque import CoupledKernel, CoupledMotors
from armlab.models.uncertainty import VelocityCovariance


def test_torque_is_rigid_plus_friction_plus_ripple(model: TorqueModel) -> None:
    t = np.arange(0, 2, 0.004)
    q, qd, qdd = identify.dither(np.zeros(7), 2.0).sample(t)
    z = presliding(q, model.friction.delta, model.friction.resolution)
    expected = model.rigid_torque(q, qd, qdd) + model.friction.torque(qd, z) + model.ripple.torque(q)
    np.testing.assert_allclose(model.torque(q, qd, qdd), model.gains * expected, rtol=0, atol=1e-12)
    slow = model.rigid_torque(q, qd, 0 * q) + model.friction.torque(qd, z) + model.ripple.torque(q)
    np.testing.assert_allclose(model.torque(q, qd), model.gains * slow, rtol=0, atol=1e-12)
    assert model.n == 7


def test_a_row_with_nan_gives_nan_and_leaves_the_state(model: TorqueModel) -> None:
    q, qd, qdd = identify.dither(np.zeros(7), 2.0).sample(np.arange(0, 2, 0.004))
    broken = qd.copy()
    broken[100, 3] = np.nan
    kept = np.arange(len(q)) != 100
    torque = model.torque(q, broken, qdd)
    assert np.isnan(torque[100]).all()
    np.testing.assert_array_equal(torque[kept], model.torque(q[kept], qd[kept], qdd[kept]))


GAINS = np.array([1.04, 0.97, 1.02, 0.95, 1.0, 1.03, 0.98])
FORCE = np.array([5.0, -3.0, 8.0])


@pytest.fixture
def calibrated(model: TorqueModel) -> TorqueModel:
    return replace(model, gains=GAINS, gain_cov=np.full((7, 7), 0.03**2))


def pushed(model: TorqueModel, robot) -> Table:
    """A log of the model's own torque with a force on the tool."""
    t = np.arange(0, 3, 0.004)
    q, qd, qdd = identify.dither(robot.q_home, 3.0).sample(t)
    J = robot.chain.forward_jacobian(q)[1]
    tau = model.torque(q, qd, qdd, np.diff(t, prepend=0.0)) - model.gains * (J[:, :3].transpose(0, 2, 1) @ FORCE)
    return Table(t, {"q": q, "qd": qd, "tau": tau})


@pytest.mark.parametrize("method", ["map", "bounded", "observer", "kf"])
def test_gains_change_the_reading_and_not_the_force(model, calibrated, method: str) -> None:
    yumi = robots.load("yumi_left")
    plain = replace(model, gains=np.ones(7), gain_cov=np.zeros((7, 7)))
    log = pushed(plain, yumi)
    one = contact.Estimator(plain, yumi, method).run(log)
    log = log.with_column("tau", GAINS * log["tau"])
    two = contact.Estimator(calibrated, yumi, method).run(log)
    np.testing.assert_allclose(two["wrench_hat"], one["wrench_hat"], rtol=1e-9, atol=1e-9)
    F = one["wrench_hat"]
    more = two["wrench_hat_cov"] - one["wrench_hat_cov"]
    np.testing.assert_allclose(more, 0.03**2 * F[:, :, None] * F[:, None, :], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("point", [None, [0.0, 0.0, 0.1]], ids=["wrench", "point"])
def test_an_interval_holds_for_all_that_the_gains_may_be(model, point: list[float] | None) -> None:
    """Gains known to 3 %: both ends move out by three standard deviations, except for an axis held by its box."""
    yumi = robots.load("yumi_left")
    known = replace(model, gains=np.ones(7), gain_cov=np.zeros((7, 7)))
    log = pushed(known, yumi).between(0.0, 0.1)
    sure, wide = (
        contact.Estimator(one, yumi, "interval", point=point).run(log)["wrench_interval"]
        for one in (known, replace(known, gain_cov=np.full((7, 7), 0.03**2)))
    )
    forces = 3 if point else 6
    box = 10.0 * np.array([20.0, 20, 20, 2, 2, 2])[:forces, None]
    expected = np.clip(sure[:, :forces] + 0.09 * np.array([-1, 1]) * np.abs(sure[:, :forces]), -box, box)
    np.testing.assert_allclose(wide[:, :forces], expected, rtol=1e-9, atol=1e-9)
    assert np.all((wide[:, :, 0] <= sure[:, :, 0]) & (wide[:, :, 1] >= sure[:, :, 1]))
    assert np.mean(wide[:, :, 1] - wide[:, :, 0]) > 1.005 * np.mean(sure[:, :, 1] - sure[:, :, 0])


def test_joints_without_torque_do_not_make_the_gains_of_the_others_surer(model) -> None:
    measured = np.array([1, 1, 1, 1, 0, 0, 0])
    some = replace(model, gains=np.ones(7), gain_cov=0.03**2 * np.outer(measured, measured))
    every = replace(some, gain_cov=np.full((7, 7), 0.03**2))
    log = pushed(every, robots.load("yumi_left")).between(0.0, 0.4)
    one, two = (contact.Estimator(m, robots.load("yumi_left")).run(log)["wrench_hat_cov"] for m in (some, every))
    np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12)


# Friction, torque ripple, warm-up, coupled motors and noise models.


FRICTION = Friction(
    viscous=[2.0], coulomb_pos=[3.0], coulomb_neg=[4.0], offset=[0.5], stribeck=[1.0], stribeck_speed=[0.05],
    delta=[1e-3], resolution=[0.0],
)  # fmt: skip


def test_friction_torque_is_the_formula() -> None:
    f = FRICTION
    assert f.torque([1.0], [1.0])[0] == pytest.approx(2 + 3 + 0.5 + np.exp(-400))
    assert f.torque([-1.0], [-1.0])[0] == pytest.approx(-2 - 4 + 0.5 - np.exp(-400))
    assert f.torque([0.0], [0.5])[0] == pytest.approx(1.5 + 0.5 + 0.5)
    assert f.static[0] == pytest.approx(4.5)


def test_the_bound_near_rest_is_static_friction_and_fades_with_speed() -> None:
    bound = FrictionBound.of(FRICTION, floor=np.array([0.1]))
    assert bound.torque_at([0.0])[0] == pytest.approx(4.5 + 0.1)
    assert bound.torque_at([[0.02], [-0.02]])[:, 0] == pytest.approx(4.5 * np.exp(-1) + 0.1)
    assert bound.torque_at([1.0])[0] == pytest.approx(0.1)
    assert FrictionBound.of(FRICTION).floor[0] == 0.0


# Friction over position and speed.


def basis(n: int = 2) -> RadialBasis:
    positions, speeds = np.linspace(-2, 2, 8), np.geomspace(0.05, 1.0, 5)
    return RadialBasis(*(np.tile(x, (n, 1)) for x in (positions, np.full(8, 0.5), speeds, np.gradient(speeds))))


def test_the_torque_of_a_map_is_functions_times_coefficients() -> None:
    rng = np.random.default_rng(1)
    b, k = basis(), rng.standard_normal((2, 2, 8, 5))
    q, qd, z = rng.uniform(-1, 1, (3, 60, 2))
    expected = np.stack([b.functions(i, q[:, i], qd[:, i], z[:, i]) @ k[i].ravel() for i in range(2)], axis=1)
    np.testing.assert_allclose(FrictionMap(b, k).torque(q, qd, z), expected, rtol=0, atol=1e-12)


def test_outside_is_told() -> None:
    assert basis().outside([[0.0, 0.0], [2.5, 0.0]], [[0.0, 2.0], [0.1, -0.5]]).tolist() == [
        [False, True],
        [True, False],
    ]


# Torque ripple over position and speed.


SPEEDS, WIDTHS = (np.stack([part, part]) for part in speed_basis(-1.0, 1.0))
LINES = RippleLines([1, 1], [100.0, 200.0], SPEEDS, WIDTHS, np.ones((2, 1, 8, 2)))  # of the second joint of two


def test_equal_amplitudes_are_a_plain_line() -> None:
    q, qd = np.random.default_rng(0).uniform(-2, 2, (2, 50, 2))
    torque = LINES.torque(q, qd, np.sign(qd))
    expected = sum(np.cos(c * q[:, 1]) + np.sin(c * q[:, 1]) for c in (100.0, 200.0))
    np.testing.assert_allclose(torque[:, 1], expected, rtol=0, atol=1e-12)
    assert not torque[:, 0].any()
    assert LINES.n == 2


# Warm-up.


def warm_up(n: int = 1, **change: object) -> WarmUp:
    fields = {"of_coulomb": -0.1, "of_viscous": -0.4, "time": 100.0, "power": 2.0, "start": 0.0}
    return WarmUp(**{name: np.full(n, change.get(name, value)) for name, value in fields.items()})  # type: ignore[arg-type]


def test_a_drive_settles_at_thermal_state_one_under_the_reference_power() -> None:
    x = warm_up().thermal_state(np.full((1001, 1), 2.0), np.ones(1001))
    assert x[0, 0] == 0.0
    assert x[100, 0] == pytest.approx(1 - np.exp(-1.0))
    assert x[-1, 0] == pytest.approx(1.0, abs=1e-4)
    assert np.all(warm_up(time=0.0, start=0.3).thermal_state(np.ones((5, 1)), np.ones(5)) == 0.3)


def test_a_model_warms_up_along_a_record(tmp_path, model) -> None:
    """At constant velocity, viscous and Coulomb torque follow the thermal state, which follows their power."""
    part = warm_up(7, time=5.0)
    warm = load(save(replace(model, warm_up=part), tmp_path / "model.toml"))
    t = np.arange(0, 40, 0.01)
    qd = np.full((len(t), 7), 0.3)
    q, dt = np.cumsum(qd, axis=0) * 0.01, np.full(len(t), 0.01)
    change = (warm.torque(q, qd, dt=dt) - model.torque(q, qd)) / model.gains
    f = model.friction
    x = (change / -(0.4 * f.viscous * 0.3 + 0.1 * f.coulomb_pos))[200:]
    settled = x[-1]
    rubbing = f.viscous * (1 - 0.4 * settled) * 0.3 + f.coulomb_pos * (1 - 0.1 * settled)
    rubbing = rubbing + f.stribeck * np.exp(-((0.3 / f.stribeck_speed) ** 2))
    np.testing.assert_allclose(settled, np.abs(rubbing * 0.3) / 2.0, rtol=1e-2)
    assert np.array_equal(warm.torque(q, qd), model.torque(q, qd))  # without steps it stays cold


# Coupled motors.


WRIST = CoupledMotors(np.array([[0, 0, 0, 0, 0, 0.5, 1.0]]), [0.02], [0.3], [0.4], [0.02])


def test_one_motor_of_two_joints() -> None:
    """The coupling is symmetric: each joint's motion takes the same torque from the other joint."""
    qd, qdd = np.zeros(7), np.zeros(7)
    qdd[5] = 2.0
    np.testing.assert_allclose(WRIST.torque(qd, qdd)[5:], 0.02 * 2.0 * 0.5 * np.array([0.5, 1.0]))
    np.testing.assert_allclose(WRIST.inertial(qdd), WRIST.torque(qd, qdd))
    qd[6] = 3.0
    speed = 3.0
    own = 0.3 * speed + 0.4 * np.tanh(speed / 0.02)
    np.testing.assert_allclose(WRIST.torque(qd, 0 * qdd)[5:], own * np.array([0.5, 1.0]))
    assert not WRIST.torque(qd, qdd)[:5].any()


def test_a_model_with_them_predicts_and_estimates_past_them(model, excited, tmp_path) -> None:
    """The log of an arm with a coupled wrist: the model without the wrist sees forces, the one with it none."""
    wrist = replace(model, coupled=WRIST)
    q, qd, dt = (np.ascontiguousarray(x[:500]) for x in (excited["q"], excited["qd"], excited.dt))
    qdd = np.diff(qd, axis=0, prepend=qd[:1]) / dt[:, None]
    tau = model.torque(q, qd, qdd) + model.gains * WRIST.torque(qd, qdd)
    np.testing.assert_allclose(wrist.torque(q, qd, qdd), tau, atol=1e-12)
    zero = np.zeros_like(q)
    np.testing.assert_allclose(wrist.rigid_torque(q, zero, qdd) - model.rigid_torque(q, zero, qdd), WRIST.inertial(qdd))
    plain, relieved = model.estimator_kernel(np.ones(6)), wrist.estimator_kernel(np.ones(6))
    without, found = plain.run(q, qd, tau, dt)[0], relieved.run(q, qd, tau, dt)[0]
    true = replace(model, gains=np.ones(7), gain_cov=np.zeros((7, 7)))
    by_hand = CoupledKernel(true.estimator_kernel(np.ones(6)), WRIST, np.ones(7))
    np.testing.assert_allclose(by_hand.run(q, qd, tau / model.gains, dt)[0], found, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(found, 0.0, atol=1e-9)
    assert np.abs(without).max() > 1e-3
    again = models.load(models.save(wrist, tmp_path / "wrist.toml"))
    np.testing.assert_array_equal(again.coupled.ratios, WRIST.ratios)
    np.testing.assert_array_equal(again.torque(q, qd, qdd), wrist.torque(q, qd, qdd))


def test_step_and_run_are_equal_bit_for_bit_also_past_holes(model, excited) -> None:
    wrist = replace(model, coupled=WRIST)
    q, qd, tau = (np.array(excited[name][:300]) for name in ("q", "qd", "tau"))
    dt = np.array(excited.dt[:300])
    qd[40:43, 2], tau[100, 0], dt[150] = np.nan, np.inf, 0.0
    stepped, run = wrist.estimator_kernel(np.ones(6)), wrist.estimator_kernel(np.ones(6))
    one_by_one = [stepped.step(q[k], qd[k], tau[k], float(dt[k])) for k in range(300)]
    halves = [run.run(q[a:b], qd[a:b], tau[a:b], dt[a:b]) for a, b in ((0, 170), (170, 300))]
    np.testing.assert_array_equal([s[0] for s in one_by_one], np.concatenate([h[0] for h in halves]))
    run.reset()
    np.testing.assert_array_equal(run.run(q[:170], qd[:170], tau[:170], dt[:170])[0], halves[0][0])


# Noise models.


def test_velocity_covariance_kinds() -> None:
    C0, Cinf = [4.0, 1.0], [1.0, 1.0]
    exp = velocity_covariance("exp", C0, Cinf, [10.0, 10.0], alpha2=2.0)
    assert isinstance(exp, VelocityCovariance)
    np.testing.assert_allclose(exp.variance([0.0, 0.0]), [8.0, 2.0])
    np.testing.assert_allclose(exp.variance([-0.1, 5.0]), [2 * (1 + 3 * np.exp(-1.0)), 2.0])
    step = velocity_covariance("step", C0, Cinf, [0.1, 0.1])
    np.testing.assert_allclose(step.variance([[0.05, 0.05], [0.2, -0.2]]), [[4.0, 1.0], [1.0, 1.0]])
    np.testing.assert_allclose(velocity_covariance("const", C0, Cinf).variance([0.0, 0.0]), [1.0, 1.0])


def test_a_model_moves_to_another_tool_and_not_to_another_arm(model: TorqueModel, truth) -> None:
    T_flange_tool = np.eye(4)
    T_flange_tool[2, 3] = 0.12
    robot = truth.robot.with_tool(T_flange_tool)
    with pytest.raises(ModelMismatchError, match=r"tool moved by 0\.12 m"):
        model.check_robot(robot)
    moved = model.moved_to(robot)
    moved.check_robot(robot)
    q = robot.q_home[None]
    np.testing.assert_array_equal(moved.torque(q, 0 * q, 0 * q), model.torque(q, 0 * q, 0 * q))
    with pytest.raises(ModelMismatchError, match="ur5e"):
        model.moved_to(robots.load("ur5e"))


def test_friction_is_of_1_to_32_joints_and_loses_less_than_the_load() -> None:
    assert [Friction.none(n).viscous.shape for n in (1, 32)] == [(1,), (32,)]
    for n in (0, 33):
        with pytest.raises(ShapeError, match="joints from 1 to 32"):
            Friction.none(n)
    replace(Friction.none(1), load=np.array([0.999]))
    for share in (1.0, -1e-3):
        with pytest.raises(ShapeError, match=r"in \[0, 1\)"):
            replace(Friction.none(1), load=np.array([share]))
