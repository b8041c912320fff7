"""`SimulatedArm`: MuJoCo's rigid bodies, our drives and friction. `LaggingArm`: no masses. `record`: a log of an arm.

Leapfrog steps, positions and velocities half a step apart, keep the stiff friction springs stable::

    v_k = v_{k-1/2} + a_{k-1} h/2,   M a_k = tau - C v_k - G - F_f + J^T F,   v_{k+1/2} = v_{k-1/2} + a_k h,
    q_{k+1} = q_k + v_{k+1/2} h

A packet reports the beginning of the last step of its period: exactly a solution of the equation of motion, to which
the sensors add elastic gears (compliance c), delay d, noise, quantisation and gains g, see `Mismatch`::

    q   = g_q  round(q + c tau_link),         tau_link = tau - F_f - rotor qdd, what the gear carries
    tau = g_tau round(tau_{k-d} + noise)
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.errors import ConfigError, RobotError, ShapeError
from armlab.robots import Robot, inertia
from armlab.robots.build import from_dh
from armlab.sim.arm.joints import JointDrives, JointFriction, WornFriction
from armlab.sim.arm.mismatch import Mismatch, built_robot, built_truth, position_gain, torque_gain
from armlab.sim.arm.truth import Truth

if TYPE_CHECKING:
    from armlab.identify import Trajectory
    from armlab.log import Table


@dataclass(frozen=True, slots=True, eq=False)
class TrueState:
    """The exact state at one instant. Over the wire goes only what drives know of themselves: command, `tau_gravity`.

    `q`, `qd`, `qdd`: (n,) position, velocity, acceleration. `tau`: (n,) torque of the drives, joint side.
    `tau_friction`: (n,) friction and ripple, counted against motion. `tau_gravity`: (n,) what the drives feed forward.
    `q_ref`: (n,) reference of the drives. `wrench`: (6,) by the environment on the robot, base axes, at the tool point.
    `T_base_tool`: (4, 4) pose of the tool.
    """

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray
    tau_friction: np.ndarray
    tau_gravity: np.ndarray
    q_ref: np.ndarray
    wrench: np.ndarray
    T_base_tool: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class SensorReading:
    """What the sensors report of one instant, noise and quantisation included: position, velocity, torque (n,)."""

    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray


class Sensors:
    """Sensors of all joints."""

    def __init__(self, truth: Truth, mismatch: Mismatch, period: float, seed: int | Sequence[int]) -> None:
        n = len(truth.pi)
        self._truth, self._period = truth, period
        self._noise = np.random.default_rng(seed)
        self._torques: deque[np.ndarray] = deque(maxlen=int(mismatch.torque_delay) + 1)
        self._compliance = mismatch.elasticity / truth.tau_max
        self._stretch = self._stretching = np.zeros(n)
        self._gains = position_gain(mismatch, n), torque_gain(mismatch, n)
        self._sample: TrueState | None = None

    def reset(self) -> None:
        """Forget what was seen."""
        self._torques.clear()
        self._sample = None

    def see(self, sample: TrueState) -> None:
        """Receive the exact state of one instant; call once per instant, in order."""
        self._torques.append(sample.tau)
        carried = sample.tau - sample.tau_friction - self._truth.rotor * sample.qdd
        before, self._stretch = self._stretch, self._compliance * carried
        self._stretching = 0.0 * before if self._sample is None else (self._stretch - before) / self._period
        self._sample = sample

    def measure(self) -> SensorReading:
        """Return what the sensors report of the last instant, with fresh noise."""
        sample, truth = self._sample, self._truth
        if sample is None:
            raise ConfigError("Expected an instant to measure, got none. Call see first.")
        noise = self._noise.standard_normal((2, len(truth.pi)))
        q = _quantise(sample.q + self._stretch, truth.q_step)
        qd = sample.qd + self._stretching + truth.qd_noise * noise[0]
        tau = _quantise(self._torques[0] + truth.tau_noise * noise[1], truth.tau_step)
        of_position, of_torque = self._gains
        return SensorReading(q=of_position * q, qd=of_position * qd, tau=of_torque * tau)


def _quantise(value: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Round to multiples of `step`; a step of zero leaves the value."""
    return np.where(step > 0, np.rint(value / np.where(step > 0, step, 1.0)) * step, value)


LONGEST_STEP = 1.05e-3  # s


