"""Tables of the limits on a reference."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpmath import mp
from rigid import array, each, exact

Table = dict[str, Any]
NONE = np.full(3, np.nan)  # what is not asked for
Vector = list[Any]


def stopping(distance: Any, a: Any, T: Any) -> Any:
    """Return the velocity v with ``v T + v^2 / (2 a) = distance``."""
    d = max(distance, mp.zero)
    if mp.isinf(d):
        return mp.inf
    return d / T if mp.isinf(a) else mp.sqrt((a * T) ** 2 + 2 * a * d) - a * T


def scaled(wanted: Vector, bounds: list[Vector], bits: list[int]) -> tuple[Vector, Any]:
    ratio = min([mp.one, *(top / abs(v) for v, top in zip(wanted, bounds[2]) if v)])
    for i, v in enumerate(wanted):
        bits[i] |= 2 * (abs(v) > bounds[2][i])
    return [v * ratio for v in wanted], ratio


def within(
    wanted: Vector, last: Vector, bounds: list[Vector], room: list[tuple[Any, Any]], T: Any, bits: list[int]
) -> Vector:
    found = []
    for i, (v, before, step) in enumerate(zip(wanted, last, [a * T for a in bounds[3]])):
        for bit, (low, high) in ((4, (before - step, before + step)), (8, room[i])):
            bits[i] |= bit * (v < low or v > high)
            v = min(max(v, low), high)
        found.append(v)
    return found


def refusal(q: Vector, bounds: list[Vector], T: Any, asked: np.ndarray) -> int:
    for i in range(len(q)):
        if not all(np.isfinite(row[i]) for row in asked if not np.isnan(row).all()):
            return i + 1
        if not np.isnan(asked[0]).all() and abs(mp.mpf(float(asked[0][i])) - q[i]) > bounds[4][i] + bounds[2][i] * T:
            return -(i + 1)
    return 0


def limited(sent: np.ndarray, limits: np.ndarray, period: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Return position, velocity, speed, bits, and (ratio, refusal, 0), each (3,)."""
    (q, v_last, f_last), bounds, T = (exact(sent).tolist()), exact(limits).tolist(), mp.mpf(float(period[0]))
    refused = refusal(q, bounds, T, asked)
    asked = np.tile(NONE, (3, 1)) if refused else asked
    q_ref, q_last, qd_ref = (None if np.isnan(row).all() else list(exact(row)) for row in asked)
    bits = [int(q_ref is not None and not low <= r <= high) for r, low, high in zip(q_ref or q, *bounds[:2])]
    room = [(-stopping(x - low, a, T), stopping(high - x, a, T)) for x, low, high, _, a, _ in zip(q, *bounds)]
    wanted = qd_ref or [mp.zero] * 3
    if q_ref is not None:
        late = [last - x for last, x in zip(q_last or q_ref, q)]
        catching = [
            e / T if abs(e) <= a * T**2 else mp.sign(e) * stopping(abs(e), a, T) for e, a in zip(late, bounds[3])
        ]
        wanted = [(r - last) / T + fast for r, last, fast in zip(q_ref, q_last or q_ref, catching)]
    wanted, ratio = scaled(wanted, bounds, bits)
    v = f = within(wanted, v_last, bounds, room, T, bits)
    if q_ref and qd_ref:
        f, _ = scaled([min(max(f, x - a * T), x + a * T) for f, x, a in zip(qd_ref, v, bounds[3])], bounds, bits)
    f = within(f, f_last, bounds, room, T, bits)
    free = [x + speed * T for x, speed in zip(q, v)]
    moved = [min(max(new, min(low, x)), max(high, x)) for new, x, low, high in zip(free, q, *bounds[:2])]
    v = [speed if new == to else (to - x) / T for speed, new, to, x in zip(v, free, moved, q)]
    return np.array([array(row) for row in (moved, v, f, [mp.mpf(b) for b in bits], [ratio, mp.mpf(refused), mp.zero])])


def samples(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return states and references: followed, late, too far, near and beyond limits, without limits, refused."""
    count = 26
    period = np.resize([4e-3, 0.0241, 1e-3], count)[:, None]
    bounds = np.stack([np.full((count, 3), v) for v in (-2.0, 2.5, 1.5, 8.0, np.inf)], axis=1)
    bounds[:, 2:4] *= rng.uniform(0.5, 2.0, (count, 2, 3))
    q, v = rng.uniform(-1.9, 2.4, (count, 3)), rng.uniform(-0.3, 0.3, (count, 3))
    last = q + rng.uniform(-1, 1, (count, 3)) * np.resize([1e-2, 1e-5, 1e-9, 0.5], count)[:, None]
    ref = last + rng.uniform(-1, 1, (count, 3)) * np.resize([1e-3, 1e-4, 1e-2], count)[:, None]
    speed = rng.uniform(-3, 3, (count, 3))
    speed[::2] *= 0.1
    asked = np.stack([ref, last, speed], axis=1)
    asked[:12, 2], asked[12:17, :2], asked[17, :], asked[20, 1] = np.nan, np.nan, np.nan, np.nan
    q[3] = asked[3, 0] + [1e-16, -1e-300, 1e-12]
    q[4], q[13], q[21] = ([-2 + 1e-9, 2.5 - 1e-12, 2.5], [-2.0, 2.5 - 1e-6, 2.4999], [-2.1, 2.6, 2.5 + 1e-12])
    asked[21, :2] = q[21] + [[0.01, -0.01, -0.01]]
    bounds[5, 3], bounds[14, 3], bounds[15, :4] = np.inf, [1e-6, 1e6, 8.0], np.array([-1, 1, 1, 1])[:, None] * np.inf
    bounds[5, :2] = [[-np.inf], [np.inf]]
    bounds[6, 2], bounds[7, 2] = [1e-6, 1e3, 1.0], 1e-9
    bounds[22, 4], bounds[23, 4] = 0.01, 0.01
    asked[22, 0, 1] += 1.0
    asked[23, 2, 2] = np.inf
    return {"sent": np.stack([q, v, v * 0.9], axis=1), "bounds": bounds, "period": period, "asked": asked}


def tables() -> dict[str, Table]:
    """Return the table of one kernel, of which every sample gives five rows."""
    given = samples(np.random.default_rng(23))
    wanted = each(limited, *given.values())
    return {"limit_reference": {"given": given, "wanted": wanted.reshape(-1, 3)}}
