"""Tables of the contact force at a known point, sample by sample, from torques of Lagrange's equations.

The low-pass is its trapezoidal rule solved as equations, the force is where the gradient of its probability is zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from chains import GRAVITY, Motion, arm, jacobian, rnea
from contacts import Joint, drives
from filters import wrench
from mpmath import mp
from rigid import array, blocks, exact, hat, part, rotation_of

Table = dict[str, Any]
REST_TIME, GAP_STEPS = mp.mpf(0.5), 5
POINT, CUTOFF, GAIN_VARIANCE = np.array([0.02, -0.01, 0.1]), 10.0, 0.03**2
COVARIANCE = np.array([[0.5, 0.3, 0.2], [0.1, 0.2, 0.1], [3.0, 0.4, 1.0], [0.0, 1.0, 2.0]])
GAINS, PRIOR = np.array([0.95, 1.0, 1.05]), np.array([400.0, 400, 400, 4, 4, 4])
Vector = Any


def lowpass(state: list[Any], x: Any, dt: Any, begins: bool) -> Any:
    """Return the output of a Butterworth filter of second order by the trapezoidal rule, and keep its state."""
    if begins:
        state[:] = [mp.zero, x]
        return x
    g = mp.tan(mp.pi * min(mp.mpf(CUTOFF) * dt, mp.mpf(0.45)))
    rule = mp.matrix([[1 + g * mp.sqrt(2), g], [-g, 1]])  # v1 = s1 + g (x - sqrt(2) v1 - v2), v2 = s2 + g v1
    v1, v2 = mp.inverse(rule) * mp.matrix([state[0] + g * x, state[1]])
    state[:] = [2 * v1 - state[0], 2 * v2 - state[1]]
    return v2


def spread(covariance: Vector, rate: Any) -> Any:
    """Return the variance of the torque error at a velocity."""
    at_rest, at_speed, shape, kind = covariance
    weight = (mp.exp(-shape * abs(rate)), mp.mpf(abs(rate) < shape), mp.zero)[int(kind)]
    return (at_rest - at_speed) * weight + at_speed


def forces(
    robot: Any, parts: dict[str, np.ndarray], rotor: np.ndarray, record: list[np.ndarray]
) -> list[list[np.ndarray]]:
    """Return F, P, torque error and variance of each sample."""
    frames, prismatic, bodies = robot
    n, joints = len(rotor), [Joint(parts, i) for i in range(len(rotor))]
    unsure, last, nominal, fresh = [mp.one] * n, None, None, False
    filters, found = [([mp.zero] * 2, [mp.zero] * 2) for _ in range(n)], []
    for row in zip(*record):
        q, qd, tau, (dt,) = (exact(np.atleast_1d(value)) for value in row)
        first = last is None
        apart = first or dt > GAP_STEPS * nominal
        if apart:
            last, unsure = qd, [mp.one] * n
            for joint in joints:
                joint.play, joint.z = None, mp.zero
        qdd, nominal = (qd - last) / dt, dt if first else nominal
        motion = Motion(frames, prismatic, q, qd, qdd)
        rigid, error, variance = rnea(motion, exact(GRAVITY), exact(bodies)), [], []
        for i, joint in enumerate(joints):
            drive, friction = joint.torque(q[i], qd[i], dt), joint.friction
            unsure[i] = 1 - (1 - unsure[i]) * mp.exp(-dt / REST_TIME)
            unsure[i] *= mp.exp(-2 * abs(joint.dy) / friction[6])
            raw = rigid[i] + mp.mpf(float(rotor[i])) * qdd[i] + drive - tau[i] / mp.mpf(float(GAINS[i]))
            error.append(lowpass(filters[i][0], raw, dt, apart or fresh))
            static = (friction[1] + friction[2]) / 2 + max(friction[4], 0)
            doubt = min(max(lowpass(filters[i][1], unsure[i], dt, apart), mp.zero), mp.one)
            variance.append(spread(exact(COVARIANCE[:, i]), qd[i]) + static**2 * doubt)
        last, fresh = qd, apart and not first
        found.append([*contact(motion, mp.matrix(error), mp.matrix(variance)), array(error), array(variance)])
    return found


def contact(motion: Motion, error: Vector, variance: Vector) -> tuple[np.ndarray, np.ndarray]:
    arm_of_force = rotation_of(motion.transform(motion.n + 1)) * exact(POINT)
    S = blocks([[mp.eye(3)], [hat(arm_of_force)]])
    both = wrench(S.T * jacobian(motion), error, variance, 0 * error, exact(PRIOR[:3]))
    F, P = S * both[:, 0], S * part(both, range(3), range(1, 4)) * S.T
    return array(F), array(P + mp.mpf(GAIN_VARIANCE) * F * F.T)


def tables() -> dict[str, Table]:
    """Return the tables of one record: at speed, slow, at rest, after a gap, and with speeds that are hardly any."""
    rng, n, count = np.random.default_rng(61), 3, 8
    frames, prismatic, bodies = arm(n, n)
    parts = drives(rng, n)
    parts["friction"][2] = np.abs(parts["friction"][2])
    q = np.cumsum(rng.normal(size=(count, n)) * 0.005, axis=0) + rng.normal(size=n)
    qd, tau, dt = rng.normal(size=(count, n)), 5 * rng.normal(size=(count, n)), np.full(count, 0.004)
    qd[2], q[3], dt[3], dt[5] = [0.0, 1e-300, -1e-9], q[2], 0.012, 0.5
    rotor = rng.uniform(0.01, 0.1, n)
    fixed = parts | {
        "frames": frames, "prismatic": prismatic.astype(float), "gravity": GRAVITY, "links": bodies, "rotor": rotor,
        "gains": GAINS, "gain_variance": np.array(GAIN_VARIANCE), "covariance": COVARIANCE, "prior": PRIOR,
        "cutoff": np.array(CUTOFF), "point": POINT,
    }  # fmt: skip
    given = {"angle": q, "qd": qd, "tau": tau, "dt": dt}
    rows = forces((frames, prismatic, bodies), parts, rotor, [q, qd, tau, dt])
    return {
        f"WrenchEstimator {name}": {"fixed": fixed, "given": given, "wanted": np.array([row[k] for row in rows])}
        for k, name in enumerate(("F", "P", "error", "variance"))
    }
