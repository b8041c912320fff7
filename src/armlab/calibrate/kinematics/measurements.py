"""Validated measurements for kinematic calibration, with mask and noise of each kind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from armlab._numbers import numbers
from armlab.calibrate.inputs import poses, rows_text
from armlab.errors import ConfigError, RobotError, ShapeError, UnknownName
from armlab.lie import se3
from armlab.robots import Robot

KINDS = ("pose", "position", "distance", "pair_distance")
DEGREES = 20.0  # joint angle [rad] beyond the range of any joint
CLASSES: dict[str, tuple[str, ...]] = {
    "pose": (*("pose position [m]",) * 3, *("pose rotation [rad]",) * 3),
    "position": ("position [m]",) * 3,
    "distance": ("distance [m]",),
    "pair_distance": ("pair distance [m]",),
}


@dataclass(frozen=True, eq=False)
class Kind:
    name: str  # one of KINDS
    values: np.ndarray  # (N, 4, 4), (N, K, 3), (N,), or (M,) for pairs
    visible: np.ndarray  # mask (N,), or (N, K) for positions
    kept: np.ndarray  # indices of the used components
    cov: np.ndarray | None  # (k,), (k, k) or (N, k, k) of the used components; None: estimated
    pairs: np.ndarray | None = None  # (2, M) sample indices of pair distances

    @property
    def classes(self) -> tuple[str, ...]:
        return tuple(CLASSES[self.name][k] for k in self.kept)

    @property
    def numbers(self) -> int:
        return int(np.count_nonzero(self.visible)) * len(self.kept)

    def noise(self, rows: np.ndarray) -> np.ndarray | None:
        return self.cov if self.cov is None or self.cov.ndim < 3 else self.cov[rows]


def check_joints(robot: Robot, q: Any, name: str = "q") -> np.ndarray:
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    q = numbers(q, name, ShapeError)
    if q.ndim != 2 or q.shape[1] != robot.n:
        raise ShapeError(
            f"Expected {name} of shape (N, {robot.n}) for robot {robot.name!r}, got {q.shape}. Pass one row per sample."
        )
    _finite(q, np.ones(len(q), dtype=bool), name)
    far = np.abs(q[:, ~robot.prismatic])
    if far.size and far.max() > DEGREES:
        raise ShapeError(
            f"Expected joint angles in radians, got values up to {far.max():.4g} "
            f"in {name}. The values seem to be in degrees: use numpy.deg2rad."
        )
    return q


def check_terms(value: Any, shape: tuple[int, int], name: str = "joint_terms") -> np.ndarray:
    """Return the joint terms (N, n, L), with L = 0 for None."""
    if value is None:
        return np.zeros((*shape, 0))
    terms = numbers(value, name, ShapeError)
    if terms.ndim != 3 or terms.shape[:2] != shape:
        raise ShapeError(f"Expected {name} of shape ({shape[0]}, {shape[1]}, L), got {terms.shape}.")
    _finite(terms, np.ones(len(terms), dtype=bool), name)
    return terms


def check_harmonics(value: Any) -> tuple[int, ...]:
    """Return the orders of the harmonics; raise an error unless they are distinct positive integers."""
    orders = numbers(list(value), "harmonics", ConfigError) if len(value) else np.zeros(0)
    if orders.ndim != 1 or np.any(orders < 1) or np.any(orders % 1) or len(set(orders.tolist())) != len(orders):
        raise ConfigError(f"Expected harmonics to be distinct positive integers, such as (1, 2), got {value!r}.")
    return tuple(int(k) for k in orders)


def measured_kinds(N: int, given: Mapping[str, Any], visible: Any, noise: Any) -> tuple[list[Kind], list[str]]:
    """Return the kinds of measurement, and remarks for the report."""
    names = [name for name in KINDS if given.get(name) is not None]
    if not names:
        raise ConfigError(
            f"Expected at least one of {', '.join(KINDS)}, got no measurement. Pass at least one of these measurements."
        )
    masks, noises = _by_kind(visible, names, "visible"), _by_kind(noise, names, "noise")
    kinds, notes = [], []
    for name in names:
        values, pairs = _values(name, given[name], N)
        seen = _mask(masks.get(name), values, name)
        _finite(values, seen, name)
        if name == "pose":
            R, t, note = poses(np.where(seen[:, None, None], values, np.eye(4)), name)
            values = se3.from_rp(R, t)
            notes += [note] * bool(note)
        kept, cov = _noise(noises.get(name), name, values.shape)
        kinds.append(Kind(name, values, seen, kept, cov, pairs))
    return kinds, notes


def _by_kind(value: Any, names: list[str], what: str) -> dict[str, Any]:
    if isinstance(value, Mapping):
        for name in value:
            if name not in names:
                raise UnknownName.among(f"measured kind ({what})", name, names)
        return dict(value)
    if value is not None and what == "noise" and len(names) > 1:
        raise ConfigError(
            f"Expected separate noise for each kind, such as noise={{{names[0]!r}: ..., {names[1]!r}: ...}}, got one "
            "value. Omit a kind to estimate its noise."
        )
    return dict.fromkeys(names, value)


def _values(name: str, value: Any, N: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the measurements with validated shapes, and the index pairs of pair distances."""
    if name == "pair_distance":
        return _pairs(value, N)
    array = numbers(value, name, ShapeError)
    if name == "position" and array.ndim == 2:
        array = array[:, None]
    tail = {"pose": (4, 4), "position": (*array.shape[1:2], 3), "distance": ()}[name]
    if array.shape != (N, *tail) or (name == "position" and array.ndim != 3):
        wanted = {"pose": f"({N}, 4, 4)", "position": f"({N}, 3) or ({N}, K, 3)", "distance": f"({N},)"}[name]
        raise ShapeError(f"Expected {name} of shape {wanted} for {N} rows of q, got {np.shape(value)}.")
    return array, None


