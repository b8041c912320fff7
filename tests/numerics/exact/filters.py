"""Tables of the kernels of signals, movement primitives, friction and the momentum filter.

Linear systems are matrix exponentials of the system with its input, minima are roots of their gradients.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from mpmath import mp
from rigid import array, blocks, exact, series

Table = dict[str, Any]
RATE, DAMPING, LAG, STEP = 40.0, 0.3, 0.05, 0.004
CENTRES = np.array([-1.0, 0.0, 0.2, 0.9, 1.0])
WIDTHS = np.array([0.5, 0.1, 0.3, 0.02, 0.7])
SPRINGS = {"canonical": (25.0, 156.25), "time": (25.0, 900.0), "periodic": (4.0, 1.0)}  # critical, under, over
DECAY, PACE, TAU = 1.5, 0.7, 0.8


def signal(kind: str, x: np.ndarray) -> list[mp.mpf]:
    """Return the outputs to samples x with equal steps, first output as the operator says, without init."""
    h, w, z = mp.mpf(STEP), mp.mpf(RATE), mp.mpf(DAMPING)
    values = [mp.mpf(float(value)) for value in x]
    y, v = (mp.mpf(0), mp.mpf(0)) if kind in ("trapezoid", "difference") else (values[0], mp.mpf(0))
    y = h * values[0] if kind == "euler" else y
    A = mp.matrix([[0, 1, 0, 0], [-w * w, -2 * z * w, w * w, 0], [0, 0, 0, 1], [0, 0, 0, 0]])
    move, a = series(A * h), mp.exp(-h / mp.mpf(LAG))
    found = [(y, v)]
    for before, now in pairwise(values):
        if kind in ("lowpass", "slope", "notch"):
            y, v, *_ = move * mp.matrix([y, v, before, (now - before) / h])
        else:
            y = {
                "trapezoid": y + h * (now + before) / 2,
                "euler": y + h * now,
                "difference": (now - before) / h,
                "exponential": a * y + (1 - a) * now,
            }[kind]
        found.append((y, v))
    if kind == "notch":
        return [now - 2 * z / w * v for now, (_, v) in zip(values, found)]
    return [v if kind == "slope" else y for y, v in found]


def kernels(phase: str, x: mp.mpf) -> mp.matrix:
    off = [x - c for c in exact(CENTRES)]
    off = [2 * mp.sin(d / 2) for d in off] if phase == "periodic" else off
    psi = [mp.exp(-(d**2) / (2 * mp.mpf(float(s)) ** 2)) for d, s in zip(off, WIDTHS)]
    largest = max(psi)
    psi = [p if p >= largest * mp.exp(-40) else mp.mpf(0) for p in psi]  # faded, as is said
    return mp.matrix(psi) / mp.fsum(psi)


def bells(x: mp.mpf) -> mp.matrix:
    """Return the Gaussians of friction, which end where their centres do."""
    x = min(max(x, exact(CENTRES)[0]), exact(CENTRES)[len(CENTRES) - 1])
    psi = [mp.exp(-(((x - c) / mp.mpf(float(s))) ** 2)) for c, s in zip(exact(CENTRES), WIDTHS)]
    return mp.matrix(psi) / mp.fsum(psi)


def forcing(phase: str, x: mp.mpf, weights: mp.matrix) -> mp.matrix:
    late = min(max((x - 1) / mp.mpf(0.1), mp.mpf(0)), mp.mpf(1))
    left = {"periodic": mp.mpf(1), "canonical": x, "time": 1 - late**3 * (late * (6 * late - 15) + 10)}[phase]
    return weights.T * kernels(phase, x) * left


def rollout(phase: str, t: np.ndarray, weights: np.ndarray, ends: np.ndarray) -> mp.matrix:
    """Return y, yd, ydd (N, 3 n): spring and damper under the quadratic through three forces, step by step."""
    alpha, stiffness = (mp.mpf(value) for value in SPRINGS[phase])
    y, v, g, scale = (exact(end) for end in ends)
    tau, W, times = mp.mpf(TAU), exact(weights), exact(t)
    z, n = tau * v, weights.shape[1]

    def force(s: mp.mpf) -> mp.matrix:
        f = forcing(phase, mp.exp(-mp.mpf(DECAY) * s) if phase == "canonical" else mp.mpf(PACE) * s, W)
        return mp.matrix([f[i] * scale[i] for i in range(n)])

    def row(s: mp.mpf) -> list[mp.mpf]:
        pull = stiffness * (g - y) - alpha * z + force(s)
        return [*y, *(z / tau), *(pull / tau**2)]

    rows = [row(mp.mpf(0))]
    for k in range(1, len(t)):
        r, s = (times[k] - times[k - 1]) / tau, (times[k - 1] - times[0]) / tau
        f0, f1, f2 = (force(s + r * share) for share in (mp.mpf(0), mp.mpf(1) / 2, mp.mpf(1)))
        linear, curve = (4 * f1 - 3 * f0 - f2) / r, 4 * (f0 - 2 * f1 + f2) / r**2
        A = mp.zeros(5)  # of y - g, z, and what is left of the force and its derivatives
        A[0, 1], A[1, 0], A[1, 1], A[1, 2], A[2, 3], A[3, 4] = 1, -stiffness, -alpha, 1, 1, 1
        move = series(A * r)
        after = [move * mp.matrix([y[i] - g[i], z[i], f0[i], linear[i], curve[i]]) for i in range(n)]
        y, z = mp.matrix([a[0] + g[i] for i, a in enumerate(after)]), mp.matrix([a[1] for a in after])
        rows.append(row(s + r))
    return mp.matrix(rows)


def filtered(x: Any, P: Any, G: Any, u: Any, y: Any, R: Any, h: Any, Qp: Any, q: Any, a: Any) -> mp.matrix:
    """Return state and covariance: the step by Van Loan's exponential, then Bayes' rule for the measurement."""
    n, m = G.rows, G.cols
    F = blocks([[mp.zeros(n), G], [mp.zeros(m, n), mp.diag([-value for value in a])]])
    Q, size = mp.diag([*Qp, *q]), max(*Qp, *q)  # the noise grows with it, and a small matrix has a short series
    both = series(blocks([[-F, Q / size], [mp.zeros(n + m), F.T]]) * h[0])
    Phi = mp.matrix([[both[n + m + j, n + m + i] for j in range(n + m)] for i in range(n + m)])
    noise = size * Phi * mp.matrix([[both[i, n + m + j] for j in range(n + m)] for i in range(n + m)])
    x = Phi * x + mp.matrix([*(h[0] * u), *mp.zeros(m, 1)])
    P = Phi * P * Phi.T + noise
    H = blocks([[mp.eye(n), mp.zeros(n, m)]])
    P_after = mp.inverse(mp.inverse(P) + H.T * mp.inverse(R) * H)
    return blocks([[x + P_after * H.T * mp.inverse(R) * (y - H * x), P_after]])


def rubbed(friction: np.ndarray, ripple: np.ndarray, q: np.ndarray, qd: np.ndarray, z: np.ndarray) -> list[mp.mpf]:
    """Return the torque of friction and ripple of each joint."""
    found = []
    for row, line, *state in zip(friction.T, ripple.T, q, qd, z):
        (b, up, down, offset, stribeck, speed, _, _, root, smooth), (cycles, c, s) = exact(row), exact(line)
        angle, rate, side = (mp.mpf(float(value)) for value in state)
        side = mp.tanh(rate / smooth) if smooth else side
        dry = up * max(side, 0) + down * min(side, 0)
        dry += stribeck * side * mp.exp(-((rate / speed) ** 2)) + root * side * mp.sqrt(abs(rate))
        found.append(b * rate + dry + offset + c * mp.cos(cycles * angle) + s * mp.sin(cycles * angle))
    return found


def states(q: np.ndarray, delta: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Return the presliding state of each joint along positions."""
    found = np.zeros(q.shape)
    for i in range(q.shape[1]):
        rows, (length, half) = exact(q[:, i]), exact(np.array([delta[i], resolution[i]]))
        play, z = rows[0], mp.mpf(0)
        for k, at in enumerate(rows):
            moved = min(max(play, at - half), at + half)
            dy, play = moved - play, moved
            z = mp.sign(dy) + (z - mp.sign(dy)) * mp.exp(-abs(dy) / length)
            found[k, i] = array([z])[0]
    return found


