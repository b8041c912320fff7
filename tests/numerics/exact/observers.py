"""Tables of the contact wrench by the momentum, sample by sample: the observer, and both Kalman filters with a tare.

Momenta follow from Lagrange's equations. A step of a filter is Van Loan's exponential and Bayes' rule, with the wrench
in its own units; a tare is the rule for a Gaussian vector of which a part is known.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from chains import GRAVITY, jacobian, mass_matrix, momentum, rnea
from contacts import Joint
from estimators import COVARIANCE, GAINS, GAP_STEPS, POINT, PRIOR, REST_TIME, Arm, recorded, spread, told, unknowns
from filters import filtered
from mpmath import mp
from rigid import array, blocks, chosen, exact, filled, part
from wrenches import linear

Table = dict[str, Any]
Vector = Any
CREEP, LONGEST, TARE_AFTER = mp.mpf(1e-3), mp.mpf(20), 1
MEMORY, QD_NOISE = np.array([0.05, 0.3, 1e-3]), np.array([1e-3, 1e-4, 2e-3])
RATE, LEAK = np.array([1e4, 4e3, 1e3, 10.0, 1.0, 0.0]), np.array([0.0, 1e-9, 3.0, 50.0, 4.9, 0.5])
GAIN = 30.0
WAYS = {"observer": (False, False), "filter": (True, False), "biased filter": (True, True)}


class Estimator:
    """One of them, with all that it remembers."""

    def __init__(self, robot: Arm, filters: bool, biased: bool, at_point: bool) -> None:
        self.robot, self.filters, self.biased, self.at_point = robot, filters, biased, at_point
        self.n, self.k = len(robot.rotor), 3 if at_point else 6
        self.joints = [Joint(robot.parts, i) for i in range(self.n)]
        self.prior, self.rate, self.leak = (exact(v)[: self.k] for v in (PRIOR, RATE, LEAK))
        self.rotor, self.unsure = exact(robot.rotor), [mp.one] * self.n
        self.friction = [s**2 for s in robot.static()]
        self.nominal, self.fresh, self.tared, self.since_tare = None, False, False, [mp.inf] * self.n

    def step(self, q: Vector, qd: Vector, tau: Vector, dt: Any) -> dict[str, np.ndarray]:
        first = self.nominal is None
        self.apart = first or dt > GAP_STEPS * self.nominal
        if self.apart:
            for joint in self.joints:
                joint.play, joint.z = None, mp.zero
        motion, zero = self.robot.motion(q, qd), mp.zeros(self.n, 1)
        p, beta = (row.T for row in (momentum(motion, exact(self.robot.bodies))[k, :] for k in (0, 1)))
        p += mp.matrix([r * v for r, v in zip(self.rotor, qd)])
        rubbing = mp.matrix([joint.torque(x, v, dt) for joint, x, v in zip(self.joints, q, qd)])
        weight = rnea(self.robot.motion(q, zero, zero), exact(GRAVITY), exact(self.robot.bodies))
        u = mp.matrix([t / g for t, g in zip(tau, exact(GAINS))]) + beta - weight - rubbing
        moved = [abs(joint.dy) / joint.friction[6] for joint in self.joints]
        rise = [(1 - known) * (1 - mp.exp(-dt / REST_TIME)) for known in self.unsure]
        self.unsure = [
            mp.one if self.apart else (known + more) * mp.exp(-2 * m)
            for known, more, m in zip(self.unsure, rise, moved)
        ]
        self.known = u if self.apart or self.fresh else (u + self.u) / 2
        self.middle = motion if self.apart else self.robot.motion((q + self.q) / 2)
        slowed = [spread(exact(COVARIANCE[:, i]), qd[i]) for i in range(self.n)]
        if self.filters:
            found = self.filter(first, motion, p, dt, slowed, moved, rise)
        else:
            found = self.observe(motion, p, dt, slowed)
        self.q, self.p, self.u, self.fresh, self.nominal = q, p, u, self.apart, dt if first else self.nominal
        self.since_tare = [mp.inf if self.apart else a + b for a, b in zip(self.since_tare, moved)]
        self.tared = self.tared and all(way <= 1 for way in self.since_tare)
        found["said"] = np.array([2.0 * any(found["observability"][:6] < 0.5) + 32 * self.tared])
        return found

    def observe(self, motion: Any, p: Vector, dt: Any, slowed: list[Any]) -> dict[str, np.ndarray]:
        """Return what the part of the wrench that has come through the low-pass says."""
        left = mp.exp(-mp.mpf(GAIN) * dt)
        if self.apart:
            self.r, self.low, self.seen = mp.zeros(self.n, 1), mp.matrix(self.unsure), mp.zero
        else:
            self.r = left * self.r + (1 - left) * ((p - self.p) / dt - self.known)
            self.low = left * self.low + (1 - left) * mp.matrix(self.unsure)
            self.seen = 1 - left * (1 - self.seen)
        variance = mp.matrix([v + f * low for v, f, low in zip(slowed, self.friction, self.low)])
        S = unknowns(motion, self.at_point)
        x, P = linear(S.T * jacobian(motion) * self.seen, self.r, variance, 0 * variance, self.prior)
        return told(S, x, P, self.prior) | {"error": array(self.r), "variance": array(variance)}

    def filter(
        self, first: bool, motion: Any, p: Vector, dt: Any, slowed: list[Any], moved: list[Any], rise: list[Any]
    ) -> dict[str, np.ndarray]:
        n, k, joints = self.n, self.k, range(self.n)
        M = mass_matrix(motion, exact(self.robot.bodies)) + mp.diag(list(self.rotor))
        R = M * mp.diag([noise**2 for noise in exact(QD_NOISE)]) * M.T
        G = (unknowns(self.middle, self.at_point).T * jacobian(self.middle)).T
        rate, leak, variance = list(self.rate), list(self.leak), slowed
        noise = [2 * v * memory for v, memory in zip(slowed, exact(MEMORY))]
        if self.biased:
            G = blocks([[G, -mp.eye(n)]])
            leak += [m / dt for m in moved]
            rate += [f * (r / dt + CREEP) for f, r in zip(self.friction, rise)]
        else:
            doubt = [f * known for f, known in zip(self.friction, self.unsure)]
            walk = [mp.fsum(G[i, j] ** 2 * rate[j] for j in range(k)) for i in joints]
            noise = [a + d * min(f / w, LONGEST) for a, d, f, w in zip(noise, doubt, self.friction, walk)]
            variance = [v + d for v, d in zip(slowed, doubt)]
        if self.apart:
            self.restart(first, p, R, dt)
        else:
            both = filtered(self.x, self.P, G, self.known, p, R, mp.matrix([dt]), noise, rate, leak)
            self.x, self.P = both[:, 0], both[:, 1:]
        wrench = range(n, n + k)
        found = told(unknowns(motion, self.at_point), self.x[n : n + k, 0], part(self.P, wrench, wrench), self.prior)
        return found | {"error": array(G * self.x[n:, 0]), "variance": array(mp.matrix(variance))}

    def restart(self, first: bool, p: Vector, R: mp.matrix, dt: Any) -> None:
        """Begin anew: the wrench is as its prior says, or has wandered since the gap began."""
        n, k = self.n, self.k
        x, P = mp.zeros(k, 1), mp.diag(list(self.prior))
        if not first:
            decay = mp.diag([mp.exp(-a * dt) for a in self.leak])
            walk = [(1 - mp.exp(-2 * a * dt)) / (2 * a) if a else dt for a in self.leak]
            wrench = range(n, n + k)
            x = decay * self.x[n : n + k, 0]
            P = decay * part(self.P, wrench, wrench) * decay + mp.diag([r * w for r, w in zip(self.rate, walk)])
        rest = self.friction if self.biased else []
        self.x, self.P = mp.zeros(n + k + len(rest), 1), mp.zeros(n + k + len(rest))
        self.x[:n, 0], self.x[n : n + k, 0] = p, x
        self.P[:n, :n], self.P[n : n + k, n : n + k] = R, P
        for i, f in enumerate(rest):
            self.P[n + k + i, n + k + i] = f

    def tare(self) -> None:
        """Know that the wrench is zero."""
        n, k, N = self.n, self.k, len(self.x)
        known = blocks([[mp.zeros(k, n), mp.eye(k), mp.zeros(k, N - n - k)]])
        gain = self.P * known.T * mp.inverse(known * self.P * known.T)
        self.x, self.P = self.x - gain * known * self.x, self.P - gain * known * self.P
        self.since_tare, self.tared = [mp.zero] * n, True


def tables() -> dict[str, Table]:
    """Return the tables of a record that begins at rest, moves, and goes on after a gap."""
    robot, given = recorded(np.random.default_rng(71))
    q, qd = given["angle"], given["qd"]
    q[1:3], qd[:3], qd[1] = q[0], 0.0, [0.0, 1e-300, -1e-9]
    found: dict[str, Table] = {}
    for (way, (filters, biased)), at_point in ((w, at) for w in WAYS.items() for at in (True, False)):
        if biased and not at_point:
            continue  # thrice the numbers, and nothing that the others have not
        one, rows, count = Estimator(robot, filters, biased, at_point), [], len(q)
        for k in chosen(count, in_order=True):
            rows.append(
                one.step(*(exact(given[key][k]) for key in ("angle", "qd", "tau")), mp.mpf(float(given["dt"][k])))
            )
            if k == TARE_AFTER and biased:
                one.tare()
        fixed = robot.arrays() | {
            "prior": PRIOR, "memory": MEMORY, "qd_noise": QD_NOISE, "rate": RATE, "leak": LEAK,
            "gain": np.array(GAIN), "point": POINT,
        }  # fmt: skip
        for name in rows[0]:
            wanted = filled(dict(enumerate(said[name] for said in rows)), count)
            where = f"{way} point" if at_point else way
            found[f"MomentumEstimator {where} {name}"] = {"fixed": fixed, "given": given, "wanted": wanted}
    return found