def _pairs(value: Any, N: int) -> tuple[np.ndarray, np.ndarray]:
    parts = [numbers(part, "pair_distance", ShapeError) for part in value] if len(value) == 3 else []
    if len(parts) != 3 or parts[0].ndim != 1 or any(part.shape != parts[0].shape for part in parts):
        raise ShapeError("Expected pair_distance as (i, j, d): two arrays of sample indices, and the distances (M,).")
    ends = np.stack(parts[:2])
    if np.any(ends % 1) or ends.min(initial=0) < 0 or ends.max(initial=0) >= N or np.any(ends[0] == ends[1]):
        raise ShapeError(
            f"Expected pairs of distinct sample indices from 0 to {N - 1} in pair_distance, got invalid indices."
        )
    return parts[2], ends.astype(int)


def _mask(value: Any, values: np.ndarray, name: str) -> np.ndarray:
    """Return the mask of available measurements: (N,), or (N, K) for positions."""
    shape = values.shape[:2] if name == "position" else values.shape[:1]
    if value is None:
        return np.ones(shape, dtype=bool)
    mask = np.asarray(value)
    if mask.dtype != bool or mask.shape not in (shape, shape[:1]):
        raise ShapeError(f"Expected visible as Booleans of shape {shape} for {name}, got {mask.shape}.")
    return np.broadcast_to(mask.reshape(*mask.shape, *(1,) * (len(shape) - mask.ndim)), shape)


def _finite(values: np.ndarray, seen: np.ndarray, name: str) -> None:
    """Raise an error that lists the rows with NaN or infinity in visible measurements."""
    if not values.size:
        return
    good = np.isfinite(values.reshape(*seen.shape, -1)).all(axis=-1) | ~seen
    if not good.all():
        bad = np.flatnonzero(~good.reshape(len(good), -1).all(axis=1))
        raise ShapeError(
            f"Expected finite {name}, got NaN or Inf in {len(bad)} rows: {rows_text(bad)}. Drop these samples, or mark "
            "missing values with visible."
        )


def _noise(value: Any, name: str, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the used components and their covariance; infinite standard deviations exclude components."""
    k = len(CLASSES[name])
    if value is None:
        return np.arange(k), None
    noise = numbers(value, "noise", ShapeError)
    if name == "pose" and noise.shape == (2,):
        noise = np.repeat(noise, 3)
    if k < 6 and noise.ndim == 0:
        noise = np.full(k, noise)
    if name == "position" and noise.shape == (*shape[:2], 3, 3) and shape[1] == 1:
        noise = noise[:, 0]
    if k == 1 and noise.shape == shape:
        noise = noise[:, None, None] ** 2
    if noise.shape == (k,) and np.all(noise > 0):
        kept = np.flatnonzero(np.isfinite(noise))
        if len(kept):
            return kept, noise[kept] ** 2
    if noise.shape in ((k, k), (*shape[:1], k, k)) and np.isfinite(noise).all() and _definite(noise):
        return np.arange(k), noise
    wanted = {6: "(sd of position [m], sd of rotation [rad]), 6 sd", 3: "one sd [m], 3 sd", 1: "one sd [m]"}[k]
    raise ShapeError(
        f"Expected noise of {name} as {wanted}, or a positive definite covariance ({k}, {k}) or "
        f"({shape[0]}, {k}, {k}), got {np.array2string(noise, threshold=8)}. At least one standard deviation must be "
        "finite."
    )


def _definite(cov: np.ndarray) -> bool:
    even = np.abs(cov - np.swapaxes(cov, -1, -2)).max() <= 1e-9 * np.abs(cov).max()
    return bool(even and np.linalg.eigvalsh(cov).min() > 0)
