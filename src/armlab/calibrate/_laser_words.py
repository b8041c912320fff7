"""What scans of plates do not tell, or why they do not fit, in words."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armlab.calibrate._arguments import rows_text
from armlab.calibrate._hand_eye_words import ALIGNED, UNSEEN, axis_text, require_two_axes
from armlab.calibrate._laser_equation import Scans, Scene
from armlab.calibrate._laser_start import linear_rotations
from armlab.errors import NotConverged, NotExcited, ShapeError

LIMITS = (0.2, 0.2)  # largest deviations accepted: share of the spread of the points, and [rad]
FLAT = 0.05  # sine of the angle between plate and laser plane below which a scan is not one
SHAKEN = 1e-3  # rad: orientations of robots are no better; a turn that they could make by that is none
UNITS = 2.0  # factor between units of length from which it is told
FAR = 20.0  # factor from which nothing is tried
ROUGH = 0.1  # residual over the spread of the points from which scans do not fit
FAR_APART = 30.0  # m: no cell is as large, but one of 30 cm is in millimetres
TURNED = 0.2  # rad between lines and plates from which they do not


@dataclass(frozen=True, eq=False)
class Words:
    """Names, units and limits of the unknowns; puts a direction of them into words, see `estimation.check_spread`.

    Attributes
    ----------
    scans, scene : of the fit. planes : labels. limits : share of the spread of the points, and [rad].
    """

    scans: Scans
    scene: Scene
    planes: tuple[str, ...]
    limits: tuple[float, float]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of each unknown."""
        pose = [f"T_tool_sensor {'r' * turn}{axis}" for turn in (0, 1) for axis in "xyz"]
        return (*pose, *(f"plane {label} {what}" for label in self.planes for what in ("tilt 1", "tilt 2", "offset")))

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of each unknown."""
        return (*("m",) * 3, *("rad",) * 3, *("rad", "rad", "m") * len(self.planes))

    @cached_property
    def spread(self) -> float:
        """RMS distance of the measured points from their mean [m]."""
        q = self.scans.base_points(self.scene)
        return float(np.sqrt(np.mean(np.sum((q - q.mean(axis=0)) ** 2, axis=1)))) or 1.0

    @cached_property
    def widths(self) -> np.ndarray:
        """Largest deviation accepted of each unknown."""
        return np.array([self.limits[0] * self.spread if unit == "m" else self.limits[1] for unit in self.units])

    def __call__(self, step: np.ndarray) -> str:
        """Return for example "translation of the sensor along tool axis z, 0.4 m"."""
        widths = self.widths
        sizes = np.linalg.norm((step / widths).reshape(-1, 3), axis=1)
        first = int(np.flatnonzero(sizes > 0.5 * sizes.max())[0])
        part = step[3 * first : 3 * first + 3]
        if first == 0:
            text, unit = f"translation of the sensor along {axis_text(part, 'tool')}", "m"
        elif first == 1:
            u, line = part / np.linalg.norm(part), np.append(self.scans.line.T @ np.sign(self.scans.line[:, :1]), 0.0)
            along = abs(u @ line) > ALIGNED * np.linalg.norm(line)
            text = f"rotation about the {'laser line' if along else axis_text(part, 'sensor')}"
            unit = "rad"
        else:
            label = self.planes[first - 2]
            tilted = np.linalg.norm(part[:2] / widths[3 * first]) > abs(part[2] / widths[3 * first + 2])
            text, unit = (f"tilt of plane {label}", "rad") if tilted else (f"offset of plane {label}", "m")
            part = part[:2] if tilted else part[2:]
        if abs(np.linalg.norm(step / widths) - 1.0) < UNSEEN:
            return text
        return f"{text}, {np.linalg.norm(part):.2g} {unit}"


def require_motion(scans: Scans, planes: tuple[str, ...]) -> None:
    """Refuse too few scans, and orientations that leave a translation of the sensor open."""
    needed = 7 + 3 * scans.P
    few = [str(planes[j]) for j in range(scans.P) if np.count_nonzero(scans.plane == j) < 2]
    if scans.numbers < needed or few:
        where = f"planes {', '.join(few)} with one scan" if few else f"{scans.N} scans"
        raise NotExcited(
            f"Expected at least {needed} numbers and two scans of each of {scans.P} planes, got {scans.numbers} numbers"
            f" from {where}. Scan each plate from many directions.",
            [where],
            [f"{scans.numbers} of {needed} numbers"],
        )
    require_two_axes(scans.RA, SHAKEN, "tool", ("the sensor", "every plane"))


def require_slant(scans: Scans, scene: Scene) -> None:
    """Refuse scans whose plate is parallel to the laser plane."""
    bad = np.flatnonzero(scans.slant(scene) < FLAT)
    if len(bad):
        raise ShapeError(
            f"Expected plates that cut the laser plane, got some parallel to it (sine below {FLAT}) in rows "
            f"{rows_text(bad)}. Leave these scans out."
        )


def require_units(scans: Scans, ratio: float) -> None:
    """Refuse scans and poses in units of length that are far apart, before a search for what cannot be found."""
    size = _unit(scans, ratio)
    if not 1.0 / FAR < size < FAR:
        raise misfit(scans, ratio, None, f"lengths that are {size:.2g} of those of the poses")


def _unit(scans: Scans, ratio: float) -> float:
    """Return the unit of the poses over that of the scans, 1 where plates do not agree on it."""
    sizes = [size for _, size in linear_rotations(scans, ratio)]
    agreed = np.ptp(np.log(np.maximum(sizes, 1e-300))) < np.log(UNITS)
    return float(np.median(sizes)) if agreed else 1.0


def misfit(scans: Scans, ratio: float, best: Scene | None, text: str) -> NotConverged:
    """Return the refusal of scans that no start fits, with the cause where it can be told."""
    size = _unit(scans, ratio)
    cause = "Check the labels of the plates and that scan i and pose i are of the same moment, or look for wrong scans "
    cause += "with robust=True."
    if not 1.0 / UNITS < size < UNITS:
        cause = f"Lengths of the scans times {size:.2g} would fit."
        if not 1.0 / FAR < size < FAR:
            cause = f"{cause[:-1]}: perhaps millimetres were given as metres."
    return NotConverged(f"Expected scans of flat plates by one sensor, got {text}. {cause}", best=best, reason="misfit")
