"""What hand-eye data do not tell, or why they do not fit, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import hypot
from typing import Any

import numpy as np

from armlab._numbers import numbers
from armlab.calibrate._hand_eye_equation import Equation
from armlab.errors import NotConverged, NotExcited, ShapeError
from armlab.estimation import NonlinearSolution

FIXED = 1e-6  # rad: an orientation that moves less does not move
NOISE = 3.0  # an orientation that moves less than this many deviations of the noise does not either
ALIGNED = 0.996  # cosine beyond which an axis is called by its letter
SHARED = 0.3  # length, relative to the largest, from which a part of a direction is told
APART = 0.5  # residual over spread beyond which two records do not belong together
SUSPECT = 0.02  # rad: residual beyond which another reading of the records is tried
NOTHING, MUCH_BETTER = 1e-4, 0.1  # mean square of a rotation [rad^2] that is no misfit; share that is left of one
THINNED = 2000
UNSEEN = 1e-9  # a direction as long as its limits has no deviation: nothing is seen of it
FAR = 30.0  # m: no arm measures over that, but one of 30 cm does in millimetres
FIRST_ORDER = 0.05  # rad: beyond it a covariance is a first-order statement
ROUGH, COARSE = 0.05, 0.03  # rad, and share of the spread: what is worse is no noise of a sensor


@dataclass(frozen=True)
class Part:
    """Three of the unknowns.

    Attributes
    ----------
    what : "translation of T_tool_marker". axes : whose axes, "tool". rotation : True for a rotation vector.
    """

    what: str
    axes: str
    rotation: bool

    @classmethod
    def of(cls, names: Sequence[str]) -> tuple[Part, ...]:
        """Return the parts of poses T_a_b: translation in axes of a, rotation in axes of b."""
        found: list[Part] = []
        for name in names:
            _, parent, child = name.split("_")
            found += [cls(f"translation of {name}", parent, False), cls(f"rotation of {name}", child, True)]
        return tuple(found)


def axis_text(u: np.ndarray, axes: str) -> str:
    """Return "tool axis z", or "tool axis (0.60, 0.00, 0.80)": a line, without sense."""
    parts = u.tolist()
    length = hypot(*parts)
    k = max(range(3), key=lambda i: abs(parts[i]))
    if abs(parts[k]) > ALIGNED * length:
        return f"{axes} axis {'xyz'[k]}"
    scale = length if parts[k] > 0 else -length
    return f"{axes} axis ({', '.join(f'{round(x / scale, 2) + 0.0:.2f}' for x in parts)})"


@dataclass(frozen=True, eq=False)
class Words:
    """Names, units and limits of the unknowns; puts a direction of them into words, see `estimation.check_spread`.

    Attributes
    ----------
    parts : of the unknowns, three each. spread : of the measured positions [m].
    limits : largest deviation accepted: share of the spread, and [rad].
    """

    parts: Sequence[Part]
    spread: float
    limits: tuple[float, float]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of each unknown, for example "T_base_cam rx"."""
        return tuple(f"{p.what.split()[-1]} {'r' * p.rotation}{axis}" for p in self.parts for axis in "xyz")

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of each unknown."""
        return tuple("rad" if p.rotation else "m" for p in self.parts for _ in range(3))

    @cached_property
    def widths(self) -> np.ndarray:
        """Largest deviation accepted of each unknown."""
        return np.repeat([self.limits[1] if p.rotation else self.limits[0] * self.spread for p in self.parts], 3)

    def __call__(self, step: np.ndarray) -> str:
        """Return for example "translation of T_tool_marker along tool axis z (T_base_cam moves with it), 0.4 m"."""
        blocks = step.reshape(-1, 3)
        sizes = [hypot(*block) for block in (blocks / self.widths.reshape(-1, 3)).tolist()]
        largest = max(sizes)
        first = next(
            i for i, size in enumerate(sizes) if size > 0.5 * largest
        )  # of poses that move together, the first
        part = self.parts[first]
        text = f"{part.what} {'about' if part.rotation else 'along'} {axis_text(blocks[first], part.axes)}"
        others = {p.what.split()[-1] for p, size in zip(self.parts, sizes) if size > SHARED * largest}
        others -= {part.what.split()[-1]}
        text += f" ({' and '.join(sorted(others))} move{'s' * (len(others) == 1)} with it)" if others else ""
        if abs(hypot(*sizes) - 1.0) < UNSEEN:
            return text
        return f"{text}, {hypot(*blocks[first].tolist()):.2g} {'rad' if part.rotation else 'm'}"


def limits_of(limits: Any) -> tuple[float, float]:
    """Return the two limits, refusing others than numbers above zero."""
    values = numbers(limits, "limits", ShapeError)
    if values.shape != (2,) or not np.all(values > 0):
        raise ShapeError(
            f"Expected limits as two numbers above zero, a share of the spread of the positions and an angle [rad], "
            f"got {limits!r}. (0.2, 0.2) are the usual ones."
        )
    return float(values[0]), float(values[1])


def require_samples(N: int, least: int, what: str) -> None:
    """Refuse fewer samples than any such fit needs."""
    if least > N:
        raise NotExcited(
            f"Expected at least {least} pairs of {what}, got {N}. Measure at poses that turn the tool about two axes.",
            [f"everything: {N} poses"],
            [f"{N} of at least {least} poses"],
        )


def require_two_axes(RA: np.ndarray, noise: float, carrier: str, moved: Sequence[str]) -> None:
    """Refuse rotations about one axis, and none.

    ``e_u^2 = 1 - |mean(R_A) u|^2`` is the mean square by which a tool axis u turns; noise alone makes it 2 sigma^2.

    Parameters
    ----------
    RA : (N, 3, 3). noise : sigma of a rotation [rad]; more than 0.05 is none, but records that do not fit.
    carrier : whose axes turn, "tool". moved : names of what is on it, and of what moves with that.
    """
    M = RA.sum(axis=0) / len(RA)
    squares, u = np.linalg.eigh(np.eye(3) - M.T @ M)
    turned = np.sqrt(np.maximum(squares, 0.0))
    limit = max(FIXED, NOISE * noise) if noise < ROUGH else FIXED
    if turned[0] > limit:
        return
    axes = [u[:, 0]] if turned[1] > limit else list(np.eye(3))
    where = [f"translation of {moved[0]} along {axis_text(v, carrier)} ({moved[1]} moves with it)" for v in axes]
    turn = "about one axis only" if turned[1] > limit else "nowhere"
    largest = largest_rotation(RA)
    raise NotExcited(
        f"Expected poses that turn the tool about two axes, got rotations {turn} (largest between two poses "
        f"{largest:.3g} rad): not told is the {'; '.join(where)}. Turn the wrist about a second axis.",
        where,
        [f"turned by {t:.2g} rad, noise {noise:.2g} rad" for t in turned[: len(where)]],
    )


def largest_rotation(R: np.ndarray) -> float:
    """Return the largest angle between two of the rotations (N, 3, 3) [rad]; of many, of 2000 of them."""
    flat = R[:: 1 + len(R) // THINNED].reshape(-1, 9)
    return float(np.arccos(np.clip(0.5 * ((flat @ flat.T).min() - 1.0), -1.0, 1.0)))


def require_match(equation: Equation, r: np.ndarray, kept: np.ndarray, best: Any) -> None:
    """Refuse records that do not belong together, with what would make them fit where that can be said.

    Parameters
    ----------
    equation : all pairs. r : (N, 6) residuals at the best value. kept : (N,) pairs that were not left out.
    best : for the error.
    """
    turned, moved = np.sqrt(3.0 - np.vdot(equation.mean, equation.mean)), equation.spread
    squares, count = (r[kept] ** 2).sum(axis=0), np.count_nonzero(kept)
    position, rotation = np.sqrt(squares.reshape(2, 3).sum(axis=1) / count)
    few = 2 * count <= len(kept)
    if (rotation <= APART * turned or rotation < ROUGH) and position <= APART * moved and not few:
        cause = _other_reading(equation) if rotation > SUSPECT else ""
        if not cause:
            return
    left_out = f", {np.count_nonzero(~kept)} of {len(kept)} left out" if few else ""
    raise NotConverged(
        f"Expected two records of poses that belong together, got {position:.3g} m and {rotation:.3g} rad between them "
        f"(RMS{left_out}) where the poses spread over {moved:.3g} m and {turned:.3g} rad. {_cause(equation)}",
        best=best,
        reason="mismatch",
    )


def _cause(equation: Equation) -> str:
    """Return what is wrong with the records, as far as another reading of them fits much better."""
    cause = _other_reading(equation)
    if cause:
        return cause
    scale = _scale(equation)
    if scale is not None and scale < 0.0:
        return "Positions and rotations are of different hands: one axis of the camera or of the robot is reversed."
    if scale is not None:
        return f"Lengths of the measured poses times {scale:.3g} would fit: perhaps millimetres were given as metres."
    return "Check that sample i of both is the same moment, and which frame each is in."


def _other_reading(equation: Equation) -> str:
    """Return the reading of the records whose rotations fit much better, "" where none does."""
    now = _misfit(equation.RA, equation.RB)
    RA, RB = equation.RA, equation.RB
    other = {
        "One of the records holds the inverse of what was expected, or the setup is the other one.": _misfit(
            RA.transpose(0, 2, 1), RB
        ),
        "One of the records is in reverse order.": _misfit(RA, RB[::-1]),
    }
    for k in (1, 2, 3):
        if 2 * k + 3 < equation.N:
            text = f"The records are shifted by {k} samples against each other."
            other[text] = min(_misfit(RA[k:], RB[:-k]), _misfit(RA[:-k], RB[k:]))
    cause = min(other, key=lambda text: other[text])
    return cause if now > NOTHING and other[cause] < MUCH_BETTER * now else ""


def _misfit(RA: np.ndarray, RB: np.ndarray) -> float:
    """Return 1 minus the largest singular value of the mean of R_A (x) R_B: 0 where they belong together."""
    still = np.zeros((len(RA), 3))
    return float(1.0 - np.linalg.svd(Equation(RA, still, RB, still).product(), compute_uv=False)[0])


def _scale(equation: Equation) -> float | None:
    """Return the factor on t_B that makes the positions fit, below 0 for a mirror image; None where none does."""
    RY = equation.start().RY
    turned = equation.tB @ RY.T
    A = np.concatenate([equation.RA, -turned[:, :, None], np.broadcast_to(-np.eye(3), (equation.N, 3, 3))], axis=2)
    x = np.linalg.lstsq(A.reshape(-1, 7), -equation.tA.ravel(), rcond=None)[0]
    left = float(np.sqrt(np.mean((A.reshape(-1, 7) @ x + equation.tA.ravel()) ** 2) * 3.0))
    odd = x[3] < 0 or abs(np.log(max(x[3], 1e-300))) > np.log(2.0)
    fits = left < 0.1 * float(equation.tA.std(axis=0).max()) and odd
    return float(x[3]) if fits else None


def remarks(RA: np.ndarray, spread: float, given: bool, found: NonlinearSolution[Any], turns: np.ndarray) -> list[str]:
    """Return what a report says beyond the values.

    Parameters
    ----------
    RA : (N, 3, 3). spread : of the positions [m]. given : whether the noise was. found : the fit.
    turns : deviations of rotations [rad].
    """
    lines = [f"largest rotation between two poses {largest_rotation(RA):.3g} rad"]
    if given and found.freedom:
        lines.append(f"residuals {np.sqrt(2.0 * found.cost / found.freedom):.3g} times the noise that was given")
    left = found.sigma.tolist()
    if not given and (left[0] > COARSE * spread or (left[-1] > ROUGH and len(left) == 2)):
        lines.append("residuals are larger than those of any sensor: are some samples wrong, or all?")
    if spread > FAR:
        lines.append(f"positions spread over {spread:.3g} m: millimetres given as metres?")
    if turns.max() > FIRST_ORDER:
        lines.append("rotations are known to worse than 3 degrees: deviations are first-order statements there")
    return lines
