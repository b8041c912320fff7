"""Torque of the drives: friction with presliding state and warmth, friction over position, ripple.

With s = z, or s = tanh(qd / smooth_speed) where smooth_speed > 0, joint by joint::

    coulomb = (coulomb_pos max(s, 0) + coulomb_neg min(s, 0)) (1 + of_coulomb x)
    dry = coulomb + stribeck s exp(-(qd / stribeck_speed)^2) + root s sqrt(|qd|)
    rubbing = viscous (1 + of_viscous x) qd + dry_share dry
    tau = rubbing + offset + cosine cos(cycles q) + sine sin(cycles q) + dry_share map(q, qd, s) + lines(q, qd, s)
          + load dry_share s |x|

x is the torque transmitted to the links, known in a forward model; an estimator has y = x + load dry_share s |x|, the
motor torque less the other terms, so that ``x = y / (1 + load dry_share s sign(y))``.

dry_share is 1, less for an estimator that treats dry friction near rest as bounded instead of known. The warmth x
follows from the joint's own friction heat: ``dx/dt = (|rubbing qd| / reference - x) / time``, exact for constant
power in a step.

With normalised Gaussians psi (`basis_weights`), the map has coefficients over position and speed for both directions,
``(1 + s)/2 psi(q)^T k_pos psi(|qd|) + (1 - s)/2 psi(q)^T k_neg psi(|qd|)``; a line of ripple has amplitudes over speed,
``a(qd) cos(cycles q) + b(qd) sin(cycles q)``, a = psi(qd)^T k, or one for each direction as in the map.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .chain import Chain


class DriveState:
    """State of the drives, each (n,): position y that follows with a play, presliding state z, warmth x."""

    def __init__(self, play: np.ndarray, z: np.ndarray, warmth: np.ndarray) -> None:
        self.play, self.z, self.warmth = play, z, warmth


class Drive:
    """Drives of n joints."""

    def __init__(
        self,
        friction: np.ndarray,
        ripple: np.ndarray,
        lines: tuple[np.ndarray, ...] | None = None,
        map: tuple[np.ndarray, ...] | None = None,
        warm_up: np.ndarray | None = None,
    ) -> None:
        self.friction = np.array(friction, dtype=float)
        self.n = self.friction.shape[-1]
        self.ripple = np.array(ripple, dtype=float)
        self.lines = None if lines is None else [np.asarray(part, dtype=float) for part in lines]
        self.map = None if map is None else [np.asarray(part, dtype=float) for part in map]
        heated = np.zeros((5, self.n)) if warm_up is None else warm_up
        self.warm_up = np.array(heated, dtype=float)

    def torque(self, q: np.ndarray, qd: np.ndarray, z: np.ndarray) -> np.ndarray:
        q, qd, z = (np.asarray(a, dtype=float) for a in (q, qd, z))
        return drive_torque(self, q, qd, DriveState(q, z, self.warm_up[4]))


def basis_weights(x: np.ndarray, centres: np.ndarray, widths: np.ndarray) -> np.ndarray:
    x, centres, widths = (np.asarray(a, dtype=float) for a in (x, centres, widths))
    power = -(((np.clip(x, centres[0], centres[-1])[:, None] - centres) / widths) ** 2)
    weights = np.exp(power - power.max(axis=1, keepdims=True, initial=-1e300))
    return weights / weights.sum(axis=1, keepdims=True)


def start(drive: Drive, q: np.ndarray) -> DriveState:
    """Return the state at the first position (n,) of a record."""
    return DriveState(q.copy(), np.zeros(drive.n), drive.warm_up[4])


def restart(q: np.ndarray, before: DriveState) -> DriveState:
    """Return the state at position q (n,) after a gap with unknown motion: all but the warmth is reset."""
    return DriveState(q.copy(), np.zeros(len(q)), before.warmth)


def move(drive: Drive, q: np.ndarray, state: DriveState) -> tuple[DriveState, np.ndarray]:
    """Return the state at position q (n,) and the displacement (n,) that the encoder resolves."""
    delta, resolution = drive.friction[6], drive.friction[7]
    play = np.clip(state.play, q - resolution, q + resolution)
    dy = play - state.play
    return DriveState(play, slide(state.z, dy, delta), state.warmth), dy


def heat(drive: Drive, qd: np.ndarray, dt: float, state: DriveState) -> DriveState:
    """Return the state after rubbing for a time dt [s]."""
    _, _, time, reference, _ = drive.warm_up
    heats = time > 0
    power = np.abs(_rubbing(drive, qd, sign(drive, qd, state), state.warmth, 1.0) * qd)
    power = power / np.where(heats, reference, 1.0)
    warmth = power + (state.warmth - power) * np.exp(-dt / np.where(heats, time, 1.0))
    return DriveState(state.play, state.z, np.where(heats, warmth, state.warmth))


def drive_torque(drive: Drive, q: np.ndarray, qd: np.ndarray, state: DriveState, dry_share: Any = 1.0) -> np.ndarray:
    """Return the torque (..., n), with dry friction weighted by `dry_share`."""
    cycles, cosine, sine = drive.ripple
    s = sign(drive, qd, state)
    tau = _rubbing(drive, qd, s, state.warmth, dry_share) + drive.friction[3]
    tau = tau + cosine * np.cos(cycles * q) + sine * np.sin(cycles * q)
    if drive.map is not None:
        tau = tau + dry_share * _mapped(drive.map, q, qd, s)
    return tau if drive.lines is None else tau + _rippled(drive.lines, q, qd, s)


def load_friction(drive: Drive, x: np.ndarray, qd: np.ndarray, state: DriveState) -> np.ndarray:
    """Return the friction (..., n) caused by a load x."""
    return drive.friction[10] * sign(drive, qd, state) * np.abs(x)


def load_of(drive: Drive, y: np.ndarray, qd: np.ndarray, state: DriveState, dry_share: Any = 1.0) -> np.ndarray:
    """Return the load x (..., n) of a torque y with its friction."""
    return y / (1.0 + drive.friction[10] * dry_share * sign(drive, qd, state) * np.sign(y))


def sign(drive: Drive, qd: np.ndarray, state: DriveState) -> np.ndarray:
    smooth = drive.friction[9]
    return np.where(smooth > 0, np.tanh(qd / np.where(smooth > 0, smooth, 1.0)), state.z)


def _rubbing(drive: Drive, qd: np.ndarray, s: np.ndarray, warmth: np.ndarray, dry_share: Any) -> np.ndarray:
    """Return the friction torque that turns into heat."""
    viscous, positive, negative, _, stribeck, speed, _, _, root, *_ = drive.friction
    of_coulomb, of_viscous = drive.warm_up[:2]
    dry = (positive * np.maximum(s, 0) + negative * np.minimum(s, 0)) * (1.0 + of_coulomb * warmth)
    dry = dry + stribeck * s * np.exp(-((qd / speed) ** 2)) + root * s * np.sqrt(np.abs(qd))
    return viscous * (1.0 + of_viscous * warmth) * qd + dry_share * dry


def _sides(s: np.ndarray) -> np.ndarray:
    """Return the weight of each direction (N, 2), positive first."""
    return np.stack([0.5 * (1.0 + s), 0.5 * (1.0 - s)], axis=-1)


def _mapped(part: list[np.ndarray], q: np.ndarray, qd: np.ndarray, s: np.ndarray) -> np.ndarray:
    positions, position_widths, speeds, speed_widths, coefficients = part
    n = len(positions)
    q, qd, s, shape = q.reshape(-1, n), qd.reshape(-1, n), s.reshape(-1, n), q.shape
    tau = np.empty(q.shape)
    for i in range(n):
        at = basis_weights(q[:, i], positions[i], position_widths[i])
        along = basis_weights(np.abs(qd[:, i]), speeds[i], speed_widths[i])
        tau[:, i] = np.einsum("ka,kb,kd,dab->k", at, along, _sides(s[:, i]), coefficients[i])
    return tau.reshape(shape)


def _rippled(part: list[np.ndarray], q: np.ndarray, qd: np.ndarray, s: np.ndarray) -> np.ndarray:
    joints, cycles, speeds, widths, coefficients = part
    n, sides = len(speeds), coefficients.shape[1]
    q, qd, s, shape = q.reshape(-1, n), qd.reshape(-1, n), s.reshape(-1, n), q.shape
    tau = np.zeros(q.shape)
    for i, c, k in zip(joints.astype(int), cycles, coefficients):
        along = basis_weights(np.abs(qd[:, i]) if sides == 2 else qd[:, i], speeds[i], widths[i])
        direction = _sides(s[:, i]) if sides == 2 else np.ones((len(q), 1))
        a, b = np.einsum("ks,kd,dsc->ck", along, direction, k)
        tau[:, i] += a * np.cos(c * q[:, i]) + b * np.sin(c * q[:, i])
    return tau.reshape(shape)


def model_torque(
    chain: Chain,
    gravity: np.ndarray,
    links: np.ndarray,
    rotor: np.ndarray,
    drive: Drive,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    dt: np.ndarray | None = None,
) -> np.ndarray:
    rotor, q, qd, qdd = (np.asarray(a, dtype=float) for a in (rotor, q, qd, qdd))
    tau = np.full(q.shape, np.nan)
    good = np.isfinite(q).all(axis=1) & np.isfinite(qd).all(axis=1) & np.isfinite(qdd).all(axis=1)
    if dt is not None:
        dt = np.asarray(dt, dtype=float)
        good &= np.isfinite(dt)
    load = np.full(q.shape, np.nan)
    load[good] = chain.rnea(q[good], qd[good], qdd[good], gravity, links)
    tau[good] = load[good] + rotor * qdd[good]
    state = None
    for k in np.flatnonzero(good):
        state, _ = move(drive, q[k], start(drive, q[k]) if state is None else state)
        tau[k] += drive_torque(drive, q[k], qd[k], state) + load_friction(drive, load[k], qd[k], state)
        if dt is not None:
            state = heat(drive, qd[k], dt[k], state)
    return tau


def presliding(q: np.ndarray, delta: np.ndarray, resolution: np.ndarray) -> np.ndarray:
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
