"""Tables of the kernels of rotations, rigid motions and quaternions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from mpmath import mp
from rigid import (
    array,
    commutator,
    each,
    exact,
    hat,
    logarithm,
    nearest,
    part,
    pose,
    position_of,
    quaternion,
    rotation_of,
    series,
    twist,
    twist_hat,
    vee,
)

Table = dict[str, Any]
SMALL = [0.0, 1e-300, 1e-160, 1e-20, 1e-9, 1e-4]
TURNS = [*SMALL, 0.1, 0.4999, 0.5, 1.0, 2.0, 3.0, np.pi - 1e-3, np.pi - 1e-9]
BEYOND = [np.pi, 4.5, 6.2, 20.0]  # an exponential has no end
FAR = [1.0, 1e6, 1e-6]  # m


def vectors(turns: list[float], seed: int) -> np.ndarray:
    u = np.random.default_rng(seed).standard_normal((len(turns), 3))
    return np.array(turns)[:, None] * u / np.linalg.norm(u, axis=-1, keepdims=True)


def twists(turns: list[float], seed: int) -> np.ndarray:
    v = np.random.default_rng(seed + 1).standard_normal((len(turns), 3))
    return np.concatenate([v * np.resize(FAR, len(turns))[:, None], vectors(turns, seed)], axis=-1)


def rotations(turns: list[float], seed: int) -> np.ndarray:
    return np.array([array(series(hat(exact(w)))) for w in vectors(turns, seed)])


def motions(turns: list[float], seed: int) -> np.ndarray:
    T = np.tile(np.eye(4), (len(turns), 1, 1))
    T[:, :3, :3] = rotations(turns, seed)
    T[:, :3, 3] = twists(turns, seed)[:, :3]
    return T


def table(call: Callable[..., Any], **given: np.ndarray) -> Table:
    """Return inputs and, sample by sample, what `call` makes of them without rounding."""
    return {"given": given, "wanted": each(lambda *sample: array(call(*map(exact, sample))), *given.values())}


def along(R_a: mp.matrix, R_b: mp.matrix, s: mp.matrix) -> mp.matrix:
    R_a = nearest(R_a)
    return R_a * series(hat(logarithm(R_a.T * nearest(R_b)) * s[0]))


def screw(T_a: mp.matrix, T_b: mp.matrix, s: mp.matrix) -> mp.matrix:
    T_a, T_b = (pose(rotation_of(T), position_of(T)) for T in (T_a, T_b))
    return T_a * series(twist_hat(twist(mp.inverse(T_a) * T_b) * s[0]))


def line(T_a: mp.matrix, T_b: mp.matrix, s: mp.matrix) -> mp.matrix:
    p = position_of(T_a) + s[0] * (position_of(T_b) - position_of(T_a))
    return pose(along(rotation_of(T_a), rotation_of(T_b), s), p)


def adjoint(T: mp.matrix) -> mp.matrix:
    """Return what ``T hat(e) T^-1`` is of each unit twist e."""
    T = pose(rotation_of(T), position_of(T))
    columns = [T * twist_hat(mp.eye(6)[:, k]) * mp.inverse(T) for k in range(6)]
    return mp.matrix([[*position_of(c), *vee(part(c, range(3), range(3)))] for c in columns]).T


def product(p: mp.matrix, q: mp.matrix) -> mp.matrix:
    """Return the product of quaternions by the table of i, j and k."""
    w, x, y, z = p
    return mp.matrix([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]) * q


def slerp(a: mp.matrix, b: mp.matrix, s: mp.matrix) -> mp.matrix:
    a, b = a / mp.norm(a), b / mp.norm(b)
    cosine = (a.T * b)[0]
    b, cosine = (-b, -cosine) if cosine < 0 else (b, cosine)
    angle = mp.atan2(mp.norm(b - cosine * a), cosine)
    if not angle:
        return a
    return (mp.sin((1 - s[0]) * angle) * a + mp.sin(s[0] * angle) * b) / mp.sin(angle)


def turned(q: mp.matrix) -> mp.matrix:
    """Return the matrix of ``x -> q x q*``."""
    q = q / mp.norm(q)
    back = mp.matrix([q[0], -q[1], -q[2], -q[3]])
    columns = [product(product(q, mp.matrix([0, *mp.eye(3)[:, k]])), back) for k in range(3)]
    return mp.matrix([list(c)[1:] for c in columns]).T


def angles(axes: str) -> tuple[np.ndarray, Callable[[mp.matrix], mp.matrix]]:
    """Return angles apart from gimbal lock, and the product of the three turns."""
    rng = np.random.default_rng(31)
    values = rng.uniform(-3.1, 3.1, (12, 3))
    values[:, 1] = rng.uniform(0.05, 3.09, 12) if axes == "zyz" else rng.uniform(-1.5, 1.5, 12)
    values[:3, 0], values[3:6, 2] = (1e-300, 1e-9, 3.14159), (-1e-160, -1e-9, -3.14159)

    def turn(three: mp.matrix) -> mp.matrix:
        a, b, c = (series(hat(mp.eye(3)["xyz".index(axis), :] * x)) for axis, x in zip(axes, three))
        return a * b * c

    return values, turn


def euler() -> dict[str, Table]:
    found: dict[str, Table] = {}
    for axes in ("zyx", "xyz", "zyz"):
        values, turn = angles(axes)
        found[f"euler_from_rpy {axes}"] = table(turn, rpy=values)
        R = np.array([array(turn(exact(row))) for row in values])

        def back(R: mp.matrix, start: mp.matrix, turn: Callable[[mp.matrix], mp.matrix] = turn) -> mp.matrix:
            R, x = nearest(R), start
            for _ in range(4):  # Newton, by differences of 40 digits: angles whose turns make R
                error = logarithm(turn(x).T * R)
                step = mp.mpf(10) ** -40
                columns = [logarithm(turn(x).T * turn(x + step * mp.eye(3)[:, k])) / step for k in range(3)]
                x = x + mp.inverse(mp.matrix([list(c) for c in columns]).T) * error
            return x

        found[f"euler_to_rpy {axes}"] = table(back, R=R, start=values)
        del found[f"euler_to_rpy {axes}"]["given"]["start"]
    return found


def tables() -> dict[str, Table]:
    """Return all of them."""
    w, xi = vectors([*TURNS, *BEYOND], 1), twists([*TURNS, *BEYOND], 2)
    R, R2, T, T2 = rotations(TURNS, 3), rotations(TURNS[::-1], 4), motions(TURNS, 5), motions(TURNS[::-1], 6)
    s = np.resize([0.0, 0.3, 0.5, 0.7, 1.0, 1e-9], len(TURNS))[:, None]
    q, q2 = (np.array([array(quaternion(exact(M))) for M in matrices]) for matrices in (R, R2))
    return {
        "so3_exp": table(lambda w: series(hat(w)), w=w),
        "so3_exp small": table(lambda w: series(hat(w)), w=vectors(SMALL, 1)),
        "so3_log": table(logarithm, R=R),
        "so3_angle": table(lambda a, b: [mp.norm(logarithm(nearest(a).T * nearest(b)))], R_a=R, R_b=R2),
        "so3_left_jacobian": table(lambda w: series(hat(w), 1), w=w),
        "so3_left_jacobian_inv": table(lambda w: mp.inverse(series(hat(w), 1)), w=w[:-2]),
        "so3_interpolate": table(along, R_a=R, R_b=R2, s=s),
        "se3_exp": table(lambda xi: series(twist_hat(xi)), xi=xi),
        "se3_log": table(twist, T=T),
        "se3_inv": table(lambda T: mp.inverse(pose(rotation_of(T), position_of(T))), T=T),
        "se3_adjoint": table(adjoint, T_a_b=T),
        "se3_transform_wrench": table(lambda T, f: mp.inverse(adjoint(T)).T * f, T_a_b=T, wrench_b=xi[: len(T)]),
        "se3_left_jacobian": table(lambda xi: series(commutator(xi), 1), xi=xi),
        "se3_left_jacobian_inv": table(lambda xi: mp.inverse(series(commutator(xi), 1)), xi=xi[:-2]),
        "se3_interpolate": table(line, T_a=T, T_b=T2, s=s),
        "se3_interpolate screw": table(screw, T_a=T, T_b=T2, s=s),
        "quaternion_from_matrix": table(quaternion, R=R),
        "quaternion_to_matrix": table(turned, quaternion=q),
        "quaternion_multiply": table(product, p=q, q=q2),
        "quaternion_slerp": table(slerp, a=q, b=q2, s=s),
        **euler(),
    }