class SimulatedArm:
    """One simulated arm.

    Parameters
    ----------
    robot : the description; its frames, gravity and home posture are used.
    truth : the synthetic parameters.
    period : time between two packets [s].
    q : (n,) posture to start from; the robot's home by default.
    seed : of the measurement noise.
    mismatch : how the arm differs from description and truth; not at all by default.

    Attributes
    ----------
    robot : the description.
    built : the arm that moves.
    truth : its parameters, mismatch included.
    sample : the exact state at the last instant.
    has_torque : True.

    Raises
    ------
    ShapeError : when truth or posture have another number of joints.
    ConfigError : when the period is not between 0.1 ms and 1 s.
    """

    has_torque = True

    def __init__(
        self,
        robot: Robot,
        truth: Truth,
        *,
        period: float = 0.004032,
        q: np.ndarray | None = None,
        seed: int | Sequence[int] = 0,
        mismatch: Mismatch | None = None,
    ) -> None:
        if not 1e-4 <= period <= 1.0:
            raise ConfigError(f"Expected a period between 0.0001 s and 1 s, got {period} s.")
        if not isinstance(robot, Robot):
            raise RobotError.no_robot(robot)
        if len(truth.pi) != robot.n:
            raise ShapeError(f"Expected a truth for {robot.n} joints of robot {robot.name!r}, got {len(truth.pi)}.")
        self.mismatch = mismatch = mismatch or Mismatch()
        self.robot, self.built, self.period = robot, built_robot(mismatch, robot), period
        self.truth = truth = built_truth(mismatch, truth, self.built)
        self.steps = math.ceil(period / LONGEST_STEP - 1e-9)
        self.step_time = period / self.steps
        mujoco: Any = import_module("mujoco")  # its bindings have no types
        self._mj = mujoco
        self._model = build_model(self.built, truth)
        self._data = mujoco.MjData(self._model)
        data = self._data  # the next five are views: no copies between the physics and us
        self._q, self._qd, self._bias = data.qpos, data.qvel, data.qfrc_bias
        self._applied, self._smooth = data.qfrc_applied, data.qacc_smooth
        self._tool = data.site_xpos[0], data.site_xmat[0].reshape(3, 3)
        self._half = np.zeros(robot.n)  # velocity half a step ago
        self._qdd = np.zeros(robot.n)
        self._dq, self._tau, self._tau_friction, self._load = np.zeros((4, robot.n))
        self._sensors = Sensors(truth, mismatch, period, seed)
        worn = mismatch.warm_up or mismatch.load_friction or mismatch.ripple_jump or mismatch.offset_drift
        self.friction = WornFriction(truth, mismatch, self.step_time, self._load) if worn else JointFriction(truth)
        self.drive = JointDrives(self._inertia(robot.q_home), truth.tau_max, truth.feedforward, self.step_time)
        self.sample: TrueState
        self.place(robot.q_home if q is None else q)

    def place(self, q: np.ndarray) -> None:
        """Put the arm at rest at `q`, held there by the drives alone.

        Parameters
        ----------
        q : (n,) posture.

        Raises
        ------
        ShapeError : when the shape is wrong or a value is not finite.
        """
        q = np.array(q, dtype=np.float64)
        if q.shape != (self.robot.n,) or not np.isfinite(q).all():
            raise ShapeError(f"Expected a finite posture of shape ({self.robot.n},), got shape {q.shape}.")
        self._q[:], self._qd[:], self._half[:], self._qdd[:] = q, 0.0, 0.0, 0.0
        self._mj.mj_forward(self._model, self._data)
        self.friction.reset()
        holding = self.friction.torque(self._q, self._qd, np.empty_like(q)) + self._data.qfrc_bias
        self.drive.reset(holding, self._data.qfrc_bias)
        self._q_ref, self._qd_ref = q, np.zeros_like(q)
        self._sensors.reset()
        self.step(q, self._qd_ref, None)

    def _inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the diagonal (n,) of the mass matrix at `q`, rotors included [kg m^2]."""
        data, column = self._mj.MjData(self._model), np.empty(self.robot.n)
        data.qpos[:] = q
        self._mj.mj_forward(self._model, data)
        diagonal = np.empty(self.robot.n)
        for i, unit in enumerate(np.eye(self.robot.n)):
            self._mj.mj_mulM(self._model, data, column, unit)
            diagonal[i] = column[i]
        return diagonal

    def step(self, q_ref: np.ndarray, qd_ref: np.ndarray, wrench: np.ndarray | None) -> None:
        """Advance by one period while the reference moves evenly from its last value to this one.

        Parameters
        ----------
        q_ref, qd_ref : (n,) reference of the drives at the end of the period.
        wrench : (6,) by the environment on the robot, base axes, at the tool point; None for no contact.
        """
        steps, share = self.steps, 1.0 / self.steps
        q, qd, dq = self._q_ref.copy(), self._qd_ref.copy(), (q_ref - self._q_ref) * share
        dqd = (qd_ref - self._qd_ref) * share
        qdd = dqd * (1.0 / self.step_time)
        for _ in range(steps - 1):
            self._advance(q, qd, qdd, wrench)
            self._move()
            q += dq
            qd += dqd
        self._advance(q, qd, qdd, wrench)
        self.sample = self._report(q, wrench)
        self._sensors.see(self.sample)
        self._move()
        self._q_ref, self._qd_ref = q_ref.copy(), qd_ref.copy()

    def measure(self) -> SensorReading:
        """Return what the sensors report of the sampled instant, with fresh noise."""
        return self._sensors.measure()

    def _advance(self, q_ref: np.ndarray, qd_ref: np.ndarray, qdd_ref: np.ndarray, wrench: np.ndarray | None) -> None:
        """Evaluate torques and accelerations at this instant."""
        mj, model, data, half = self._mj, self._model, self._data, self.step_time / 2
        np.multiply(self._qdd, half, out=self._qd)
        self._qd += self._half
        mj.mj_fwdPosition(model, data)
        mj.mj_fwdVelocity(model, data)
        self.drive.torque(q_ref, qd_ref, qdd_ref, self._q, self._qd, self._bias, self._tau)
        self.friction.torque(self._q, self._qd, self._tau_friction)
        np.subtract(self._tau, self._tau_friction, out=self._applied)
        if wrench is not None:
            mj.mj_applyFT(model, data, wrench[:3], wrench[3:], self._tool[0], self.robot.n, self._applied)
        mj.mj_fwdAcceleration(model, data)
        self._qdd[:] = self._smooth
        np.subtract(self._tau, self._tau_friction, out=self._load)
        self._load -= self.truth.rotor * self._qdd

    def _move(self) -> None:
        """Carry velocity and position over one step."""
        np.multiply(self._qdd, self.step_time, out=self._dq)
        self._half += self._dq
        np.multiply(self._half, self.step_time, out=self._dq)
        self._q += self._dq
        self.friction.advance(self._dq, self._half)

    def _report(self, q_ref: np.ndarray, wrench: np.ndarray | None) -> TrueState:
        T_base_tool = np.eye(4)
        T_base_tool[:3, :3], T_base_tool[:3, 3] = self._tool[1], self._tool[0]
        return TrueState(
            q=self._q.copy(),
            qd=self._qd.copy(),
            qdd=self._qdd.copy(),
            tau=self._tau.copy(),
            tau_friction=self._tau_friction.copy(),
            tau_gravity=self.drive.gravity.copy(),
            q_ref=q_ref,
            wrench=np.zeros(6) if wrench is None else np.array(wrench),
            T_base_tool=T_base_tool,
        )


def build_model(robot: Robot, truth: Truth) -> Any:
    """Return MuJoCo's model of the arm: one body per link frame, no contacts, no limits, one site at the tool point."""
    mujoco: Any = import_module("mujoco")

    def pose(T: np.ndarray) -> dict[str, np.ndarray]:
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(T[:3, :3]).ravel())
        return {"pos": T[:3, 3], "quat": quat}

    spec = mujoco.MjSpec()
    off = mujoco.mjtDisableBit
    spec.option.disableflags = int(off.mjDSBL_CONTACT | off.mjDSBL_CONSTRAINT | off.mjDSBL_LIMIT | off.mjDSBL_SENSOR)
    spec.option.gravity = robot.gravity
    body = spec.worldbody
    for i in range(robot.n):
        body = body.add_body(name=f"link_{i + 1}", **pose(robot.frames[i]))
        kind = mujoco.mjtJoint.mjJNT_SLIDE if robot.prismatic[i] else mujoco.mjtJoint.mjJNT_HINGE
        body.add_joint(name=robot.joint_names[i], type=kind, axis=[0, 0, 1], armature=truth.rotor[i])
        mass, centre, about = inertia.to_body(truth.pi[i])
        body.mass, body.ipos, body.explicitinertial = mass, centre, True
        body.fullinertia = about[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]  # xx yy zz xy xz yz
    body.add_site(name="tool", **pose(robot.frames[-1]))
    return spec.compile()


