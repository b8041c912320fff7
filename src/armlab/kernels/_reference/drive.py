"""Torque of the drives: friction with its presliding state, and torque ripple (specification; the compiled twin is
native/drive.h).

With s = z, or s = tanh(qd / smooth_speed) where smooth_speed > 0, joint by joint::

    dry = coulomb_pos max(s, 0) + coulomb_neg min(s, 0) + stribeck s exp(-(qd / stribeck_speed)^2) + root s sqrt(|qd|)
    tau = viscous qd + dry_share dry + offset + cosine cos(cycles q) + sine sin(cycles q)

dry_share is 1, less for an estimator that takes dry friction near rest as bounded instead of known.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import read, result, same_shape
from armlab.kernels._reference.chain import Chain

__all__ = ["Drive", "DriveState", "drive_torque", "model_torque", "move", "presliding", "slide", "start"]


class DriveState:
    """What the drives remember: the position y that follows with a play, and the presliding state z, both (n,)."""

    def __init__(self, play: np.ndarray, z: np.ndarray) -> None:
        self.play, self.z = play, z


class Drive:
    """Drives of n joints.

    Parameters
    ----------
    friction : (10, n) rows viscous, coulomb_pos, coulomb_neg, offset, stribeck, stribeck_speed, delta, resolution,
        root, smooth_speed.
    ripple : (3, n) rows cycles, cosine, sine.
    """

    def __init__(self, friction: np.ndarray, ripple: np.ndarray) -> None:
        friction = read(friction, "friction", np.shape(friction)[-1:])
        self.n = friction.shape[-1]
        self.friction = read(friction, "friction", (10, self.n), exact=True).copy()
        self.ripple = read(ripple, "ripple", (3, self.n), exact=True).copy()

    def torque(self, q: np.ndarray, qd: np.ndarray, z: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the torque (..., n) at positions, velocities and presliding states (..., n)."""
        q, qd, z = (read(a, name, (self.n,)) for a, name in ((q, "q"), (qd, "qd"), (z, "z")))
        same_shape(qd, "qd", q, "q")
        same_shape(z, "z", q, "q")
        return result(drive_torque(self, q, qd, z), out)


def start(drive: Drive, q: np.ndarray) -> DriveState:
    """Return the state at the first position (n,) of a record."""
    return DriveState(q.copy(), np.zeros(drive.n))


def move(drive: Drive, q: np.ndarray, state: DriveState) -> tuple[DriveState, np.ndarray]:
    """Return the state at position q (n,) and the displacement (n,) that the encoder can tell."""
    delta, resolution = drive.friction[6], drive.friction[7]
    play = np.clip(state.play, q - resolution, q + resolution)
    dy = play - state.play
    return DriveState(play, slide(state.z, dy, delta)), dy


def drive_torque(drive: Drive, q: np.ndarray, qd: np.ndarray, z: np.ndarray, dry_share: Any = 1.0) -> np.ndarray:
    """Return the torque (..., n), of which dry friction counts by `dry_share`."""
    viscous, positive, negative, offset, stribeck, speed, _, _, root, smooth = drive.friction
    cycles, cosine, sine = drive.ripple
    s = np.where(smooth > 0, np.tanh(qd / np.where(smooth > 0, smooth, 1.0)), z)
    dry = positive * np.maximum(s, 0) + negative * np.minimum(s, 0)
    dry = dry + stribeck * s * np.exp(-((qd / speed) ** 2)) + root * s * np.sqrt(np.abs(qd))
    return viscous * qd + dry_share * dry + offset + cosine * np.cos(cycles * q) + sine * np.sin(cycles * q)


def model_torque(
    chain: Chain,
    gravity: np.ndarray,
    links: np.ndarray,
    rotor: np.ndarray,
    drive: Drive,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Return ``rnea + rotor qdd + drives`` (N, n) along a record, with z from 0 at the first row.

    A row with a number that is not finite gives NaN and leaves the state of the drives alone.

    Parameters
    ----------
    chain, gravity, links, rotor : of the rigid body, see `Chain.rnea`; rotor (n,).
    drive : of as many joints.
    q, qd, qdd : (N, n) in time order.
    out : (N, n) to write into.
    """
    n = chain.n
    rotor = read(rotor, "rotor", (n,), exact=True)
    if drive.n != n:
        raise ShapeError(f"Expected a drive of {n} joints like the chain, got {drive.n}.")
    q = read(q, "q", (np.size(q) // n, n), exact=True)
    qd, qdd = read(qd, "qd", q.shape, exact=True), read(qdd, "qdd", q.shape, exact=True)
    tau = np.full(q.shape, np.nan)
    good = np.isfinite(q).all(axis=1) & np.isfinite(qd).all(axis=1) & np.isfinite(qdd).all(axis=1)
    tau[good] = chain.rnea(q[good], qd[good], qdd[good], gravity, links) + rotor * qdd[good]
    state = None
    for k in np.flatnonzero(good):
        state, _ = move(drive, q[k], start(drive, q[k]) if state is None else state)
        tau[k] += drive_torque(drive, q[k], qd[k], state.z)
    return result(tau, out)


def presliding(q: np.ndarray, delta: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Return the presliding state z (N, n) in [-1, 1] along positions `q` (N, n) [rad], from 0 at the first row.

    ``z_k = s + (z_{k-1} - s) exp(-|dy_k| / delta)``, s = sign(dy_k), where y follows q with a play of +-resolution, so
    that the last digit of an encoder at rest does not wear the state down. A row with a NaN gives NaN and changes
    nothing.

    Parameters
    ----------
    q : (N, n) positions in time order.
    delta : (n,) presliding distance [rad].
    resolution : (n,) half the play [rad].
    """
    q = np.asarray(q, dtype=float)
    z = np.zeros(q.shape)
    current = np.zeros(q.shape[1])
    play, started = np.zeros(q.shape[1]), False
    for k, row in enumerate(q):
        if not np.all(np.isfinite(row)):
            z[k] = np.nan
            continue
        if not started:
            play, started = row.copy(), True
        moved = np.clip(play, row - resolution, row + resolution)
        current, play = slide(current, moved - play, delta), moved
        z[k] = current
    return z


def slide(z: np.ndarray, dy: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """Advance the state z (n,) by the displacement dy (n,)."""
    sign = np.sign(dy)
    return sign + (z - sign) * np.exp(-np.abs(dy) / delta)
