"""What the sensors of a simulated arm report of an instant: elastic gears, delay, noise, quantisation, conversion.

    q   = g_q  round(q + c tau_link),         tau_link = tau - F_f - rotor qdd, what the gear carries
    tau = g_tau round(tau_{k-d} + noise)

With no `Mismatch` the compliance c and the delay d are zero and the gains g are one: nothing but noise and steps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlab.errors import ConfigError
from armlab.sim.arm.mismatch import Mismatch, position_gain, torque_gain
from armlab.sim.arm.truth import Truth


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
    """What the sensors report of one instant: noise and quantisation included.

    `q`, `qd`, `tau`: (n,) position, velocity, torque.
    """

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
        self._compliance = mismatch.elasticity / truth.tau_max if mismatch.elasticity else None
        self._stretch = self._stretching = np.zeros(n)
        gains = position_gain(mismatch, n), torque_gain(mismatch, n)
        self._gains = None if np.all(np.stack(gains) == 1.0) else gains
        self._sample: TrueState | None = None

    def reset(self) -> None:
        """Forget what was seen."""
        self._torques.clear()
        self._sample = None

    def see(self, sample: TrueState) -> None:
        """Receive the exact state of one instant; call once per instant, in order."""
        self._torques.append(sample.tau)
        if self._compliance is not None:
            carried = sample.tau - sample.tau_friction - self._truth.rotor * sample.qdd
            before, self._stretch = self._stretch, self._compliance * carried
            self._stretching = (
                np.zeros_like(before) if self._sample is None else (self._stretch - before) / self._period
            )
        self._sample = sample

    def measure(self) -> SensorReading:
        """Return what the sensors report of the last instant, with fresh noise."""
        sample, truth = self._sample, self._truth
        if sample is None:
            raise ConfigError("Expected an instant to measure, got none. Call see first.")
        noise = self._noise.standard_normal((2, len(truth.pi)))
        q, qd = sample.q, sample.qd
        if self._compliance is not None:
            q, qd = q + self._stretch, qd + self._stretching
        q = _quantise(q, truth.q_step)
        qd = qd + truth.qd_noise * noise[0]
        tau = _quantise(self._torques[0] + truth.tau_noise * noise[1], truth.tau_step)
        if self._gains is None:
            return SensorReading(q=q, qd=qd, tau=tau)
        of_position, of_torque = self._gains
        return SensorReading(q=of_position * q, qd=of_position * qd, tau=of_torque * tau)


def _quantise(value: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Round to multiples of `step`; a step of zero leaves the value."""
    if not step.all():
        return np.where(step > 0, np.rint(value / np.where(step > 0, step, 1.0)) * step, value)
    return np.rint(value / step) * step