_DEAD_CYCLES = 2
_LAG = 8e-3  # s


class LaggingArm:
    """The kinematic stand-in of `SimulatedArm`: same reports, no torques (NaN), no noise; nobody can push it.

    It follows late, ``q += (1 - exp(-T / 8 ms)) (q_ref[k - 2] - q)``: within ABB's 10 to 20 ms.
    """

    has_torque = False

    def __init__(self, robot: Robot, period: float = 0.004032, q: np.ndarray | None = None) -> None:
        self.robot, self.period = robot, period
        self._share = 1.0 - math.exp(-period / _LAG)
        self._unknown = np.full(robot.n, np.nan)
        self._unknown.setflags(write=False)
        self._calm = np.zeros(6)
        self.place(robot.q_home if q is None else q)

    def place(self, q: np.ndarray) -> None:
        """Put the arm at rest at `q` (n,)."""
        self._q = np.array(q, dtype=np.float64)
        self._under_way = deque([self._q] * _DEAD_CYCLES)
        self._report(np.zeros_like(self._q), self._q)

    def step(self, q_ref: np.ndarray, qd_ref: np.ndarray, wrench: np.ndarray | None) -> None:
        """Advance by one period towards a reference (n,)."""
        self._under_way.append(np.array(q_ref))
        moved = self._share * (self._under_way.popleft() - self._q)
        self._q = self._q + moved
        self._report(moved / self.period, q_ref)

    def measure(self) -> SensorReading:
        """Return position and velocity; the torque is NaN."""
        return SensorReading(self._q, self.sample.qd, self._unknown)

    def _report(self, qd: np.ndarray, q_ref: np.ndarray) -> None:
        T_base_tool, none = self.robot.chain.forward(self._q), self._unknown
        self.sample = TrueState(self._q, qd, none, none, none, none, q_ref, self._calm, T_base_tool)