def motions(rng: np.random.Generator) -> dict[str, Table]:
    t, weights, ends = np.cumsum(rng.uniform(1e-3, 0.2, 9)), rng.normal(size=(5, 2)), rng.normal(size=(4, 2))
    x = np.array([-3.0, 0.0, 1e-300, 1e-9, 0.05, 0.5, 0.95, 1.0, 1.04, 1.2, 50.0])
    found: dict[str, Table] = {}
    for phase, spring in SPRINGS.items():
        fixed = {"centres": CENTRES, "widths": WIDTHS, "weights": weights, "rates": np.array([*spring, DECAY, PACE])}
        each = np.array([array(kernels(phase, mp.mpf(float(v)))) for v in x])
        found[f"basis {phase}"] = {"fixed": fixed, "given": {"x": x}, "wanted": each}
        whole = array(rollout(phase, t, weights, ends))
        given = {"t": t, "tau": np.array(TAU), "ends": ends}
        for k, name in enumerate(("y", "yd", "ydd")):
            wanted = np.ascontiguousarray(whole[None, :, 2 * k : 2 * k + 2])
            found[f"rollout {phase} {name}"] = {"fixed": fixed, "given": given, "wanted": wanted}
    wanted = np.array([array(bells(mp.mpf(float(v)))) for v in x])
    found["basis_weights"] = {"given": {"x": x, "centres": CENTRES, "widths": WIDTHS}, "wanted": wanted}
    return found


