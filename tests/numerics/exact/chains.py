"""Tables of the kernels of a serial chain, from the derivatives of its transforms and Lagrange's equations.

``T_k`` is the product of frames and joint turns; its derivatives put the generator of a joint where it turns. With the
pseudo-inertia ``S_k`` (4, 4) of link k, of which T_k S_k T_kᵀ is that in base axes::

    tau_i = sum_k tr(d_i T_k  S_k  T_k''ᵀ) - g . (d_i T_k h_k),    h_k = [m c; m]

No twist, no cross product, no recursion over links as in the kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from mpmath import mp
from rigid import array, blocks, each, exact, hat, nearest, part, pose, position_of, series, vee

Table = dict[str, Any]
GRAVITY = np.array([0.3, -0.2, -9.80665])


class Motion:
    """One sample of a motion, and all derivatives of its link frames by the joints."""

    def __init__(self, frames: np.ndarray, prismatic: np.ndarray, *motion: mp.matrix) -> None:
        self.n, self.q = len(prismatic), motion[0]
        self.qd = motion[1] if len(motion) > 1 else mp.zeros(self.n, 1)
        self.qdd = motion[2] if len(motion) > 2 else mp.zeros(self.n, 1)
        turn = blocks([[hat([0, 0, 1]), mp.zeros(3, 1)], [mp.zeros(1, 4)]])
        slide = mp.zeros(4)
        slide[2, 3] = 1
        self.generators = [slide if slides else turn for slides in prismatic]
        self.frames = [exact(frame) for frame in frames]
        self.frames = [pose(nearest(part(E, range(3), range(3))), position_of(E)) for E in self.frames]
        self.joints = [
            mp.eye(4) + slide * q if slides else pose(series(hat([0, 0, mp.fmod(q, 2 * mp.pi)])), mp.zeros(3, 1))
            for slides, q in zip(prismatic, self.q)
        ]

    def transform(self, link: int, *by: int) -> mp.matrix:
        """Return T_base_link, or its derivative by those joints; link n + 1 is the tool."""
        T = self.frames[0]
        for i in range(min(link, self.n)):
            if i:
                T = T * self.frames[i]
            T = T * self.joints[i]
            for _ in range(by.count(i)):
                T = T * self.generators[i]
        if any(i >= link for i in by):
            return mp.zeros(4)
        return T * self.frames[-1] if link > self.n else T

    @cached_property
    def first(self) -> list[list[mp.matrix]]:
        return [[self.transform(k, i) for i in range(self.n)] for k in range(1, self.n + 2)]

    @cached_property
    def second(self) -> list[list[list[mp.matrix]]]:
        joints = range(self.n)
        return [[[self.transform(k, i, j) for j in joints] for i in joints] for k in range(1, self.n + 2)]

    def total(self, matrices: list[mp.matrix], factors: mp.matrix) -> mp.matrix:
        return sum((M * x for M, x in zip(matrices, factors)), mp.zeros(4))

    def speed(self, link: int) -> mp.matrix:
        return self.total(self.first[link], self.qd)

    def acceleration(self, link: int) -> mp.matrix:
        curves = [self.total(row, self.qd) for row in self.second[link]]
        return self.total(self.first[link], self.qdd) + self.total(curves, self.qd)


def columns(values: list[Any]) -> mp.matrix:
    return mp.matrix([list(value) for value in values]).T


def rotation(T: mp.matrix) -> mp.matrix:
    return part(T, range(3), range(3))


def jacobian(motion: Motion, tool: bool = False) -> mp.matrix:
    R = rotation(motion.transform(motion.n + 1))
    back = R.T if tool else mp.eye(3)
    return columns([[*(back * position_of(D)), *(back * vee(rotation(D) * R.T))] for D in motion.first[-1]])


def jacobian_derivative(motion: Motion, tool: bool = False) -> mp.matrix:
    R, Rd = rotation(motion.transform(motion.n + 1)), rotation(motion.speed(-1))
    back, turning = (R.T, Rd.T) if tool else (mp.eye(3), mp.zeros(3))
    found = []
    for D, row in zip(motion.first[-1], motion.second[-1]):
        Dd = motion.total(row, motion.qd)
        w, wd = vee(rotation(D) * R.T), vee(rotation(Dd) * R.T + rotation(D) * Rd.T)
        found.append([*(back * position_of(Dd) + turning * position_of(D)), *(back * wd + turning * w)])
    return columns(found)


def pseudo_inertia(pi: mp.matrix) -> mp.matrix:
    """Return the sum of mass times [x; 1] [x; 1]ᵀ of a body."""
    m, hx, hy, hz, xx, xy, yy, xz, yz, zz = pi
    half = (xx + yy + zz) / 2
    return mp.matrix([[half - xx, -xy, -xz, hx], [-xy, half - yy, -yz, hy], [-xz, -yz, half - zz, hz], [hx, hy, hz, m]])


def product(A: mp.matrix, S: mp.matrix, B: mp.matrix) -> mp.mpf:
    """Return ``tr(A S Bᵀ)``."""
    left = A * S
    return mp.fsum(left[i, j] * B[i, j] for i in range(4) for j in range(4))


def link_torques(motion: Motion, gravity: mp.matrix, k: int, S: mp.matrix) -> list[mp.mpf]:
    """Return what link k of pseudo-inertia S asks of each joint."""
    found = []
    for D in motion.first[k]:
        weight = D * S[:, 3]
        found.append(product(D, S, motion.acceleration(k)) - mp.fsum(gravity[a] * weight[a] for a in range(3)))
    return found


def rnea(motion: Motion, gravity: mp.matrix, pi: mp.matrix) -> mp.matrix:
    parts = [link_torques(motion, gravity, k, pseudo_inertia(pi[k, :])) for k in range(motion.n)]
    return mp.matrix([mp.fsum(column) for column in zip(*parts)])


def regressor(motion: Motion, gravity: mp.matrix, count: int = 10) -> mp.matrix:
    """Return the torques of a unit of each parameter."""
    units = [pseudo_inertia(mp.eye(10)[c, :]) for c in range(count)]
    return columns([link_torques(motion, gravity, k, S) for k in range(motion.n) for S in units])


def mass_matrix(motion: Motion, pi: mp.matrix) -> mp.matrix:
    M = mp.zeros(motion.n)
    for k in range(motion.n):
        S, D = pseudo_inertia(pi[k, :]), motion.first[k]
        M += mp.matrix([[product(D[i], S, D[j]) for j in range(motion.n)] for i in range(motion.n)])
    return M


def momentum(motion: Motion, pi: mp.matrix) -> mp.matrix:
    """Return p and what kinetic energy changes by with each joint: beta."""
    p, beta = mp.zeros(motion.n, 1), mp.zeros(motion.n, 1)
    for k in range(motion.n):
        S, V = pseudo_inertia(pi[k, :]), motion.speed(k)
        for i in range(motion.n):
            p[i] += product(motion.first[k][i], S, V)
            beta[i] += product(motion.total(motion.second[k][i], motion.qd), S, V)
    return mp.matrix([list(p), list(beta)])


def arm(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frames with any, right and hardly any angle between axes, which joints slide, and bodies."""
    rng = np.random.default_rng(seed)
    frames = np.tile(np.eye(4), (n + 1, 1, 1))
    for k, frame in enumerate(frames):
        turn = ([np.pi / 2, 0, 0], [0, -np.pi / 2, 1e-9], rng.normal(size=3), [1e-9, 0, 0.2])[k % 4]
        frame[:3, :3], frame[:3, 3] = array(series(hat(exact(np.array(turn))))), rng.normal(scale=0.4, size=3)
    bodies = np.zeros((n, 10))
    for body in bodies:
        masses, points = rng.uniform(0.1, 1.0, 6), rng.normal(scale=0.2, size=(6, 3))
        second = sum(m * np.outer(x, x) for m, x in zip(masses, points))  # in this order on every machine
        inertia = np.trace(second) * np.eye(3) - second
        body[0], body[1:4] = sum(masses), sum(m * x for m, x in zip(masses, points))
        body[4:] = inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    return frames, (np.arange(n) == 1) & (n > 3), bodies


