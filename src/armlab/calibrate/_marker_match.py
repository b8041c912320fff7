"""Whether poses of a robot and points in a camera belong together, and what is wrong where they do not."""

from __future__ import annotations

import numpy as np

from armlab.calibrate._marker_equation import Linear, Sight
from armlab.errors import NotConverged

APART = 0.5  # residual over spread beyond which two records do not belong together
ROUND = 0.5  # smallest over largest singular value of a matrix that is a rotation, a mirror image or a scale
SUSPECT = 0.02  # residual over spread beyond which another reading of the poses is tried
SHAPED = 0.25  # difference of two arrangements over their size from which they are different
CLEAR = 5.0  # deviations of the points found from which a difference is one
MUCH_BETTER = 0.3  # residual over the present one of a reading that is the right one
OTHER_UNIT = 2.0  # factor of length that no camera is wrong by


def require_sight(sight: Sight, rms: float | None = None, left_out: float = 0.0) -> None:
    """Refuse records that do not belong together, with what would make them fit where that can be said.

    Parameters
    ----------
    sight : what was seen. rms : of the residuals of the fit, without outliers [m]; before the fit, None.
    left_out : share of the samples that are outliers.
    """
    found = sight.solution
    if rms is None:
        cause = _unit_or_hand(sight, found)
    else:
        bad = rms > APART * sight.spread or left_out >= 0.5
        cause = _other_reading(sight, found.misfit) if bad or rms > SUSPECT * sight.spread else ""
        cause = cause or ("Check that sample i of both is the same moment, and which frame each is in." if bad else "")
    if cause:
        share = f", with {100 * left_out:.0f} % of the samples left out" if left_out else ""
        raise NotConverged(
            f"Expected poses and points that belong together, got points {found.misfit:.3g} m from where one rigid "
            f"arrangement has them (RMS of the linear solution{share}). {cause}",
            best=found,
            reason="mismatch",
        )


def require_marker(sight: Sight, s: np.ndarray, marker: np.ndarray) -> None:
    """Refuse a marker whose points are not arranged as those that were seen.

    Parameters
    ----------
    s : (K, 3) the points on the tool, as seen. marker : (K, 3) as given, not in a line.
    """
    a, b = s - s.mean(axis=0), marker - marker.mean(axis=0)
    U, sizes, V = np.linalg.svd(a.T @ b)
    hand = np.sign(np.linalg.det(U @ V))
    seen, given = np.linalg.norm(a), np.linalg.norm(b)
    apart = float(np.linalg.norm(a - b @ (U * [1.0, 1.0, hand] @ V).T))
    unsure = CLEAR * sight.solution.misfit * np.sqrt(sight.K / len(sight.p))
    if apart < max(SHAPED * seen, unsure):
        return
    turned, times = float(sizes.sum()), seen / given
    cause = "Check the order of the points."
    if turned > (1.0 - SHAPED**2) * seen * given and abs(np.log(times)) > np.log(OTHER_UNIT):
        cause = f"The marker times {times:.3g} would fit: perhaps millimetres were given as metres."
    elif hand < 0 and turned > (1.0 - SHAPED**2) * seen * given:
        cause = "Its mirror image would fit: one axis of the marker is reversed."
    raise NotConverged(
        f"Expected a marker arranged as its points were seen, got {apart / np.sqrt(sight.K):.3g} m between them (RMS) "
        f"where they spread over {seen / np.sqrt(sight.K):.3g} m. {cause}",
        best=s,
        reason="mismatch",
    )


def _unit_or_hand(sight: Sight, found: Linear) -> str:
    """Return what is wrong with a linear solution whose matrix is not nearly a rotation though it fits."""
    size = np.linalg.svd(found.M, compute_uv=False)
    if size[2] < ROUND * size[0] or found.misfit > 0.1 * float(np.cbrt(np.prod(size))) * sight.spread:
        return ""
    scale = float(np.cbrt(np.prod(size)))
    if np.linalg.det(found.M) < 0:
        return "The axes of the camera are left-handed: one of them is reversed."
    if abs(np.log(scale)) > np.log(OTHER_UNIT):
        return f"Points times {scale:.3g} would fit: perhaps millimetres were given as metres."
    return ""


def _other_reading(sight: Sight, now: float) -> str:
    """Return the reading of the poses that fits much better, "" where none does."""
    N = len(sight.tA)
    inverse = sight.RA.transpose(0, 2, 1)
    other = {
        "The poses of the robot are the inverse of what was expected, or the setup is the other one.": sight.linear(
            inverse, -(inverse @ sight.tA[:, :, None])[:, :, 0]
        ).misfit,
        "One of the records is in reverse order.": sight.linear(sight.RA[::-1], sight.tA[::-1]).misfit,
    }
    for k in (1, 2, 3):
        text = f"The records are shifted by {k} samples against each other."
        for move in (k, -k):
            keep = (sight.sample + move >= 0) & (sight.sample + move < N)
            misfit = sight.only(keep).linear(np.roll(sight.RA, -move, axis=0), np.roll(sight.tA, -move, axis=0)).misfit
            other[text] = min(misfit, other.get(text, np.inf))
    cause = min(other, key=lambda text: other[text])
    return cause if other[cause] < MUCH_BETTER * now else ""
