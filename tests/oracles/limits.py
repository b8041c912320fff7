"""Limits on one reference before it goes to a robot, and plausibility of its feedback."""

from __future__ import annotations

import numpy as np

POSITION, VELOCITY, ACCELERATION, BRAKING = 1, 2, 4, 8
_SLACK = 1e-9  # relative: rounding is not a clamp


def limit_reference(
    sent: np.ndarray,
    bounds: np.ndarray,
    period: float,
    q_ref: np.ndarray | None = None,
    q_last: np.ndarray | None = None,
    qd_ref: np.ndarray | None = None,
    lag: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, float, int]:
    q, v_last, f_last = sent
    q_min, q_max, qd_max, qdd_max, jump = bounds
    refused = _refusal(q, q_ref, q_last, qd_ref, jump + qd_max * period)
    if refused:
        q_ref = q_last = qd_ref = None
    bits = np.zeros(len(q), dtype=np.uint8)
    step = qdd_max * period
    room = (-_brakeable(q - q_min, qdd_max, period + lag), _brakeable(q_max - q, qdd_max, period + lag))

    reached = np.zeros(len(q), dtype=bool)
    if q_ref is None:
        wanted = np.zeros(len(q)) if qd_ref is None else qd_ref
    else:
        bits |= np.where((q_ref < q_min) | (q_ref > q_max), POSITION, 0).astype(np.uint8)
        before = q_ref if q_last is None else q_last
        behind = before - q
        reached = np.abs(behind) <= step * period
        catching_up = (q_ref - before) / period + np.sign(behind) * _brakeable(np.abs(behind), qdd_max, period)
        wanted = np.where(reached, (q_ref - q) / period, catching_up)

    slowed, ratio = _scaled(wanted, qd_max, bits)
    v = f = _within(slowed, v_last, qd_max, step, room, bits)
    if q_ref is not None and qd_ref is not None:
        f, _ = _scaled(np.clip(qd_ref, v - step, v + step), qd_max, bits)
    f = _within(f, f_last, qd_max, step, room, bits)
    moved = q + v * period
    if q_ref is not None:
        moved = np.where(reached & (v == wanted), q_ref, moved)
    inside = np.clip(moved, np.minimum(q_min, q), np.maximum(q_max, q))
    v = np.where(inside == moved, v, (inside - q) / period)
    sent = np.stack((inside, v, f))
    sent.flags.writeable = bits.flags.writeable = False
    return sent, bits, ratio, refused


def _refusal(
    q: np.ndarray, q_ref: np.ndarray | None, q_last: np.ndarray | None, qd_ref: np.ndarray | None, jump: np.ndarray
) -> int:
    for i in range(len(q)):
        for values in (q_ref, q_last, qd_ref):
            if values is not None and not np.isfinite(values[i]):
                return i + 1
        if q_ref is not None and abs(q_ref[i] - q[i]) > jump[i]:
            return -(i + 1)
    return 0


def _brakeable(distance: np.ndarray, a: np.ndarray, late: float) -> np.ndarray:
    """Return S: the root of ``S late + S^2 / (2 a) = distance``."""
    d, unlimited = np.maximum(distance, 0.0), np.isinf(a)
    with np.errstate(invalid="ignore"):  # infinities, replaced below
        b = np.where(unlimited, 1.0, a) * late
        room = 2.0 * np.where(unlimited, 1.0, a) * d
        fastest = np.where(d > 0.0, room / (np.sqrt(b * b + room) + b), 0.0)
    return np.where(np.isinf(d), np.inf, np.where(unlimited, d / late, fastest))


def _scaled(wanted: np.ndarray, fastest: np.ndarray, bits: np.ndarray) -> tuple[np.ndarray, float]:
    """Return velocities scaled by one ratio so that none is too fast, and the ratio; note in `bits` which were."""
    excess = np.abs(wanted) / fastest
    worst = float(excess.max(initial=0.0))
    if worst <= 1.0 + _SLACK:
        return wanted, 1.0
    bits |= np.where(excess > 1.0 + _SLACK, VELOCITY, 0).astype(np.uint8)
    return wanted / worst, 1.0 / worst


def _within(
    wanted: np.ndarray,
    last: np.ndarray,
    fastest: np.ndarray,
    step: np.ndarray,
    room: tuple[np.ndarray, np.ndarray],
    bits: np.ndarray,
) -> np.ndarray:
    """Return a velocity within the limits of acceleration and braking; note in `bits` which acted."""
    for low, high, bit in ((last - step, last + step, ACCELERATION), (*room, BRAKING)):
        slack = _SLACK * np.minimum(step, fastest)
        bits |= np.where((wanted < low - slack) | (wanted > high + slack), bit, 0).astype(np.uint8)
        wanted = np.where(wanted < low - slack, low, np.where(wanted > high + slack, high, wanted))
    return wanted


def implausible(
    q: np.ndarray, before: np.ndarray | None, bounds: np.ndarray, margin: float, step: float, seconds: float
) -> int:
    q_min, q_max, qd_max = bounds
    beyond = np.maximum(q_min - q, q - q_max) - margin
    if len(q) and not beyond.max() <= 0.0:
        return int(beyond.argmax()) + 1
    excess = -np.ones(1) if before is None or not len(q) else np.abs(q - before) - (step + qd_max * seconds)
    return 0 if excess.max() <= 0.0 else -(int(excess.argmax()) + 1)


def following_error(
    q: np.ndarray,
    reference: np.ndarray,
    speed: np.ndarray,
    fastest: np.ndarray,
    allowed: np.ndarray,
    kept: float,
    lag: float,
) -> tuple[np.ndarray, int, bool]:
    fastest = np.maximum(kept * fastest, np.abs(speed))
    excess = np.abs(reference - q) - (allowed + lag * fastest)
    return (fastest, int(excess.argmax()), bool(excess.max() <= 0.0)) if len(q) else (fastest, 0, True)


def filtered_velocity(q: np.ndarray, last: np.ndarray, velocity: np.ndarray, dt: float, cutoff: float) -> np.ndarray:
    share = 1.0 - np.exp(-2.0 * np.pi * cutoff * dt)
    return velocity + share * ((q - last) / dt - velocity)
