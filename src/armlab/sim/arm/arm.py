"""`SimulatedArm`: rigid bodies, drives and friction. `LaggingArm`: kinematic only. `record`: log of a motion.

Leapfrog steps, with positions and velocities half a step apart, keep the stiff friction springs stable::

    v_k = v_{k-1/2} + a_{k-1} h/2,   M a_k = tau - C v_k - G - F_f + J^T F,   v_{k+1/2} = v_{k-1/2} + a_k h,
    q_{k+1} = q_k + v_{k+1/2} h

A packet reports the state at the start of the last step of its period; this state satisfies the equation of motion
exactly. The sensors add elastic gears (compliance c), delay d, noise, quantisation and gains g (see `Mismatch`)::

    q   = g_q  round(q + c tau_link),         tau_link = tau - F_f - rotor qdd, torque through the gear
    tau = g_tau round(tau_{k-d} + noise)

Parameter values: docs/theory/simulated_arm.md.

The drive is a position loop around a velocity loop with integral action. Both loops run for each joint at every physics
step h, with the nominal inertia J at the home posture. The research extension scales both gains (default 1) and adds a
torque (default 0)::

    e   = gain_qd (v_ref - v) + gain_q POSITION_GAIN (q_ref - q),   I += gain_q h e / INTEGRAL_TIME
    tau = J (gain_qd a_ref + VELOCITY_GAIN (e + gain_q I)) + feedforward (C v + G) + tau_added,   |tau| <= tau_max

Integration stops while the torque is saturated. The drive receives position and velocity without quantisation or noise.

Friction (LuGre): between reversals, the bristle force f relaxes with distance. For constant v within a step, the exact
solution is ``f' = s g + (f - s g) exp(-(c / delta) |dq| / g)`` with ``g = c (1 + (ratio - 1) exp(-(v / vs)^2))``, s the
sign of v, and c the Coulomb friction in that direction. The friction torque also contains ``viscous v + offset +
ripple sin(cycles q + phase)``.

`WornFriction` also depends on temperature, load and time, each controlled by a parameter of `Mismatch`::

    viscous  (1 - warm_up x),             dx/dt = (|F_f qd| / P - x) / 12 min,    P the power at a quarter of full speed
    c        + k |tau_link|,              tau_link = tau - F_f - rotor qdd, 0 <= k < load_friction of each joint
    offset   + a sin(w t) + b cos(w t),   |a|, |b| < offset_drift tau_max, w = 2 pi / 100 s
    phase  + ripple_jump (1 - s) / 2,     s the bristle force over Coulomb friction: from 1 forward to -1 backward
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from armlab.errors import ConfigError, RobotError, ShapeError
from armlab.kernels import RigidBody
from armlab.robots import Robot
from armlab.robots.build import from_dh
from armlab.sim.arm.mismatch import Mismatch, built_robot, built_truth, draw, load_share, position_gain, torque_gain
from armlab.sim.arm.truth import Truth

if TYPE_CHECKING:
    from armlab.identify import Trajectory
    from armlab.log import Table


POSITION_GAIN = 25.0  # 1/s
VELOCITY_GAIN = 150.0  # 1/s
INTEGRAL_TIME = 0.05  # s


class JointDrives:
    """Drives of all joints.

    `inertia`: (n,) inertia of the joints including the rotors [kg m^2]. `feedforward`: (n,) share of gravity and
    Coriolis torques fed forward. `step`: time between calls [s].
    """

    gravity: np.ndarray
    saturated: int

    def __init__(self, inertia: np.ndarray, tau_max: np.ndarray, feedforward: np.ndarray, step: float) -> None:
        self._inertia, self._feedforward = inertia, feedforward
        self._tau_max, self._tau_min = tau_max, -tau_max
        self._gain = inertia * VELOCITY_GAIN
        self._rate = step / INTEGRAL_TIME
        self._integral, self.gravity = np.zeros((2, len(inertia)))
        self.saturated = 0
        self.assist(np.zeros_like(inertia), np.ones_like(inertia), np.ones_like(inertia))

    def assist(self, tau: np.ndarray, gain_q: np.ndarray, gain_qd: np.ndarray) -> None:
        """Set the added torque (n,) [N m] and the factors (n,) on the position and velocity gains."""
        self._added = (tau, gain_q, gain_qd)

    def reset(self, holding: np.ndarray, bias: np.ndarray) -> None:
        """Start the integral at the torque `holding` that keeps the arm at rest; `bias` is the gravity torque [N m]."""
        self._integral[:] = (holding - self._feedforward * bias) / self._gain

    def torque(
        self,
        q_ref: np.ndarray,
        qd_ref: np.ndarray,
        qdd_ref: np.ndarray,
        q: np.ndarray,
        qd: np.ndarray,
        bias: np.ndarray,
        out: np.ndarray,
    ) -> np.ndarray:
        """Write the torque of this step [N m] to `out` and return it; a fraction of the true `bias` is fed forward."""
        tau, gain_q, gain_qd = self._added
        error = gain_q * (POSITION_GAIN * (q_ref - q)) + gain_qd * qd_ref - gain_qd * qd
        growth = error * (self._rate * gain_q)
        self._integral += growth
        self.gravity[:] = self._feedforward * bias
        wanted = self._gain * (error + gain_q * self._integral) + gain_qd * self._inertia * qdd_ref + tau + self.gravity
        np.maximum(np.minimum(wanted, self._tau_max), self._tau_min, out=out)
        beyond = out != wanted
        if beyond.any():
            self._integral[beyond] -= growth[beyond]
            self.saturated += 1
        return out


class JointFriction:
    """Friction state of all joints."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        n = len(truth.viscous)
        self.bristle: np.ndarray = np.zeros(n)
        self._excess = truth.static_ratio - 1.0
        self._rate = -1.0 / truth.delta
        self._speed_scale = 1.0 / truth.stribeck_speed
        self._mean = 0.5 * (truth.coulomb_pos + truth.coulomb_neg)
        self._skew = 0.5 * (truth.coulomb_pos - truth.coulomb_neg)
        self._viscous, self._phase, self._offset = truth.viscous, truth.ripple_phase, truth.offset

    def reset(self) -> None:
        """Unload the bristles."""
        self.bristle[:] = 0.0

    def advance(self, dq: np.ndarray, qd: np.ndarray) -> None:
        """Advance the bristles by `dq` [rad] at velocity `qd` [rad/s]."""
        ratio = 1.0 + self._excess * np.exp(-np.square(qd * self._speed_scale))
        sign = np.sign(dq)
        # s c = mean s + skew for both signs, because c_pos = mean + skew and c_neg = mean - skew
        sliding = (self._mean * sign + self._skew) * ratio
        self.bristle[:] = (self.bristle - sliding) * np.exp(dq * sign * self._rate / ratio) + sliding

    def torque(self, q: np.ndarray, qd: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Write the friction torque opposing motion [N m], including ripple, to `out` and return it."""
        truth = self._truth
        ripple = truth.ripple * np.sin(q * truth.ripple_cycles + self._phase)
        out[:] = qd * self._viscous + self.bristle + self._offset + ripple
        return out


WARM_TIME = 720.0  # s
DRIFT = 2.0 * np.pi / 100.0  # rad/s, frequency of the offset drift
WARM_SPEED = 0.25  # fraction of the speed limit at which friction warms the drive to state x = 1


class WornFriction(JointFriction):
    """Friction that also depends on temperature, load and time; `load` (n,) [N m] is read at every step."""

    warmth: np.ndarray

    def __init__(self, truth: Truth, mismatch: Mismatch, step: float, load: np.ndarray) -> None:
        super().__init__(truth)
        self._mismatch, self._step, self._load = mismatch, step, load
        self._cold = self._mean.copy()
        coulomb = np.where(self._mean > 0, self._mean, 1.0)
        speed = np.divide(coulomb, truth.viscous, out=np.full_like(coulomb, np.inf), where=truth.viscous > 0)
        self._full = coulomb
        self._power = WARM_SPEED * (1.0 + WARM_SPEED) * coulomb * speed
        self.warmth = np.zeros_like(coulomb)
        self._of_load = load_share(mismatch, len(coulomb))
        self._swing, self._time = draw(mismatch, "offset_drift", 2, len(coulomb)) * truth.tau_max, 0.0

    def advance(self, dq: np.ndarray, qd: np.ndarray) -> None:
        """Advance the bristles by `dq` [rad] at velocity `qd` [rad/s] and warm the drives."""
        self._mean = self._cold + self._of_load * np.abs(self._load)
        self._time += self._step
        angle = DRIFT * self._time
        self._offset = self._truth.offset + np.sin(angle) * self._swing[0] + np.cos(angle) * self._swing[1]
        super().advance(dq, qd)
        heat = np.abs((self.bristle + self._viscous * qd) * qd) / self._power
        self.warmth += self._step / WARM_TIME * (heat - self.warmth)
        self._viscous = self._truth.viscous * (1.0 - self._mismatch.warm_up * np.minimum(self.warmth, 1.0))
        forward = np.clip(self.bristle / self._full, -1.0, 1.0)
        self._phase = self._truth.ripple_phase + self._mismatch.ripple_jump * 0.5 * (1.0 - forward)


@dataclass(frozen=True, slots=True, eq=False)
class TrueState:
    """Exact state at one instant. Packets contain only the drives' torque command and `tau_gravity`.

    `q`, `qd`, `qdd`: (n,) position, velocity, acceleration. `tau`: (n,) drive torque, joint side [N m]. `tau_friction`:
    (n,) friction and ripple, opposing motion. `tau_gravity`: (n,) feedforward of the drives. `q_ref`: (n,) reference of
    the drives. `wrench`: (6,) wrench exerted by the environment, base axes, at the tool point.
    `T_base_tool`: (4, 4).
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
    """Readings of the joint sensors at one instant, with noise and quantisation; each array is (n,)."""

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
        """Clear the history."""
        self._torques.clear()
        self._sample = None

    def see(self, sample: TrueState) -> None:
        """Store the exact state of the next instant."""
        self._torques.append(sample.tau)
        carried = sample.tau - sample.tau_friction - self._truth.rotor * sample.qdd
        before, self._stretch = self._stretch, self._compliance * carried
        self._stretching = 0.0 * before if self._sample is None else (self._stretch - before) / self._period
        self._sample = sample

    def measure(self) -> SensorReading:
        """Return the readings of the latest instant, with newly drawn noise."""
        sample, truth = self._sample, self._truth
        if sample is None:
            raise ConfigError("Expected a state to measure, got none. Call see() first.")
        noise = self._noise.standard_normal((2, len(truth.pi)))
        q = _quantise(sample.q + self._stretch, truth.q_step)
        qd = sample.qd + self._stretching + truth.qd_noise * noise[0]
        tau = _quantise(self._torques[0] + truth.tau_noise * noise[1], truth.tau_step)
        of_position, of_torque = self._gains
        return SensorReading(q=of_position * q, qd=of_position * qd, tau=of_torque * tau)


def _quantise(value: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Round to multiples of `step`; zero disables rounding."""
    return np.where(step > 0, np.rint(value / np.where(step > 0, step, 1.0)) * step, value)


LONGEST_STEP = 1.05e-3  # s


class SimulatedArm:
    """Simulated arm with rigid bodies, drives and friction.

    Parameters
    ----------
    robot : robot description; only its frames, gravity and home posture are used.
    truth : synthetic parameters.
    period : time between two packets [s].
    q : (n,) initial joint positions [rad or m]; default: the robot's home.
    seed : seed of the measurement noise.
    mismatch : differences between the arm and its description and truth; default: none.

    Attributes
    ----------
    robot : robot description.
    built : description of the simulated arm, including the mismatch.
    truth : parameters of the simulated arm, including the mismatch.
    sample : exact state at the latest instant.
    has_torque : True.

    Raises
    ------
    ShapeError : if `truth` or `q` has the wrong number of joints.
    ConfigError : if the period is not between 0.1 ms and 1 s.
    """

    mismatch: Mismatch
    robot: Robot
    built: Robot
    period: float
    truth: Truth

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
            raise ShapeError(
                f"Expected true parameters for the {robot.n} joints of robot {robot.name!r}, got true parameters for "
                f"{len(truth.pi)} joints."
            )
        self.mismatch = mismatch = mismatch or Mismatch()
        self.robot, self.built, self.period = robot, built_robot(mismatch, robot), period
        self.truth = truth = built_truth(mismatch, truth, self.built)
        self.steps: int = math.ceil(period / LONGEST_STEP - 1e-9)
        self.step_time: float = period / self.steps
        self._body = RigidBody(self.built.chain, robot.gravity, truth.pi, np.diag(truth.rotor))
        self._still = np.zeros(robot.n)
        self._q, self._qd, self._bias, self._applied = np.zeros((4, robot.n))
        self._half = np.zeros(robot.n)  # velocity, half a step earlier
        self._qdd = np.zeros(robot.n)
        self._dq, self._tau, self._tau_friction, self._load = np.zeros((4, robot.n))
        self._sensors = Sensors(truth, mismatch, period, seed)
        worn = mismatch.warm_up or mismatch.load_friction or mismatch.ripple_jump or mismatch.offset_drift
        self.friction: WornFriction | JointFriction = (
            WornFriction(truth, mismatch, self.step_time, self._load) if worn else JointFriction(truth)
        )
        J = np.diag(self._body.mass_matrix(robot.q_home)).copy()
        self.drive: JointDrives = JointDrives(J, truth.tau_max, truth.feedforward, self.step_time)
        self.sample: TrueState
        self.place(robot.q_home if q is None else q)

    def place(self, q: np.ndarray) -> None:
        """Place the arm at rest at `q`, held by the drives.

        Parameters
        ----------
        q : (n,) joint positions [rad or m].

        Raises
        ------
        ShapeError : if the shape is wrong or a value is not finite.
        """
        q = np.array(q, dtype=np.float64)
        if q.shape != (self.robot.n,) or not np.isfinite(q).all():
            raise ShapeError(f"Expected a finite posture of shape ({self.robot.n},), got {q.tolist()}.")
        self._q[:], self._qd[:], self._half[:], self._qdd[:] = q, 0.0, 0.0, 0.0
        self._body.rnea(self._q, self._qd, self._still, out=self._bias)
        self.friction.reset()
        holding = self.friction.torque(self._q, self._qd, np.empty_like(q)) + self._bias
        self.drive.reset(holding, self._bias)
        self._q_ref, self._qd_ref = q, np.zeros_like(q)
        self._sensors.reset()
        self.step(q, self._qd_ref, None)

    def step(self, q_ref: np.ndarray, qd_ref: np.ndarray, wrench: np.ndarray | None) -> None:
        """Advance by one period, in which the reference moves linearly to its new value.

        Parameters
        ----------
        q_ref, qd_ref : (n,) reference of the drives at the end of the period [rad or m, and per s].
        wrench : (6,) wrench exerted by the environment, base axes, at the tool point [N, N m]; None: no contact.
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
        """Return the sensor readings of the latest sample, with newly drawn noise."""
        return self._sensors.measure()

    def _advance(self, q_ref: np.ndarray, qd_ref: np.ndarray, qdd_ref: np.ndarray, wrench: np.ndarray | None) -> None:
        """Compute the torques and accelerations at this instant."""
        np.multiply(self._qdd, self.step_time / 2, out=self._qd)
        self._qd += self._half
        q, qd = self._q, self._qd
        self._body.rnea(q, qd, self._still, out=self._bias)
        self.drive.torque(q_ref, qd_ref, qdd_ref, q, qd, self._bias, self._tau)
        self.friction.torque(q, qd, self._tau_friction)
        np.subtract(self._tau, self._tau_friction, out=self._applied)
        self._body.forward_dynamics(q, qd, self._applied, wrench, out=self._qdd)  # NaN ends the run
        np.subtract(self._tau, self._tau_friction, out=self._load)
        self._load -= self.truth.rotor * self._qdd

    def _move(self) -> None:
        """Integrate velocity and position over one step."""
        np.multiply(self._qdd, self.step_time, out=self._dq)
        self._half += self._dq
        np.multiply(self._half, self.step_time, out=self._dq)
        self._q += self._dq
        self.friction.advance(self._dq, self._half)

    def _report(self, q_ref: np.ndarray, wrench: np.ndarray | None) -> TrueState:
        return TrueState(
            q=self._q.copy(),
            qd=self._qd.copy(),
            qdd=self._qdd.copy(),
            tau=self._tau.copy(),
            tau_friction=self._tau_friction.copy(),
            tau_gravity=self.drive.gravity.copy(),
            q_ref=q_ref,
            wrench=np.zeros(6) if wrench is None else np.array(wrench),
            T_base_tool=self.built.chain.forward(self._q),
        )


_DEAD_CYCLES = 2
_LAG = 8e-3  # s


class LaggingArm:
    """Kinematic stand-in for `SimulatedArm`: same interface, NaN torques, no noise, no response to wrenches.

    The arm follows ``q += (1 - exp(-T / 8 ms)) (q_ref[k - 2] - q)``, a lag within ABB's range of 10 to 20 ms.
    """

    robot: Robot
    period: float

    has_torque = False

    def __init__(self, robot: Robot, period: float = 0.004032, q: np.ndarray | None = None) -> None:
        self.robot, self.period = robot, period
        self._share = 1.0 - math.exp(-period / _LAG)
        self._unknown = np.full(robot.n, np.nan)
        self._unknown.setflags(write=False)
        self._calm = np.zeros(6)
        self.place(robot.q_home if q is None else q)

    def place(self, q: np.ndarray) -> None:
        """Place the arm at rest at `q` (n,)."""
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
        """Return position, velocity and NaN torques."""
        return SensorReading(self._q, self.sample.qd, self._unknown)

    def _report(self, qd: np.ndarray, q_ref: np.ndarray) -> None:
        T_base_tool, none = self.robot.chain.forward(self._q), self._unknown
        self.sample: TrueState = TrueState(self._q, qd, none, none, none, none, q_ref, self._calm, T_base_tool)


def record(
    arm: SimulatedArm, motion: Trajectory, wrench: Callable[[np.ndarray], np.ndarray] | None = None, seed: int = 0
) -> Table:
    """Run a motion and return the sensor log: t, q, qd, tau, and wrench_true if a wrench is given.

    Parameters
    ----------
    arm : the arm, which is placed at the start of the motion; its noise sequence continues.
    motion : reference of the drives.
    wrench : function of the times (N,) [s] that returns the wrenches (N, 6) exerted by the environment, base axes, at
        the tool point [N, N m].
    seed : seed for the time-stamp jitter and the lost samples.

    Raises
    ------
    ConfigError : if the jitter is half a period or more, which could reverse the order of the time stamps.
    ShapeError : if the motion has the wrong number of joints, or the wrench has the wrong shape.
    """
    from armlab.log import Table  # lazy import, because `armlab sim` does not need it

    mismatch, period, n = arm.mismatch, arm.period, arm.robot.n
    if not mismatch.jitter < period / 2:
        raise ConfigError(f"Expected a jitter below half a period of {period} s, got {mismatch.jitter} s.")
    count = int(motion.seconds / period)
    t = period * np.arange(1, count + 1)
    q_ref, qd_ref, _ = motion.sample(t)
    if q_ref.shape != (count, n):
        raise ShapeError(f"Expected a motion for the {n} joints of {arm.robot.name!r}, got shape {q_ref.shape[1:]}.")
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
    rng = np.random.default_rng([mismatch.seed, seed])
    stamps = t + mismatch.jitter * rng.uniform(-1.0, 1.0, count)
    return Table(stamps, values).rows(rng.uniform(size=count) >= mismatch.lost)


def scara() -> Robot:
    """Return a generic SCARA robot with rounded dimensions."""
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
        source="assumed; axes as in ABB's four-axis robots",
    )