def square(root: np.ndarray) -> np.ndarray:
    """Return ``root rootᵀ``, summed in the same order on every machine."""
    return np.sum([np.outer(column, column) for column in root.T], axis=0)


def estimates(rng: np.random.Generator) -> dict[str, Table]:
    found: dict[str, Table] = {}
    n, m = 3, 2
    root, spread = rng.normal(size=(n + m, n + m)), rng.normal(size=(n, n))
    given = {
        "x": rng.normal(size=n + m), "P": square(root), "G": rng.normal(size=(n, m)), "u": rng.normal(size=n),
        "y": rng.normal(size=n), "R": 1e-3 * square(spread), "h": np.array([STEP]), "Qp": rng.uniform(0.1, 1, n),
        "q": rng.uniform(0.1, 1, m), "a": np.array([0.0, 6.0]),
    }  # fmt: skip
    for name in ("P", "R"):
        given[name] = (given[name] + given[name].T) / 2
    whole = array(filtered(*(exact(value) for value in given.values())))
    for k, wanted in enumerate((whole[:, 0], whole[:, 1:])):
        found[f"momentum_step {k}"] = {"given": given, "wanted": np.ascontiguousarray(wanted[None])}
    return found | wandered(rng)


def wandered(rng: np.random.Generator) -> dict[str, Table]:
    """Return the covariance that inputs with leaks of all sizes give to the momentum, which is hardly measured."""
    found: dict[str, Table] = {}
    for leak in (1e-9, 0.02, 0.3, 0.99, 1.01, 30.0):  # in a step
        given = {
            "x": np.zeros(4), "P": np.zeros((4, 4)), "G": rng.normal(size=(2, 2)), "u": np.zeros(2), "y": np.ones(2),
            "R": 1e9 * np.eye(2), "h": np.array([STEP]), "Qp": np.full(2, 1e-30), "q": np.array([1.0, 0.5]),
            "a": np.array([leak, 0.98 * leak]) / STEP,
        }  # fmt: skip
        P = array(filtered(*(exact(value) for value in given.values()))[:, 1:])
        found[f"momentum_step wandered {leak}"] = {"given": given, "wanted": np.ascontiguousarray(P[None, :2, :2])}
    return found


def tables() -> dict[str, Table]:
    """Return all of them."""
    rng = np.random.default_rng(17)
    x = rng.normal(size=12)
    found: dict[str, Table] = {}
    for kind in ("trapezoid", "euler", "difference", "exponential", "lowpass", "slope", "notch"):
        constants = np.array([LAG if kind == "exponential" else RATE, DAMPING, STEP])
        found[f"SignalOperator {kind}"] = {
            "given": {"x": x, "constants": constants},
            "wanted": array(signal(kind, x))[None],
        }
    friction = np.abs(rng.normal(size=(10, 3)))
    friction[2], friction[9] = -friction[2], [0.0, 0.1, 1e-6]
    ripple, q, qd, z = (
        rng.normal(size=(3, 3)) * 3,
        rng.normal(size=(6, 3)),
        rng.normal(size=(6, 3)),
        rng.uniform(-1, 1, (6, 3)),
    )
    qd[0], qd[1] = 0.0, 1e-300
    torque = np.array([array(rubbed(friction, ripple, *rows)) for rows in zip(q, qd, z)])
    given = {"friction": friction, "ripple": ripple, "q": q, "qd": qd, "z": z}
    found["Drive"] = {"given": given, "wanted": torque}
    q = np.cumsum(rng.normal(size=(20, 2)) * 1e-3, axis=0)
    given = {"q": q, "delta": np.array([1e-3, 5e-4]), "resolution": np.array([1e-4, 0.0])}
    found["presliding"] = {"given": given, "wanted": states(*given.values())[None]}
    return found | motions(rng) | estimates(rng)
