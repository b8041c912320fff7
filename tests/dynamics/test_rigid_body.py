"""Rigid-body dynamics against Pinocchio; laws; models; arguments."""

from __future__ import annotations

import warnings
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from armlab import dynamics, kinematics, robots
from armlab.errors import ModelMismatchError, RobotError, ShapeError
from armlab.lie import so3
from armlab.models import TorqueModel
from armlab.robots import Robot, couplings, inertia


def random_robot(seed: int, n: int | None = None) -> Robot:
    """Return a chain of 1 to 9 joints with any axes and bodies, a mount, a tool and coupled gears."""
    rng = np.random.default_rng(seed)
    n = n or int(rng.integers(1, 10))
    frames = np.tile(np.eye(4), (n + 1, 1, 1))
    frames[:, :3, :3] = so3.exp(rng.normal(scale=1.5, size=(n + 1, 3)))
    frames[:, :3, 3] = rng.normal(scale=0.3, size=(n + 1, 3))
    arm = robots.from_links("random", frames, prismatic=rng.random(n) < 0.3)
    roots = rng.normal(scale=0.1, size=(n, 3, 3))
    inertias = roots @ np.swapaxes(roots, 1, 2) + 0.01 * np.eye(3)
    return replace(
        arm,
        inertias=inertia.from_body(rng.uniform(0.5, 5.0, n), rng.normal(scale=0.2, size=(n, 3)), inertias),
        gravity=rng.normal(scale=6.0, size=3),
        T_base_mount=frames[0],
        T_flange_tool=frames[-1],
        coupling=np.eye(n) + 0.2 * np.tri(n, k=-1),
    )


class Peer:
    """The same arm in Pinocchio, whose joint frames are the link frames."""

    def __init__(self, robot: Robot) -> None:
        self.model = pin.Model()
        self.model.gravity.linear = np.array(robot.gravity)
        joint = 0
        for frame, slides, body, name in zip(robot.frames, robot.prismatic, robot.inertias, robot.joint_names):
            kind = pin.JointModelPZ() if slides else pin.JointModelRZ()
            joint = self.model.addJoint(joint, kind, pin.SE3(frame), name)
            self.model.appendBodyToJoint(joint, pin.Inertia.FromDynamicParameters(body), pin.SE3.Identity())
        self.data = self.model.createData()


def symmetric(M: np.ndarray) -> np.ndarray:
    """Fill in the lower half, which Pinocchio does not set."""
    return np.triu(M) + np.triu(M, 1).T


