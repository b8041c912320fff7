"""Tables of what torques and forces say: model torques, intervals of a wrench.

Torques follow from Lagrange's equations, an interval from the corner of its polytope with multipliers that prove it.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
from chains import GRAVITY, Motion, arm, rnea
from mpmath import mp
from rigid import array, chosen, exact, filled

Table = dict[str, Any]
Vector = Any


def gaussians(x: Any, centres: Vector, widths: Vector) -> list[Any]:
    x = min(max(x, centres[0]), centres[len(centres) - 1])
    psi = [mp.exp(-(((x - c) / s) ** 2)) for c, s in zip(centres, widths)]
    return [p / mp.fsum(psi) for p in psi]


class Joint:
    """What rubs and pulls in one joint, with its memory."""

    def __init__(self, parts: dict[str, np.ndarray], i: int) -> None:
        self.friction, self.ripple = exact(parts["friction"][:, i]), exact(parts["ripple"][:, i])
        self.warm_up = exact(parts["warm_up"][:, i])
        self.map = [
            exact(parts[f"map_{name}"][i]) for name in ("positions", "position_widths", "speeds", "speed_widths")
        ]
        self.of_map = [exact(side) for side in parts["map_coefficients"][i]]
        self.lines = [exact(parts[f"line_{name}"][i]) for name in ("speeds", "widths")]
        chosen = [k for k, joint in enumerate(parts["line_joints"]) if joint == i]
        self.of_lines = [
            (mp.mpf(float(parts["line_cycles"][k])), [exact(s) for s in parts["line_coefficients"][k]]) for k in chosen
        ]
        self.z, self.warmth, self.play = mp.zero, self.warm_up[4], None

    def torque(self, q: Any, qd: Any, dt: Any, share: Any = 1) -> Any:
        """Move by one sample and return the torque of the drive, of which dry friction counts by a share."""
        b, up, down, offset, stribeck, speed, length, half, root, smooth = self.friction
        self.play = q if self.play is None else self.play
        moved = min(max(self.play, q - half), q + half)
        dy = self.dy = moved - self.play
        self.play = moved
        self.z = mp.sign(dy) + (self.z - mp.sign(dy)) * mp.exp(-abs(dy) / length)
        s = mp.tanh(qd / smooth) if smooth else self.z
        of_coulomb, of_viscous, time, reference, _ = self.warm_up
        viscous = b * (1 + of_viscous * self.warmth) * qd
        dry = (up * max(s, 0) + down * min(s, 0)) * (1 + of_coulomb * self.warmth)
        dry += stribeck * s * mp.exp(-((qd / speed) ** 2)) + root * s * mp.sqrt(abs(qd))
        power = abs((viscous + dry) * qd) / reference
        self.warmth = power + (self.warmth - power) * mp.exp(-dt / time)
        cycles, c, sine = self.ripple
        total = viscous + share * dry + offset + c * mp.cos(cycles * q) + sine * mp.sin(cycles * q)
        sides = ((1 + s) / 2, (1 - s) / 2)
        at, fast = gaussians(q, *self.map[:2]), gaussians(abs(qd), *self.map[2:])
        for side, K in zip(sides, self.of_map):
            total += share * side * mp.fsum(x * K[a, d] * y for a, x in enumerate(at) for d, y in enumerate(fast))
        along = gaussians(abs(qd), *self.lines)
        for cycles, both in self.of_lines:
            for side, K in zip(sides, both):
                total += side * mp.fsum(
                    w * (K[d, 0] * mp.cos(cycles * q) + K[d, 1] * mp.sin(cycles * q)) for d, w in enumerate(along)
                )
        return total


def drives(rng: np.random.Generator, n: int) -> dict[str, np.ndarray]:
    friction = np.abs(rng.normal(size=(10, n)))
    friction[2], friction[6], friction[7], friction[9] = -friction[2], 0.02, [0.0, 1e-3, 1e-4], [0.0, 0.1, 0.0]
    centres = np.sort(rng.uniform(-2, 2, (n, 4)), axis=1)
    speeds = np.sort(rng.uniform(0, 2, (n, 3)), axis=1)
    return {
        "friction": friction, "ripple": rng.normal(size=(3, n)) * 3,
        "line_joints": np.array([0.0, 2.0, 2.0]), "line_cycles": np.array([6.0, 12.0, 24.0]), "line_speeds": speeds,
        "line_widths": rng.uniform(0.3, 1.0, (n, 3)), "line_coefficients": rng.normal(size=(3, 2, 3, 2)),
        "map_positions": centres, "map_position_widths": rng.uniform(0.3, 1.0, (n, 4)), "map_speeds": speeds,
        "map_speed_widths": rng.uniform(0.3, 1.0, (n, 3)), "map_coefficients": rng.normal(size=(n, 2, 4, 3)),
        "warm_up": np.array([[-0.3, -0.4, -0.1, 0.5, 0.2]] * n).T + np.array([[0], [0], [60.1], [0], [0]]),
    }  # fmt: skip


def torques() -> dict[str, Table]:
    """Return the table of a record of an arm with all that its drives can have."""
    rng, n, count = np.random.default_rng(37), 3, 6
    frames, prismatic, bodies = arm(n, n)
    parts = drives(rng, n)
    q = np.cumsum(rng.normal(size=(count, n)) * 0.01, axis=0) + rng.normal(size=n)
    qd, qdd, dt = rng.normal(size=(count, n)), rng.normal(size=(count, n)), rng.uniform(1e-3, 5.0, count)
    qd[1], q[2], dt[3] = [0.0, 1e-300, -1e-9], q[1], 1e-9
    rotor = rng.uniform(0.1, 1.0, n)
    joints, rows = [Joint(parts, i) for i in range(n)], {}
    for k in chosen(count, in_order=True):
        given, step = [exact(value[k]) for value in (q, qd, qdd)], dt[k]
        rigid = rnea(Motion(frames, prismatic, *given), exact(GRAVITY), exact(bodies))
        drive = [joint.torque(x, v, mp.mpf(float(step))) for joint, x, v in zip(joints, *given[:2])]
        inertia = [mp.mpf(float(r)) * a for r, a in zip(rotor, given[2])]
        rows[k] = array([a + b + c for a, b, c in zip(rigid, drive, inertia)])
    given = {"gravity": GRAVITY, "links": bodies, "rotor": rotor, "angle": q, "qd": qd, "qdd": qdd, "dt": dt}
    fixed = parts | {"frames": frames, "prismatic": prismatic.astype(float)}
    return {"model_torque": {"fixed": fixed, "given": given, "wanted": filled(rows, count)}}


def corner(rows: mp.matrix, limits: mp.matrix, aim: mp.matrix, guess: np.ndarray) -> mp.matrix:
    """Return where ``aim . x`` is least with ``rows x <= limits``.

    The constraints that hold with equality are among those that nearly do at the guess; that none is broken and that
    `aim` is a sum of their normals with multipliers not above zero proves the corner.
    """
    k = rows.cols
    slack = array(limits) - array(rows) @ guess
    for active in combinations(np.argsort(slack)[: k + 3].tolist(), k):
        N = mp.matrix([list(rows[i, :]) for i in active])
        if abs(mp.det(N)) < mp.mpf(10) ** -20:
            continue
        x, multipliers = mp.lu_solve(N, mp.matrix([limits[i] for i in active])), mp.lu_solve(N.T, aim)
        over = max(a - b for a, b in zip(rows * x, limits))
        if over <= mp.mpf(10) ** -60 and all(m <= 0 for m in multipliers):
            return x
    raise ValueError("no corner")


def interval(A: mp.matrix, error: Vector, spread: Vector, box: Vector) -> list[tuple[Any, Any]]:
    """Return the least and the largest value of each unknown."""
    from scipy.optimize import linprog

    k, ends = A.rows, []
    rows = mp.matrix([*A.T.tolist(), *(-A.T).tolist(), *mp.eye(k).tolist(), *(-mp.eye(k)).tolist()])
    limits = mp.matrix([*(error + spread), *(spread - error), *box, *box])
    for i in range(k):
        both = []
        for sign in (1.0, -1.0):
            aim = mp.zeros(k, 1)
            aim[i] = sign
            found = linprog(array(aim), array(rows), array(limits), bounds=(None, None), method="highs")
            both.append(corner(rows, limits, aim, found.x)[i])
        ends.append((both[0], both[1]))
    return ends


def intervals() -> dict[str, Table]:
    rng, found = np.random.default_rng(41), {}
    for k, n in ((3, 4), (3, 7), (6, 7)):
        A, x = rng.normal(size=(k, n)), rng.normal(size=k)
        spread, box = rng.uniform(0.1, 1.0, n), np.array([30.0, 20.0, 50.0, 3.0, 2.0, 5.0])[:k]
        error = np.sum(A * x[:, None], axis=0) + rng.uniform(-0.9, 0.9, n) * spread
        given = {"A": A, "error": error, "spread": spread, "box": box}
        wanted = np.array([array(ends) for ends in interval(*(exact(value) for value in given.values()))])
        found[f"wrench_interval {k} {n}"] = {"given": given, "wanted": wanted[None]}
    return found


def tables() -> dict[str, Table]:
    """Return all of them."""
    return torques() | intervals()
