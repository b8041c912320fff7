"""Joint drives of the simulated arms: a position loop around a velocity loop with integral action.

Per joint, at every physics step h, with the nominal inertia J of the joint at the home posture::

    e   = (v_ref + POSITION_GAIN (q_ref - q)) - v
    I  += h e / INTEGRAL_TIME
    tau = J (a_ref + VELOCITY_GAIN (e + I)) + feedforward (C v + G),     |tau| <= tau_max

References of the research extension scale both gains and add a torque. The integral and the acceleration term belong to
the position and to the velocity loop, so a joint with both scales 0 feels the feed-forward and the added torque alone::

    e   = gain_qd (v_ref - v) + gain_q POSITION_GAIN (q_ref - q),   I += gain_q h e / INTEGRAL_TIME
    tau = J (gain_qd a_ref + VELOCITY_GAIN (e + gain_q I)) + feedforward (C v + G) + tau_added

The integral makes an arm at rest stiff: a push is first carried by static friction and then by the drive, which carries
too much or too little as long as the bristles of the friction hold the rest. It stops growing while the torque is
saturated. The feed-forward is deliberately incomplete, as in real drives. The drive sees position and velocity without
the quantisation and noise of what is reported.
"""

from __future__ import annotations

import numpy as np

POSITION_GAIN = 25.0  # 1/s
VELOCITY_GAIN = 150.0  # 1/s
INTEGRAL_TIME = 0.05  # s


class JointDrives:
    """Drives of all joints.

    `inertia` includes the rotors [kg m^2]; `feedforward` is the known share of Coriolis and gravity torque; `step` is
    the time between two calls [s].
    """

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
