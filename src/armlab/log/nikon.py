"""Nikon tracker files, in metres: point clouds, planes, and MAT files of poses.

A file of a point cloud contains rows and comments::

    [0.000000 , -453.375092 , 310.983154 , -2630.958496 , -96.618225 , 46.868734 , -77.823094 ;
    ...
    0.000000 , -453.825226 , 292.506348 , -2717.404053 , -86.801871 , 48.349143 , -57.017544]

    // MEAS_OBJECT = CloudSeam2

A row of a point cloud contains an index, x, y, z [mm] and three angles [deg] in the xyz convention. A plane is a pose
whose third column is the plane normal and whose fourth column is a point on the plane.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armlab._numbers import still
from armlab.errors import LogError, ShapeError
from armlab.lie import euler, se3, so3
from armlab.log.file_formats.mat import read_mat

__all__ = ["read_cloud", "read_matrix", "read_plane"]

MM = 1e-3  # m
NORMAL = 1e-4  # tolerance on the length of a rounded normal
LONGEST = 16_000_000  # bytes; a cloud takes about 100 bytes per point
DECORATION = re.compile(r"[\[\];\"']")
SEPARATOR = re.compile(r"[\s,]+")
NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?|nan|inf|infinity)", re.IGNORECASE)
COMMENT = re.compile(r"^\s*(?://|%|#)?\s*(\w+)\s*=\s*(.*?)\s*$")


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points measured by a tracker.

    Attributes
    ----------
    p : (N, 3) points in the tracker's frame [m].
    index : (N,) index in the file.
    R : (N, 3, 3) orientation of the probe at each point.
    stopped : number (from 1) of the first line that is not a row; 0 if all lines are rows.
    comments : names and values after the rows, for example {"MEAS_OBJECT": "CloudSeam"}.
    """

    p: np.ndarray
    index: np.ndarray
    R: np.ndarray
    stopped: int
    comments: dict[str, str]


@dataclass(frozen=True, eq=False)
class PlaneFile:
    """Plane measured by a tracker; convert it with `frames.Plane.of(normal, point)`.

    Attributes
    ----------
    normal : (3,) unit normal, or the normal as in the file if read with `raw`.
    point : (3,) point on the plane [m].
    stopped, comments : as in `Cloud`.
    """

    normal: np.ndarray
    point: np.ndarray
    stopped: int
    comments: dict[str, str]


@dataclass(frozen=True, eq=False)
class PoseFile:
    """A pose from a file.

    Attributes
    ----------
    T : (4, 4) pose [m].
    name : name of the variable.
    distance : Frobenius distance between the rotation block in the file and the nearest rotation matrix.
    """

    T: np.ndarray
    name: str
    distance: float


def read_cloud(path: str | Path) -> Cloud:
    """Read a point cloud.

    Numbers are separated by commas or spaces; brackets, semicolons, quotes and empty lines are ignored. The first line
    with other content marks the end of the cloud.

    Parameters
    ----------
    path : text file.

    Raises
    ------
    LogError : the file is not text, has no rows, or has a row with NaN or with a different number of columns. The
        message states line and column.
    """
    rows, stopped, comments = _rows(Path(path), 7)
    values = np.array(rows)
    R = euler.from_rpy(np.deg2rad(values[:, 4:7]), "xyz")
    p, index = still(MM * values[:, 1:4], "points"), still(values[:, 0], "an index")
    return Cloud(p, index, still(R, "orientations"), stopped, comments)


