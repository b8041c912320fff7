"""Limits on one reference before it goes to a robot (specification; the compiled twin is native/limits.cpp)."""

from __future__ import annotations

import numpy as np

__all__ = ["limit_reference"]

POSITION, VELOCITY, ACCELERATION, BRAKING = 1, 2, 4, 8
_SLACK = 1e-9  # relative: rounding is not a clamp


def limit_reference(
    sent: np.ndarray,
    bounds: np.ndarray,
    period: float,
    q_ref: np.ndarray | None = None,
    q_last: np.ndarray | None = None,
    qd_ref: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Return the reference to send next: where it is, how it moves, which limits acted, and whether it was refused.

    With T the period, a the acceleration limit, and ``S(d)`` the fastest step velocity from which braking in steps of
    a T ends within d (``S <= sqrt(2 a d)``; exact in discrete time, so it never asks for more than a)::

        position   v* = v_r + sign(e) S(|e|),  e = q_last - q,  v_r = (q_ref - q_last) / T
                   that is (q_ref - q) / T when the reference can be followed, and catching up without overshoot
        velocity   v* = qd_ref;      hold   v* = 0
        v* is scaled for all joints by one ratio so that |v*| <= qd_max
        v  = v* within v_prev +- a T, then within [-S(q - q_min), S(q_max - q)]
        q' = q + v T, kept within the limits; a joint that is outside may only come back

    The speed sent is v, or qd_ref through the same limits when both are given.

    Parameters
    ----------
    sent : (3, n) previous reply: position, step velocity, speed.
    bounds : (5, n) q_min, q_max, qd_max, qdd_max, jump; infinite where there is no limit.
    period : T, seconds.
    q_ref : (n,) position asked for, or None.
    q_last : (n,) position asked for before this one; None when there was none.
    qd_ref : (n,) velocity asked for, or None. Without both the arm is brought to rest.

    Returns
    -------
    (3, n) new `sent`; (n,) uint8 bits (1 position, 2 velocity, 4 acceleration, 8 braking); both are read-only;
    velocity ratio in (0, 1]; 0, or i when joint i (from 1) is not finite, or -i when it jumps by more than
    ``jump + qd_max T``. A refused reference holds instead.
    """
    q, v_last, f_last = sent
    q_min, q_max, qd_max, qdd_max, jump = bounds
    refused = _refusal(q, q_ref, q_last, qd_ref, jump + qd_max * period)
    if refused:
        q_ref = q_last = qd_ref = None
    bits = np.zeros(len(q), dtype=np.uint8)
    step = qdd_max * period
    room = (-_brakeable(q - q_min, qdd_max, period), _brakeable(q_max - q, qdd_max, period))

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

    v, ratio = _within(wanted, v_last, qd_max, step, room, bits)
    f, _ = _within(v if q_ref is None or qd_ref is None else qd_ref, f_last, qd_max, step, room, bits)
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


def _brakeable(distance: np.ndarray, a: np.ndarray, period: float) -> np.ndarray:
    """Return S(d): from v in [k a T, (k + 1) a T] steps of a T cover ``T ((k + 1) v - a T k (k + 1) / 2) = d``."""
    unlimited = np.isinf(distance) | np.isinf(a)
    d, a = np.where(unlimited, 1.0, np.maximum(distance, 0.0)), np.where(np.isinf(a), 1.0, a)
    k = np.floor(0.5 * (np.sqrt(1.0 + 8.0 * d / (a * period * period)) - 1.0))
    fastest = d / (period * (k + 1.0)) + 0.5 * a * period * k
    return np.where(unlimited, np.where(distance > 0.0, np.inf, 0.0), fastest)


def _within(
    wanted: np.ndarray,
    last: np.ndarray,
    fastest: np.ndarray,
    step: np.ndarray,
    room: tuple[np.ndarray, np.ndarray],
    bits: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Return a velocity within all limits and the ratio of the first one; note in `bits` which acted."""
    excess = np.abs(wanted) / fastest
    worst = float(excess.max(initial=0.0))
    ratio = 1.0
    if worst > 1.0 + _SLACK:
        ratio = 1.0 / worst
        bits |= np.where(excess > 1.0 + _SLACK, VELOCITY, 0).astype(np.uint8)
        wanted = wanted * ratio
    for low, high, bit in ((last - step, last + step, ACCELERATION), (*room, BRAKING)):
        slack = _SLACK * np.minimum(step, fastest)
        bits |= np.where((wanted < low - slack) | (wanted > high + slack), bit, 0).astype(np.uint8)
        wanted = np.where(wanted < low - slack, low, np.where(wanted > high + slack, high, wanted))
    return wanted, ratio
