"""Tables of the contact wrench, sample by sample and by every method, from torques of Lagrange's equations.

The low-pass is its trapezoidal rule solved as equations, the wrench is that of `wrenches`, its interval the corners of
the polytope.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from chains import GRAVITY, Motion, arm, jacobian, rnea
from contacts import Joint, drives, interval
from mpmath import mp
from rigid import array, blocks, chosen, exact, filled, hat, rotation_of
from wrenches import METHODS, beyond

Table = dict[str, Any]
REST_TIME, GAP_STEPS = mp.mpf(0.5), 5
LARGEST = mp.mpf(1e100)  # the bound where nothing is known
POINT, CUTOFF, GAIN_VARIANCE = np.array([0.02, -0.01, 0.1]), 10.0, 0.03**2
COVARIANCE = np.array([[0.5, 0.3, 0.2], [0.1, 0.2, 0.1], [3.0, 0.4, 1.0], [0.0, 1.0, 2.0]])
BOUND = np.array([[2.0, 1.0, 0.5], [0.5, 1e-3, 2.0], [0.1, 0.0, 1.0]])  # torque, speed, floor
GAINS, PRIOR = np.array([0.95, 1.0, 1.05]), np.array([400.0, 400, 400, 4, 4, 4])
WAYS = ("map point", "map", "bounded point", "bounded", "clip point", "interval point", "ls point", "lund")
BANDS = ("bounded", "clip", "interval")
Vector = Any


@dataclass
class Arm:
    """What every estimator knows."""

    frames: np.ndarray
    prismatic: np.ndarray
    bodies: np.ndarray
    parts: dict[str, np.ndarray]
    rotor: np.ndarray
    known: dict[tuple[tuple[Any, ...], ...], Motion] = field(default_factory=dict)

    def arrays(self) -> dict[str, np.ndarray]:
        return self.parts | {
            "frames": self.frames, "prismatic": self.prismatic.astype(float), "gravity": GRAVITY, "links": self.bodies,
            "rotor": self.rotor, "gains": GAINS, "gain_variance": np.array(GAIN_VARIANCE), "covariance": COVARIANCE,
        }  # fmt: skip

    def motion(self, *motion: Vector) -> Motion:
        """Return a motion, the same with its derivatives for the same numbers."""
        key = tuple(tuple(values) for values in motion)
        if key not in self.known:
            self.known[key] = Motion(self.frames, self.prismatic, *motion)
        return self.known[key]

    def static(self) -> list[Any]:
        """Return the torque of friction that nothing is known of."""
        return [(f[1] + f[2]) / 2 + max(f[4], 0) for f in (exact(row) for row in self.parts["friction"].T)]


@dataclass
class Sample:
    """What the estimate of one sample is made of."""

    motion: Motion
    error: Vector
    variance: Vector
    bound: Vector


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


def samples(robot: Arm, record: list[np.ndarray], band: bool) -> list[Sample]:
    """Return the samples of a record; with a band, friction near rest is anything within a bound."""
    n, joints = len(robot.rotor), [Joint(robot.parts, i) for i in range(len(robot.rotor))]
    unsure, last, nominal, fresh = [mp.one] * n, None, None, False
    filters, found = [([mp.zero] * 2, [mp.zero] * 2) for _ in range(n)], []
    for k in chosen(len(record[0]), in_order=True):
        q, qd, tau, (dt,) = (exact(np.atleast_1d(column[k])) for column in record)
        first = last is None
        apart = first or dt > GAP_STEPS * nominal
        if apart:
            last, unsure = qd, [mp.one] * n
            for joint in joints:
                joint.play, joint.z = None, mp.zero
        qdd, nominal = (qd - last) / dt, dt if first else nominal
        motion, error, variance, bound = robot.motion(q, qd, qdd), [], [], []
        rigid = rnea(motion, exact(GRAVITY), exact(robot.bodies))
        for i, (joint, static) in enumerate(zip(joints, robot.static())):
            largest, speed, floor = exact(BOUND[:, i])
            slow = mp.exp(-((qd[i] / speed) ** 2)) if band else mp.zero
            drive = joint.torque(q[i], qd[i], dt, 1 - slow)
            unsure[i] = 1 - (1 - unsure[i]) * mp.exp(-dt / REST_TIME)
            unsure[i] *= mp.exp(-2 * abs(joint.dy) / joint.friction[6])
            raw = rigid[i] + mp.mpf(float(robot.rotor[i])) * qdd[i] + drive - tau[i] / mp.mpf(float(GAINS[i]))
            error.append(lowpass(filters[i][0], raw, dt, apart or fresh))
            doubt = lowpass(filters[i][1], max(slow, unsure[i]), dt, apart)
            doubt = min(max(doubt, mp.zero), mp.one)
            variance.append(mp.mpf(float(COVARIANCE[1, i])) if band else spread(exact(COVARIANCE[:, i]), qd[i]))
            variance[i] += 0 if band else static**2 * doubt
            bound.append((LARGEST if apart else largest * doubt + floor) if band else mp.zero)
        last, fresh = qd, apart and not first
        found.append(Sample(motion, *(mp.matrix(values) for values in (error, variance, bound))))
    return found


def unknowns(motion: Motion, at_point: bool) -> mp.matrix:
    """Return the wrench of a unit of each unknown: of a force at the point, or of the wrench itself."""
    arm_of_force = rotation_of(motion.transform(motion.n + 1)) * exact(POINT)
    return blocks([[mp.eye(3)], [hat(arm_of_force)]]) if at_point else mp.eye(6)


def told(S: mp.matrix, x: Vector, P: mp.matrix, prior: Vector) -> dict[str, np.ndarray]:
    """Return the wrench, its covariance, and what of it is seen, as shares of one."""
    F, C, P = S * x, S * mp.diag(list(prior)) * S.T, S * P * S.T
    seen = [max(1 - P[i, i] / C[i, i], mp.zero) for i in range(6)]
    return {"F": array(F), "P": array(P + mp.mpf(GAIN_VARIANCE) * F * F.T), "observability": array([*seen, mp.one])}


def estimate(sample: Sample, way: str, prior: np.ndarray) -> dict[str, np.ndarray]:
    """Return what an estimator says of a sample; `said` are its flags and the joints that carry information."""
    method, at_point = way.split()[0], "point" in way
    S, before = unknowns(sample.motion, at_point), exact(prior)
    before = before[:3] if at_point else before
    A, band = S.T * jacobian(sample.motion), method in BANDS
    x, P = METHODS[method](A, sample.error, sample.variance, sample.bound, before)
    active = [bool(over) or not band for over in beyond(sample.error, A, x, sample.bound)]
    found = told(S, x, P, before) | {"error": array(sample.error), "variance": array(sample.variance)}
    found["said"] = np.array([2 * any(found["observability"] < 0.5) + 4 * (not any(active)), *active], dtype=float)
    if method == "interval":
        spread = sample.bound + 3 * sample.variance.apply(mp.sqrt)
        box = 10 * before.apply(mp.sqrt)
        share, ends = 3 * mp.sqrt(mp.mpf(GAIN_VARIANCE)), []
        for (low, high), most in zip(interval(A, sample.error, spread, box), box):
            ends.append((max(low - share * abs(low), -most), min(high + share * abs(high), most)))
        found["interval"] = np.array([array(moment(row, ends)) for row in S.tolist()])
    return found


def moment(row: list[Any], ends: list[tuple[Any, Any]]) -> list[Any]:
    """Return the least and the largest sum of unknowns within their ends."""
    return [mp.fsum(pick(share * low, share * high) for share, (low, high) in zip(row, ends)) for pick in (min, max)]


def recorded(rng: np.random.Generator) -> tuple[Arm, dict[str, np.ndarray]]:
    """Return a record: at speed, slow, at rest, after a gap, and with speeds that are hardly any."""
    n, count = 3, 8
    robot = Arm(*arm(n, n), drives(rng, n), rng.uniform(0.01, 0.1, n))
    robot.parts["friction"][2] = np.abs(robot.parts["friction"][2])
    q = np.cumsum(rng.normal(size=(count, n)) * 0.005, axis=0) + rng.normal(size=n)
    qd, tau, dt = 0.02 * rng.normal(size=(count, n)), 5 * rng.normal(size=(count, n)), np.full(count, 0.004)
    qd[2], q[3], dt[3], dt[5] = [0.0, 1e-300, -1e-9], q[2], 0.012, 0.5
    return robot, {"angle": q, "qd": qd, "tau": tau, "dt": dt}


def tables() -> dict[str, Table]:
    """Return the tables of one record by every method."""
    robot, given = recorded(np.random.default_rng(61))
    rows = {band: samples(robot, list(given.values()), band) for band in (False, True)}
    found: dict[str, Table] = {}
    for way in WAYS:
        prior = PRIOR / (100.0 if "clip" in way else 1.0)  # clipping is slow where the prior says little
        fixed = robot.arrays() | {"bound": BOUND, "prior": prior, "cutoff": np.array(CUTOFF), "point": POINT}
        said = [estimate(sample, way, prior) for sample in rows[way.split()[0] in BANDS]]
        for part in said[0]:
            if part in ("error", "variance") and way not in ("map point", "bounded point"):
                continue  # they are those of all that have a bound, or of all that have none
            if "interval" in way and part != "interval":
                continue  # they are those of the method with a bound
            wanted = filled(dict(enumerate(row[part] for row in said)), len(given["dt"]))
            found[f"WrenchEstimator {way} {part}"] = {"fixed": fixed, "given": given, "wanted": wanted}
    return found