def read_plane(path: str | Path, raw: bool = False) -> PlaneFile:
    """Read a plane.

    Parameters
    ----------
    path : text file with a 4x4 matrix [mm].
    raw : keep the rounded normal from the file; default: normalise it.

    Raises
    ------
    LogError : the file is not text, has no 4x4 matrix with the last row (0, 0, 0, 1), or has a normal whose length is
        not near 1.
    """
    path = Path(path)
    rows, stopped, comments = _rows(path, 4)
    M = np.array(rows)
    if M.shape != (4, 4) or M[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise LogError(
            f"Expected a 4x4 matrix with the last row 0 0 0 1 in {path}, got {len(rows)} rows, of which "
            f"the last is {[float(x) for x in M[-1]]}. Pass a plane file."
        )
    length = float(np.linalg.norm(M[:3, 2]))
    if not abs(length - 1.0) <= NORMAL:
        raise LogError(f"Expected a normal of length 1 in column 3 of {path}, got {length:.6g}. Pass a plane file.")
    return PlaneFile(
        still(M[:3, 2] / (1.0 if raw else length), "a normal"), still(MM * M[:3, 3], "a point"), stopped, comments
    )


def read_matrix(path: str | Path, name: str | None = None, project: bool = False) -> PoseFile:
    """Read a pose [mm] from a MAT file of any version.

    Parameters
    ----------
    path : MAT file.
    name : name of the variable; default: the only 4x4 array of the file.
    project : project a rotation block that is off by more than 1e-5 onto the nearest rotation.

    Raises
    ------
    LogError : the file is not a MAT file, is corrupt, or does not contain exactly one 4x4 array. Also raised if the
        array is not a pose, or if its rotation block is off by more than 1e-5 without `project`.
    UnknownName : the variable does not exist.
    MissingExtra : the file has version 7.3, and h5py is not installed.
    """
    path = Path(path)
    found = read_mat(path, name)
    fitting = {key: M for key, M in found.items() if M.shape == (4, 4)}
    if len(fitting) != 1:
        have = ", ".join(f"{key} {M.shape}" for key, M in found.items())
        raise LogError(f"Expected one 4x4 array in {path}, got {have}. Select one with name=.")
    key, M = next(iter(fitting.items()))
    if not np.isfinite(M).all():
        row = 1 + int(np.flatnonzero(~np.isfinite(M).all(axis=1))[0])
        raise LogError(f"Expected a pose in {key} of {path}, got NaN or Inf in row {row}.")
    if np.linalg.det(M[:3, :3]) < 0:
        raise LogError(
            f"Expected a rotation in {key} of {path}, got a left-handed matrix. One of its axes is mirrored."
        )
    M[:3, 3] *= MM
    try:
        nearest, distance = se3.project(M)
    except ShapeError as error:
        raise LogError(
            f"Expected a pose in {key} of {path}, got a matrix that is not a pose: {str(error).rstrip('.')}."
        ) from None
    off = float(np.abs(M[:3, :3].T @ M[:3, :3] - np.eye(3)).max())
    if off > so3.ROTATION_TOLERANCE:
        if not project:
            raise LogError(
                f"Expected a rotation in {key} of {path}, got a matrix at a distance of {float(distance):.3g} from the "
                f"nearest rotation (error of RᵀR: {off:.3g}). Pass project=True to use the nearest rotation."
            )
        M = nearest
    return PoseFile(still(se3.orthonormalise(M), "a pose"), key, float(distance))


def _rows(path: Path, columns: int) -> tuple[list[list[float]], int, dict[str, str]]:
    """Return the rows of numbers, the number of the line that ended them (0 if none did), and the comments after
    them."""
    try:
        with path.open("rb") as file:
            data = file.read(LONGEST + 1)
    except OSError as error:
        raise LogError(f"Expected a tracker file at {path}, got: {error.strerror}.") from None
    if len(data) > LONGEST:
        raise LogError(f"Expected a tracker file of at most {LONGEST} bytes at {path}, got a larger file. Split it.")
    if b"\0" in data:
        raise LogError(f"Expected text at {path}, got binary data. For MAT files, use read_matrix.")
    lines = data.decode("utf-8", errors="replace").lstrip("\ufeff").splitlines()
    rows: list[list[float]] = []
    for k, line in enumerate(lines, start=1):
        words = [word for word in SEPARATOR.split(DECORATION.sub(" ", line)) if word]
        if not words:
            continue
        if not all(NUMBER.fullmatch(word) for word in words):
            break
        values = [float(word) for word in words]
        if len(values) != columns:
            raise LogError(
                f"Expected {columns} columns in {path}, got {len(values)} in line {k}. "
                "The file is truncated or invalid."
            )
        bad = [i for i, value in enumerate(values, start=1) if not math.isfinite(value)]
        if bad:
            raise LogError(f"Expected numbers in {path}, got {words[bad[0] - 1]!r} in line {k}, column {bad[0]}.")
        rows.append(values)
    else:
        k = 0
    if not rows:
        shown = f"{lines[k - 1][:40]!r} in line {k}" if k else "an empty file"
        raise LogError(f"Expected rows of {columns} numbers in {path}, got {shown}. Pass a tracker file.")
    found = (COMMENT.match(line) for line in (lines[k - 1 :] if k else []))
    return rows, k, {match[1]: match[2] for match in found if match}