def record(
    arm: SimulatedArm, motion: Trajectory, wrench: Callable[[np.ndarray], np.ndarray] | None = None, seed: int = 0
) -> Table:
    """Run a motion and return what the sensors report: t, q, qd, tau, and wrench_true where there is one.

    Parameters
    ----------
    arm : is placed at the start of the motion; its noise goes on from where it was.
    motion : reference of the drives.
    wrench : gives the wrench (N, 6) by the environment on the robot, base axes, at the tool point, at times (N,).
    seed : of jitter and loss of time stamps.

    Raises
    ------
    ConfigError : a jitter of half a period or more, which would turn time back.
    ShapeError : a motion of another number of joints, or a wrench of another shape.
    """
    from armlab.log import Table  # here: a simulator that only sends starts without it

    knobs, period, n = arm.mismatch, arm.period, arm.robot.n
    if not knobs.jitter < period / 2:
        raise ConfigError(f"Expected a jitter below half a period of {period} s, got {knobs.jitter} s.")
    count = int(motion.seconds / period)
    t = period * np.arange(1, count + 1)
    q_ref, qd_ref, _ = motion.sample(t)
    if q_ref.shape != (count, n):
        raise ShapeError(f"Expected a motion of {n} joints of {arm.robot.name!r}, got shape {q_ref.shape[1:]}.")
    pushes = np.zeros((count, 6)) if wrench is None else np.asarray(wrench(t), dtype=float)
    if pushes.shape != (count, 6):
        raise ShapeError(f"Expected a wrench of shape ({count}, 6) for {count} times, got {pushes.shape}.")
    arm.place(motion.q_first)
    seen = np.empty((3, count, n))
    for k in range(count):
        arm.step(q_ref[k], qd_ref[k], None if wrench is None else pushes[k])
        measured = arm.measure()
        seen[:, k] = measured.q, measured.qd, measured.tau
    values = dict(zip(("q", "qd", "tau"), seen)) | ({} if wrench is None else {"wrench_true": pushes})
    rng = np.random.default_rng([knobs.seed, seed])
    stamps = t + knobs.jitter * rng.uniform(-1.0, 1.0, count)
    return Table(stamps, values).rows(rng.uniform(size=count) >= knobs.lost)


def scara() -> Robot:
    """Return the robot. Its numbers are round ones; no manufacturer builds it."""
    return from_dh(
        "scara",
        alpha=[0.0, 3.141592653589793, 0.0, 0.0],
        a=[0.3, 0.25, 0.0, 0.0],
        d=[0.2, 0.0, 0.0, 0.05],
        prismatic=[False, False, True, False],
        q_min=[-2.4, -2.6, 0.0, -6.9],
        q_max=[2.4, 2.6, 0.18, 6.9],
        qd_max=[6.0, 6.0, 1.0, 20.0],
        q_home=[0.2, 0.4, 0.09, 0.0],
        source="invented; axes as of ABB's four-axis robots",
    )