def motions(n: int, seed: int) -> list[np.ndarray]:
    """Return q, qd, qdd (5, n): at zero, close to it, at right angles, anywhere, many turns away."""
    rng = np.random.default_rng(seed)
    q = np.stack([np.zeros(n), np.resize([1e-300, -1e-9], n), np.full(n, np.pi / 2), rng.uniform(-3, 3, n)])
    q = np.concatenate([q, rng.uniform(-3, 3, (1, n)) + 2 * np.pi * np.resize([1, -3, 100], n)])
    return [q, *rng.normal(size=(2, 5, n))]


def links(m: Motion) -> mp.matrix:
    return mp.matrix([row for k in range(m.n) for row in m.transform(k + 1).tolist()])


KERNELS: dict[str, tuple[str, Callable[..., mp.matrix]]] = {  # inputs, and the result of one sample
    "forward": ("q", lambda m: m.transform(m.n + 1)),
    "link_transforms": ("q", links),
    "jacobian": ("q", jacobian),
    "jacobian tool": ("q", lambda m: jacobian(m, True)),
    "jacobian_derivative": ("q qd", jacobian_derivative),
    "jacobian_derivative tool": ("q qd", lambda m: jacobian_derivative(m, True)),
    "rnea": ("q qd qdd gravity pi", rnea),
    "mass_matrix": ("q pi", mass_matrix),
    "momentum": ("q qd pi", momentum),
    "rigid_regressor": ("q qd qdd gravity", regressor),
    "gravity_regressor": ("q gravity", lambda m, g: regressor(m, g, 4)),
}


def tables() -> dict[str, Table]:
    """Return the tables of an arm of three joints and of one of five, of which one slides."""
    found: dict[str, Table] = {}
    for n in (3, 5):
        frames, prismatic, bodies = arm(n, n)
        inputs = dict(zip(("q", "qd", "qdd"), motions(n, n))) | {"gravity": GRAVITY, "pi": bodies}
        for name, (needs, call) in KERNELS.items():
            if n > 3 and "regressor" in name:
                continue  # of a hundred numbers a sample
            given = {key: inputs[key] for key in needs.split()}
            rows = [key for key in given if key.startswith("q")]
            fixed = [exact(given[key]) for key in given if key not in rows]

            def made(
                *sample: np.ndarray, robot: Any = (frames, prismatic), call: Any = call, fixed: Any = fixed
            ) -> Any:
                return array(call(Motion(*robot, *map(exact, sample)), *fixed))

            wanted = each(made, *(given[key] for key in rows))
            table = {"fixed": {"frames": frames, "prismatic": prismatic.astype(float)}, "given": given}
            found[f"{name} {n}"] = table | {"wanted": wanted}
    return found
