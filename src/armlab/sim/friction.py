"""Drive friction of the simulated arms: a bristle state (LuGre), Stribeck curve, viscous part, offset, torque ripple.

Between reversals the bristle force f of a joint relaxes over distance, not over time (Canudas de Wit et al. 1995)::

    df/dq = (c / delta) (1 - f s / g(v)),   g(v) = c (1 + (ratio - 1) exp(-(v / vs)^2)),   s = sign(v)

with c = c_pos or c_neg by direction. In small motions it is a spring of stiffness c / delta; with growing distance it
slides at g. At rest it keeps its value: a joint really sticks, and needs ``ratio`` x Coulomb to break away.
For constant v in a step the solution is exact::

    f' = s g + (f - s g) exp(-(c / delta) |dq| / g)

The torque against motion adds ``viscous v + offset + ripple sin(cycles q + phase)``.
"""

from __future__ import annotations

import numpy as np

from armlab.sim.truth import Truth

__all__ = ["Friction"]


class Friction:
    """Friction state of all joints.

    Parameters
    ----------
    truth : the parameters.
    """

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
        """Move the bristles by `dq`.

        Parameters
        ----------
        dq : (n,) displacement in this step [rad].
        qd : (n,) velocity of this step [rad/s], for the Stribeck curve.
        """
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
        """Return the friction torque against motion, ripple included.

        Parameters
        ----------
        q, qd : (n,) position and velocity.
        out : (n,) receives the torque [N m].
        """
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
