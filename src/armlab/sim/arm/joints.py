"""Joint drives and joint friction of the simulated arms.

Drive: a position loop around a velocity loop with integral action.

Per joint, at every physics step h, with the nominal inertia J of the joint at the home posture::

    e   = (v_ref + POSITION_GAIN (q_ref - q)) - v
    I  += h e / INTEGRAL_TIME
    tau = J (a_ref + VELOCITY_GAIN (e + I)) + feedforward (C v + G),     |tau| <= tau_max

References of the research extension scale both gains and add a torque. The integral and the acceleration term belong to
the position and to the velocity loop, so a joint with both scales 0 feels the feed-forward and the added torque alone::

    e   = gain_qd (v_ref - v) + gain_q POSITION_GAIN (q_ref - q),   I += gain_q h e / INTEGRAL_TIME
    tau = J (gain_qd a_ref + VELOCITY_GAIN (e + gain_q I)) + feedforward (C v + G) + tau_added

The integral stops growing while the torque is saturated. The feed-forward is incomplete, as in real drives. The drive
sees position and velocity without quantisation and noise.

Friction, `JointFriction` (LuGre): bristle state, Stribeck curve, viscous part, offset and torque ripple. Between
reversals the bristle force f of a joint relaxes over distance, not over time (Canudas de Wit et al. 1995)::

    df/dq = (c / delta) (1 - f s / g(v)),   g(v) = c (1 + (ratio - 1) exp(-(v / vs)^2)),   s = sign(v)

with c = c_pos or c_neg by direction. At rest it keeps its value: a joint really sticks, and needs ``ratio`` x Coulomb
to break away. For constant v in a step the solution is exact::

    f' = s g + (f - s g) exp(-(c / delta) |dq| / g)

The torque against motion adds ``viscous v + offset + ripple sin(cycles q + phase)``.

`WornFriction` also depends on temperature and load, each by a parameter of `Mismatch`::

    viscous  (1 - warm_up x),             dx/dt = (|F_f qd| / P - x) / 12 min,    P the power at a quarter of full speed
    c        (1 + load_friction |tau| / tau_max)
    phase  + ripple_jump (1 - s) / 2,     s the bristle force over Coulomb friction: from 1 forward to -1 backward
"""

from __future__ import annotations

import numpy as np

from armlab.sim.arm.mismatch import Mismatch
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
        self._integral = np.zeros_like(inertia)
        self._error, self._growth = np.zeros((2, len(inertia)))
        self.gravity = np.zeros_like(inertia)
        self.saturated = 0
        self._added: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def assist(self, tau: np.ndarray, gain_q: np.ndarray, gain_qd: np.ndarray) -> None:
        """Add a torque (n,) [N m] and scale the gains of position and velocity loop (n,) from now on."""
        self._added = (tau, gain_q, gain_qd)

    def alone(self) -> None:
        """Work with the drive's own gains and no added torque."""
        self._added = None

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
        error, growth = self._error, self._growth
        np.subtract(q_ref, q, out=error)
        error *= POSITION_GAIN
        if self._added is None:
            error += qd_ref
            error -= qd
            np.multiply(error, self._rate, out=growth)
            self._integral += growth
            np.add(error, self._integral, out=out)
            out *= self._gain
            np.multiply(self._inertia, qdd_ref, out=error)
            out += error
        else:
            tau, gain_q, gain_qd = self._added
            error *= gain_q
            error += gain_qd * (qd_ref - qd)
            np.multiply(error, self._rate * gain_q, out=growth)
            self._integral += growth
            out[:] = self._gain * (error + gain_q * self._integral) + gain_qd * self._inertia * qdd_ref + tau
        np.multiply(self._feedforward, bias, out=self.gravity)
        out += self.gravity
        np.minimum(out, self._tau_max, out=error)
        np.maximum(error, self._tau_min, out=error)
        error -= out
        if error.dot(error) > 0.0:  # the cheapest test for "any"
            self._integral -= np.where(error == 0.0, 0.0, growth)
            out += error
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
        self._viscous, self._phase = truth.viscous, truth.ripple_phase
        self._work = np.empty((4, n))

    def reset(self) -> None:
        """Unload the bristles."""
        self.bristle[:] = 0.0

    def advance(self, dq: np.ndarray, qd: np.ndarray) -> None:
        """Move the bristles by `dq` [rad] at velocity `qd` [rad/s], for the Stribeck curve."""
        ratio, sliding, sign, decay = self._work
        np.multiply(qd, self._speed_scale, out=ratio)
        np.multiply(ratio, ratio, out=ratio)
        np.negative(ratio, out=ratio)
        np.exp(ratio, out=ratio)
        ratio *= self._excess
        ratio += 1.0
        # s c = mean s + skew for both signs, because c_pos = mean + skew and c_neg = mean - skew
        np.sign(dq, out=sign)
        np.multiply(self._mean, sign, out=sliding)
        sliding += self._skew
        sliding *= ratio
        np.multiply(dq, sign, out=decay)
        decay *= self._rate
        decay /= ratio
        np.exp(decay, out=decay)
        self.bristle -= sliding
        self.bristle *= decay
        self.bristle += sliding

    def torque(self, q: np.ndarray, qd: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Write the friction torque against motion [N m], ripple included, to `out` and return it."""
        truth, angle = self._truth, self._work[0]
        np.multiply(q, truth.ripple_cycles, out=angle)
        angle += self._phase
        np.sin(angle, out=angle)
        angle *= truth.ripple
        np.multiply(qd, self._viscous, out=out)
        out += self.bristle
        out += truth.offset
        out += angle
        return out


WARM_TIME = 720.0  # s
WARM_SPEED = 0.25  # of the speed limit, at which friction heats the drive to a warmth of 1


class WornFriction(JointFriction):
    """Friction state of all joints, temperature included; `load` (n,), the drives' torque, is read at every step."""

    def __init__(self, truth: Truth, mismatch: Mismatch, step: float, load: np.ndarray) -> None:
        super().__init__(truth)
        self._mismatch, self._step, self._load = mismatch, step, load
        self._cold = self._mean.copy(), self._skew.copy()
        coulomb = np.where(self._mean > 0, self._mean, 1.0)
        speed = np.divide(coulomb, truth.viscous, out=np.full_like(coulomb, np.inf), where=truth.viscous > 0)
        self._full = coulomb
        self._power = WARM_SPEED * (1.0 + WARM_SPEED) * coulomb * speed
        self.warmth = np.zeros_like(coulomb)

    def advance(self, dq: np.ndarray, qd: np.ndarray) -> None:
        """Move the bristles by `dq` [rad] at velocity `qd` [rad/s] and warm the drives."""
        share = 1.0 + self._mismatch.load_friction * np.abs(self._load) / self._truth.tau_max
        self._mean, self._skew = share * self._cold[0], share * self._cold[1]
        super().advance(dq, qd)
        heat = np.abs((self.bristle + self._viscous * qd) * qd) / self._power
        self.warmth += self._step / WARM_TIME * (heat - self.warmth)
        self._viscous = self._truth.viscous * (1.0 - self._mismatch.warm_up * np.minimum(self.warmth, 1.0))
        forward = np.clip(self.bristle / self._full, -1.0, 1.0)
        self._phase = self._truth.ripple_phase + self._mismatch.ripple_jump * 0.5 * (1.0 - forward)
