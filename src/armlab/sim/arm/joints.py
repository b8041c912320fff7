"""Joint drives and joint friction of the simulated arms; numbers and reasons: docs/theory/simulated_arm.md.

Drive: a position loop around a velocity loop with integral action. Per joint, at every physics step h, with the nominal
inertia J at the home posture; the research extension scales both gains (1 else) and adds a torque (0 else)::

    e   = gain_qd (v_ref - v) + gain_q POSITION_GAIN (q_ref - q),   I += gain_q h e / INTEGRAL_TIME
    tau = J (gain_qd a_ref + VELOCITY_GAIN (e + gain_q I)) + feedforward (C v + G) + tau_added,   |tau| <= tau_max

The integral stops growing while the torque is saturated. Position and velocity have no quantisation and no noise here.

Friction (LuGre): between reversals the bristle force f relaxes over distance; for constant v in a step, exactly by
``f' = s g + (f - s g) exp(-(c / delta) |dq| / g)`` with ``g = c (1 + (ratio - 1) exp(-(v / vs)^2))``, s the sign of v
and c that of its direction. The torque against motion adds ``viscous v + offset + ripple sin(cycles q + phase)``.

`WornFriction` also depends on temperature, load and time, each by a parameter of `Mismatch`::

    viscous  (1 - warm_up x),             dx/dt = (|F_f qd| / P - x) / 12 min,    P the power at a quarter of full speed
    c        + k |tau_link|,              tau_link = tau - F_f - rotor qdd, 0 <= k < load_friction of each joint
    offset   + a sin(w t) + b cos(w t),   |a|, |b| < offset_drift tau_max, w = 2 pi / 100 s
    phase  + ripple_jump (1 - s) / 2,     s the bristle force over Coulomb friction: from 1 forward to -1 backward
"""

from __future__ import annotations

import numpy as np

from armlab.sim.arm.mismatch import Mismatch, draw, load_share
from armlab.sim.arm.truth import Truth

POSITION_GAIN = 25.0  # 1/s
VELOCITY_GAIN = 150.0  # 1/s
INTEGRAL_TIME = 0.05  # s


class JointDrives:
    """Drives of all joints: inertia with rotors [kg m^2], known share of the bias, time between calls [s]."""

    def __init__(self, inertia: np.ndarray, tau_max: np.ndarray, feedforward: np.ndarray, step: float) -> None:
        self._inertia, self._feedforward = inertia, feedforward
        self._tau_max, self._tau_min = tau_max, -tau_max
        self._gain = inertia * VELOCITY_GAIN
        self._rate = step / INTEGRAL_TIME
        self._integral, self.gravity = np.zeros((2, len(inertia)))
        self.saturated = 0
        self.alone()

    def assist(self, tau: np.ndarray, gain_q: np.ndarray, gain_qd: np.ndarray) -> None:
        """Add a torque (n,) [N m] and scale the gains of position and velocity loop (n,) from now on."""
        self._added = (tau, gain_q, gain_qd)

    def alone(self) -> None:
        """Work with the drive's own gains and no added torque."""
        self._added = np.zeros_like(self._inertia), np.ones_like(self._inertia), np.ones_like(self._inertia)

    def reset(self, holding: np.ndarray, bias: np.ndarray) -> None:
        """Set the integral so that the torque at rest, on its reference, is `holding`; `bias` is gravity's [N m]."""
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
        """Write the torque of this step to `out` and return it; the drive knows a part of the true `bias` [N m]."""
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
        self.bristle = np.zeros(n)
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
        """Move the bristles by `dq` [rad] at velocity `qd` [rad/s], for the Stribeck curve."""
        ratio = 1.0 + self._excess * np.exp(-np.square(qd * self._speed_scale))
        sign = np.sign(dq)
        # s c = mean s + skew for both signs, because c_pos = mean + skew and c_neg = mean - skew
        sliding = (self._mean * sign + self._skew) * ratio
        self.bristle[:] = (self.bristle - sliding) * np.exp(dq * sign * self._rate / ratio) + sliding

    def torque(self, q: np.ndarray, qd: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Write the friction torque against motion [N m], ripple included, to `out` and return it."""
        truth = self._truth
        ripple = truth.ripple * np.sin(q * truth.ripple_cycles + self._phase)
        out[:] = qd * self._viscous + self.bristle + self._offset + ripple
        return out


WARM_TIME = 720.0  # s
DRIFT = 2.0 * np.pi / 100.0  # rad/s, of the offsets
WARM_SPEED = 0.25  # of the speed limit, at which friction heats the drive to a warmth of 1


class WornFriction(JointFriction):
    """Friction state of all joints, temperature included; `load` (n,), torque to the links, is read at every step."""

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
        """Move the bristles by `dq` [rad] at velocity `qd` [rad/s] and warm the drives."""
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