def assert_near(found: np.ndarray, expected: np.ndarray, relative: float) -> None:
    """Compare relative to the largest entry, or to 0.01 if that is larger."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=relative * max(np.abs(expected).max(), 1e-2))


def assert_as_pinocchio(robot: Robot, seed: int) -> None:
    """All functions agree to 1e-12 of the largest entry, derivatives to 1e-9."""
    peer, rng = Peer(robot), np.random.default_rng(seed)
    model, data, n = peer.model, peer.data, robot.n
    q, qd, qdd, tau = rng.normal(scale=[[1.5], [2.0], [5.0], [20.0]], size=(4, n))
    f = rng.normal(scale=10.0, size=6)
    pushed = kinematics.jacobian(robot, q).T @ f

    torque = pin.rnea(model, data, q, qd, qdd)
    assert_near(dynamics.inverse_dynamics(robot, q, qd, qdd), torque, 1e-12)
    assert_near(dynamics.inverse_dynamics(robot, q, qd, qdd, f_ext=f), torque - pushed, 1e-12)
    assert_near(dynamics.gravity(robot, q), pin.computeGeneralizedGravity(model, data, q), 1e-12)
    assert_near(dynamics.mass_matrix(robot, q), symmetric(pin.crba(model, data, q)), 1e-12)
    C = np.array(pin.computeCoriolisMatrix(model, data, q, qd))
    assert_near(dynamics.coriolis_matrix(robot, q, qd), C, 1e-12)
    assert_near(dynamics.coriolis(robot, q, qd), C @ qd, 1e-12)
    assert_near(dynamics.forward_dynamics(robot, q, qd, tau), pin.aba(model, data, q, qd, tau), 1e-12)
    assert_near(dynamics.forward_dynamics(robot, q, qd, tau, f_ext=f), pin.aba(model, data, q, qd, tau + pushed), 1e-12)
    energy = pin.computeKineticEnergy(model, data, q, qd), pin.computePotentialEnergy(model, data, q)
    assert_near(np.array(dynamics.energy(robot, q, qd)), np.array(energy), 1e-12)
    Y = np.reshape(pin.computeJointTorqueRegressor(model, data, q, qd, qdd), (n, 10 * n))
    assert_near(dynamics.regressor(robot, q, qd, qdd), Y, 1e-12)

    by_q, by_qd, M = pin.computeRNEADerivatives(model, data, q, qd, qdd)
    expected = by_q, by_qd, symmetric(M)
    for ours, theirs in zip(dynamics.inverse_dynamics_derivatives(robot, q, qd, qdd), expected, strict=True):
        assert_near(ours, theirs, 1e-9)
    by_q, by_qd, inverse = pin.computeABADerivatives(model, data, q, qd, tau)
    expected = by_q, by_qd, symmetric(inverse)
    for ours, theirs in zip(dynamics.forward_dynamics_derivatives(robot, q, qd, tau), expected, strict=True):
        assert_near(ours, theirs, 1e-9)


@pytest.mark.parametrize("seed", range(12))
def test_random_chains_as_pinocchio(seed: int) -> None:
    assert_as_pinocchio(random_robot(seed), seed)


@pytest.mark.slow
def test_300_random_chains_as_pinocchio() -> None:
    for seed in range(100, 400):
        assert_as_pinocchio(random_robot(seed), seed)


TIPS = {  # description under share/example-robot-data/robots: end of the arm
    "panda_description/urdf/panda.urdf": "panda_hand",
    "ur_description/urdf/ur3_robot.urdf": "ee_link",
    "ur_description/urdf/ur3_gripper.urdf": "wrist_3_link",
    "ur_description/urdf/ur5_robot.urdf": "ee_link",
    "ur_description/urdf/ur5_gripper.urdf": "wrist_3_link",
    "ur_description/urdf/ur10_robot.urdf": "ee_link",
    "z1_description/urdf/z1.urdf": "link06",
    "b1_description/urdf/b1-z1.urdf": "link06",
    "xarm_description/urdf/xarm7.urdf": "link7",
    "so_arm_description/urdf/so100.urdf": "gripper",
    "so_arm_description/urdf/so101.urdf": "gripper_link",
    "kinova_description/robots/kinova.urdf": "j2s6s200_end_effector",
    "anymal_b_simple_description/robots/anymal-kinova.urdf": "j2s6s200_end_effector",
    "asr_twodof_description/urdf/TwoDofs.urdf": "Tip",
    "baxter_description/urdf/baxter.urdf": "left_hand_link",
    "tiago_description/robots/tiago.urdf": "arm_tool_link",
    "tiago_description/robots/tiago_dual.urdf": "arm_left_tool_link",
    "talos_data/robots/talos_left_arm.urdf": "gripper_left_base_link",
    "romeo_description/urdf/romeo.urdf": "l_wrist",
    "pr2_description/urdf/pr2.urdf": "r_gripper_palm_link",
    "icub_description/robots/icub.urdf": "l_hand",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TIPS)
def test_foreign_arms_as_pinocchio(name: str) -> None:
    try:
        package = distribution("example-robot-data")
    except PackageNotFoundError:
        pytest.skip("needs the package example-robot-data, extra robots")
    folder = Path(str(package.locate_file("cmeel.prefix/share/example-robot-data/robots")))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # some files have branches that are skipped
        robot = robots.load(folder / name, tip=TIPS[name])
    assert_as_pinocchio(robot, len(name))


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_the_wrench_turns_with_the_jacobian(seed: int) -> None:
    """d(J^T f)/dq_j = Jd(q, e_j)^T f, and -M^-1 times that in the accelerations."""
    robot = random_robot(seed, 6)
    q, qd, qdd, f = np.random.default_rng(seed).normal(size=(4, 6))
    columns = kinematics.jacobian_derivative(robot, np.tile(q, (6, 1)), np.eye(6))
    with_f, without = (dynamics.inverse_dynamics_derivatives(robot, q, qd, qdd, f_ext=w)[0] for w in (f, 0 * f))
    np.testing.assert_allclose(with_f - without, -np.einsum("kij,i->jk", columns, f), rtol=0, atol=1e-12)
    tau = dynamics.inverse_dynamics(robot, q, qd, qdd, f_ext=f)
    np.testing.assert_allclose(dynamics.forward_dynamics(robot, q, qd, tau, f_ext=f), qdd, rtol=0, atol=1e-11)
    by_q, _, inverse = dynamics.forward_dynamics_derivatives(robot, q, qd, tau, f_ext=f)
    np.testing.assert_allclose(by_q, -inverse @ with_f, rtol=0, atol=1e-9 * np.abs(by_q).max())


@pytest.mark.parametrize("seed", [1, 2])
def test_energy_and_mass_matrix_over_time(seed: int) -> None:
    """The rate of change of energy is the power of the torques; dM/dt = C + C^T."""
    robot, h = random_robot(seed, 5), 1e-5
    q, qd, tau = np.random.default_rng(seed).normal(size=(3, 5))
    qdd = dynamics.forward_dynamics(robot, q, qd, tau)
    times = np.array([[-h], [h]])
    path = q + qd * times + qdd * times**2 / 2, qd + qdd * times
    power = np.diff(np.add(*dynamics.energy(robot, *path)))[0] / (2 * h)
    np.testing.assert_allclose(power, qd @ tau, rtol=0, atol=1e-6 * np.abs(qd * tau).max())
    C = dynamics.coriolis_matrix(robot, q, qd)
    rate = np.diff(dynamics.mass_matrix(robot, q + qd * times), axis=0)[0] / (2 * h)
    np.testing.assert_allclose(rate, C + C.T, rtol=0, atol=1e-6 * np.abs(C).max())


def test_gears_keep_the_power() -> None:
    """With q = G q_m the motors feel G^T tau and the mass matrix G^T M G."""
    robot = random_robot(7, 4)
    G = robot.coupling
    q, qd, motor_acceleration = np.random.default_rng(0).normal(size=(3, 4))
    qdd = couplings.motor_to_joint(robot, motor_acceleration)
    motor = couplings.joint_torque_to_motor(robot, dynamics.inverse_dynamics(robot, q, qd, qdd))
    rest = couplings.joint_torque_to_motor(robot, dynamics.coriolis(robot, q, qd) + dynamics.gravity(robot, q))
    np.testing.assert_allclose(
        motor - rest, G.T @ dynamics.mass_matrix(robot, q) @ G @ motor_acceleration, rtol=0, atol=1e-11
    )


CALLS = {
    "inverse_dynamics": 3, "inverse_dynamics_derivatives": 3, "forward_dynamics": 3,
    "forward_dynamics_derivatives": 3, "gravity": 1, "mass_matrix": 1, "coriolis": 2, "coriolis_matrix": 2, "energy": 2,
    "regressor": 3,
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_a_batch_is_a_loop_and_leading_axes_broadcast(name: str) -> None:
    """Bit-identical, also when writing into existing arrays."""
    robot, function = random_robot(11, 4), getattr(dynamics, name)
    rng = np.random.default_rng(0)
    motion = [rng.normal(size=shape) for shape in ((3, 1, 4), (7, 4), (4,))][: CALLS[name]]
    batch = function(robot, *motion)
    rows = np.broadcast_arrays(*motion)
    results = batch if isinstance(batch, tuple) else (batch,)
    out = tuple(np.full_like(result, np.nan) for result in results)
    function(robot, *motion, out=out if isinstance(batch, tuple) else out[0])
    for k in np.ndindex(rows[0].shape[:-1]):
        one = function(robot, *(row[k] for row in rows))
        for whole, into, single in zip(results, out, one if isinstance(one, tuple) else (one,), strict=True):
            np.testing.assert_array_equal(whole[k], single)
            np.testing.assert_array_equal(into[k], single)
    missing = function(robot, *(np.where(np.arange(4) == 0, np.nan, row[0]) for row in rows))
    assert all(np.isnan(result).any() for result in (missing if isinstance(missing, tuple) else (missing,)))


def test_base_regressor(truth) -> None:
    robot, rng = truth.robot, np.random.default_rng(1)
    base = dynamics.base_parameters(robot)
    assert isinstance(base, dynamics.BaseParameters)
    q, qd, qdd = rng.normal(size=(3, 5, robot.n))
    Y = dynamics.base_regressor(robot, q, qd, qdd, base)
    np.testing.assert_array_equal(dynamics.base_regressor(robot, q, qd, qdd, base, out=np.empty_like(Y)), Y)
    pi = np.concatenate([truth.links.ravel(), truth.rotor])
    expected = robot.chain.rnea(q, qd, qdd, robot.gravity, truth.links) + truth.rotor * qdd
    np.testing.assert_allclose(Y @ (base.B @ pi) + base.D @ pi, expected, rtol=0, atol=1e-6)
    with pytest.raises(ShapeError, match="base parameters for 7 joints"):
        dynamics.base_regressor(robot, q, qd, qdd, dynamics.base_parameters(random_robot(1, 2)))


def test_an_identified_model(model: TorqueModel, truth) -> None:
    """All terms linear in the base parameters: rotors are included, friction is not."""
    q, qd, qdd = np.random.default_rng(2).normal(size=(3, 6, model.n))
    tau = dynamics.inverse_dynamics(model, q, qd, qdd)
    np.testing.assert_allclose(tau, model.rigid_torque(q, qd, qdd), rtol=0, atol=1e-12 * np.abs(tau).max())
    np.testing.assert_allclose(dynamics.gravity(model, q), model.rigid_torque(q, 0 * q, 0 * q), rtol=0, atol=1e-12)
    M = dynamics.mass_matrix(model, q)
    moved = tau - dynamics.coriolis(model, q, qd) - dynamics.gravity(model, q)
    np.testing.assert_allclose(np.einsum("kij,kj->ki", M, qdd), moved, rtol=0, atol=1e-11)
    kinetic, potential = dynamics.energy(model, q, qd)
    np.testing.assert_allclose(kinetic, 0.5 * np.einsum("ki,kij,kj->k", qd, M, qd), rtol=1e-12)
    same = replace(truth.robot, inertias=truth.links)
    height = dynamics.energy(same, q, qd)[1] - dynamics.energy(same, 0 * q[0], qd[0])[1]
    np.testing.assert_allclose(potential, height, rtol=0, atol=0.02 * np.ptp(height))


def test_what_a_model_does_not_know(model: TorqueModel) -> None:
    q, still = np.full(model.n, 0.3), replace(model, quasi_static=True)
    np.testing.assert_allclose(dynamics.gravity(still, q), still.rigid_torque(q, 0 * q, 0 * q), rtol=0, atol=1e-6)
    with pytest.raises(ModelMismatchError, match="without inertias"):
        dynamics.mass_matrix(still, q)
    rms = np.where(np.arange(model.n) == 2, np.nan, model.quality.rms)
    with pytest.raises(ModelMismatchError, match="torque of joint 3"):
        dynamics.gravity(replace(model, quality=replace(model.quality, rms=rms)), q)
    for function in (dynamics.regressor, dynamics.base_regressor):
        with pytest.raises(RobotError, match="Expected a Robot"):
            function(model, q, q, q, *[None] * (function is dynamics.base_regressor))  # type: ignore[arg-type]


def test_arguments() -> None:
    robot = random_robot(12, 3)
    q = np.zeros(3)
    with pytest.raises(RobotError, match="masses and inertias of robot 'random'"):
        dynamics.gravity(replace(robot, inertias=None), q)
    with pytest.raises(RobotError, match=r"robots.load\('ur5e'\)"):
        dynamics.mass_matrix("ur5e", q)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match=r"qd of shape \(\.\.\., 3\), got \(2,\)"):
        dynamics.coriolis(robot, q, np.zeros(2))
    with pytest.raises(ShapeError, match="f_ext of shape"):
        dynamics.inverse_dynamics(robot, q, q, q, f_ext=np.zeros(3))
    with pytest.raises(ShapeError, match=r"broadcast, got q of shape \(2, 3\), qd of shape \(4, 3\)"):
        dynamics.energy(robot, np.zeros((2, 3)), np.zeros((4, 3)))
    with pytest.raises(ShapeError, match="tuple of 3 arrays"):
        dynamics.forward_dynamics_derivatives(robot, q, q, q, out=np.zeros((3, 3)))  # type: ignore[arg-type]


def test_links_without_mass_have_no_accelerations() -> None:
    """A point mass on the last axis: the error names the sample; a NaN gives NaN and no error."""
    robot = random_robot(13, 3)
    bare = replace(robot, inertias=robot.inertias * [[1], [1], [0]], prismatic=[False] * 3)
    q = np.zeros((2, 3))
    q[0, 1] = np.nan
    with pytest.raises(RobotError, match=r"positive definite mass matrix, got another matrix at q\[1\]"):
        dynamics.forward_dynamics(bare, q, 0 * q[1], 0 * q[1])
    assert np.isnan(dynamics.forward_dynamics(robot, q[0], q[1], q[1])).all()
