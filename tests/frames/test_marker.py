"""Poses of a marker from its points, and files of a tracker."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.errors import NotExcited, ShapeError
from armlab.frames import Plane, build, check_offset, fit_line, fit_plane, marker_pose, project
from armlab.frames.marker import MarkerPoses
from armlab.lie import se3, so3
from armlab.log.nikon import read_cloud, read_matrix, read_plane

MARKER = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.03, 0.08, 0.0], [0.05, 0.02, 0.06]])
SIGMA = 1e-4
FILES = {  # scene -> cloud, plane
    "edge": ("CloudSeam_edge.txt", "PlaneSeam_edge.txt"),
    "edge2": ("CloudSeam2_edge.txt", "PlaneSeam_edge.txt"),
    "straight": ("CloudSeamStraight.txt", "PlaneSeamStraight.txt"),
    "fixture": ("CloudSeam_Fixture.txt", "PlaneSeam_Fixture.txt"),
}
JSON = 1e-9  # the file has nine decimals


def draw(seed: int, N: int = 30, marker: np.ndarray = MARKER, sigma: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    T = se3.from_rp(so3.exp(2.0 * rng.standard_normal((N, 3))), rng.standard_normal((N, 3)))
    p = np.einsum("nij,kj->nki", T[:, :3, :3], marker) + T[:, None, :3, 3]
    return T, p + sigma * rng.standard_normal(p.shape)


def errors(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.hstack([(T - truth)[:, :3, 3], so3.log(np.swapaxes(truth[:, :3, :3], 1, 2) @ T[:, :3, :3])])


@pytest.mark.parametrize("K", [3, 4])
def test_exact_data_give_the_exact_poses(K: int) -> None:
    T, p = draw(0, marker=MARKER[:K])
    found = marker_pose(p, MARKER[:K])
    assert isinstance(found, MarkerPoses)
    np.testing.assert_allclose(found.T, T, atol=1e-12)
    assert found.valid.all()
    assert found.rms.max() < 1e-12
    with pytest.raises(ValueError, match="read-only"):
        found.T[0, 0, 0] = 1.0


def test_three_points_make_their_own_marker() -> None:
    T, p = draw(1, marker=MARKER[[1, 2, 0]])
    found = marker_pose(p)
    assert found.marker[0].tolist() == [0.0, 0.0, 0.0]
    assert found.marker[1, 0] > 0
    assert found.marker[2, 1] > 0
    assert np.abs(found.marker[:, 2]).max() == 0.0
    between = np.linalg.norm(found.marker - found.marker[[1, 2, 0]], axis=1)
    np.testing.assert_allclose(between, np.linalg.norm(p[0] - p[0, [1, 2, 0]], axis=1), atol=1e-12)
    held = np.linalg.inv(found.T) @ T  # the marker has not changed in the hand
    np.testing.assert_allclose(held, np.broadcast_to(held[0], held.shape), atol=1e-10)


def test_missing_points_cost_a_pose_only_below_three_and_the_pairing_stays() -> None:
    T, p = draw(2)
    seen = np.ones((30, 4), dtype=bool)
    seen[3, 0] = seen[7, :2] = seen[9] = False
    p[~seen] = np.nan
    found = marker_pose(p, MARKER, visible=seen)
    assert np.flatnonzero(~found.valid).tolist() == [7, 9]
    assert found.T.shape == (30, 4, 4)
    assert np.isnan(found.T[[7, 9]]).all()
    assert np.isnan(found.rms[[7, 9]]).all()
    assert np.isnan(found.cov[[7, 9]]).all()
    np.testing.assert_allclose(found.T[found.valid], T[found.valid], atol=1e-12)


def test_points_in_a_line_give_no_pose() -> None:
    line = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [0.1, 0.1, 0.0]])
    _, p = draw(3, marker=line)
    seen = np.ones((30, 4), dtype=bool)
    seen[5, 3] = False  # the remaining points are collinear
    assert np.flatnonzero(~marker_pose(p, line, visible=seen).valid).tolist() == [5]
    with pytest.raises(NotExcited, match="non-collinear") as caught:
        marker_pose(p[:, :3], line[:3])
    assert "about the line" in caught.value.directions[0]
    with pytest.raises(NotExcited, match="at least three non-collinear points"):
        marker_pose(p[:, :2], line[:2])


def test_a_mirrored_marker_never_gives_a_reflection() -> None:
    _, p = draw(4)
    found = marker_pose(p, MARKER * [1.0, 1.0, -1.0])
    np.testing.assert_allclose(np.linalg.det(found.T[:, :3, :3]), 1.0, atol=1e-12)
    assert found.rms.min() > 5e-3


def test_the_ancestors_leds_to_tf_does_not_return() -> None:
    """The ancestor took axes from point differences, not least squares, and lost the pairing by skipping frames."""
    T, p = draw(5, 400, sigma=SIGMA)
    p[11, 2] += [0.003, 0.0, 0.0]
    found = marker_pose(p, MARKER)
    assert len(found.T) == 400
    assert int(np.argmax(found.rms)) == 11
    assert found.rms[11] > 5 * np.median(found.rms)
    good = np.arange(400) != 11
    e = errors(found.T, T)
    by_differences = p[:, 1] - p[:, 0]
    theirs = by_differences / np.linalg.norm(by_differences, axis=1, keepdims=True) - T[:, :3, 0]
    ours = found.T[:, :3, 0] - T[:, :3, 0]
    assert np.sqrt(np.mean(ours[good] ** 2)) < 0.85 * np.sqrt(np.mean(theirs[good] ** 2))
    assert np.abs(e[good]).max() < 10 * SIGMA / 0.05


@pytest.mark.parametrize("known", [True, False], ids=["noise given", "noise found"])
def test_covariance_is_honest(known: bool) -> None:
    T, p = draw(6, 2000, sigma=SIGMA)
    seen = np.ones((2000, 4), dtype=bool)
    seen[::5, 1] = False
    found = marker_pose(p, MARKER, visible=seen, noise=SIGMA if known else None)
    assert found.noise == pytest.approx(SIGMA, rel=0.03)
    e = errors(found.T, T)
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.cov), e) / 6
    assert np.mean(nees) == pytest.approx(1.0, abs=0.06)
    assert np.mean(nees[::5]) == pytest.approx(1.0, abs=0.12)


def test_bad_input_is_refused_by_name() -> None:
    _, p = draw(7)
    spoilt = p.copy()
    spoilt[4, 1] = np.nan
    for given, words in (
        ({"p": p[0]}, r"p of shape \(N, K, 3\), got \(4, 3\)"),
        ({"p": "led"}, "p to be real numbers"),
        ({"p": spoilt}, "NaN or Inf in 1 rows: 4"),
        ({"marker": MARKER[:3]}, r"marker to be \(4, 3\)"),
        ({"visible": np.ones((30, 4))}, "visible to be booleans"),
        ({"visible": np.ones((30, 3), dtype=bool)}, "visible to be booleans"),
        ({"noise": 0.0}, r"noise \[m\] above zero"),
    ):
        with pytest.raises(ShapeError, match=words):
            marker_pose(**{"p": p, "marker": MARKER, **given})
    with pytest.raises(NotExcited, match="three points without marker=, got 4"):
        marker_pose(p)
    never = np.ones((30, 3), dtype=bool)
    never[:, 0] = False
    with pytest.raises(NotExcited, match="points 0 and 1 are both visible"):
        marker_pose(p[:, :3], visible=never)


def millimetres(T: np.ndarray) -> np.ndarray:
    T = T.copy()
    T[:3, 3] *= 1e3
    return T


def seam(p: np.ndarray, plane: Plane) -> np.ndarray:
    """Pose of a seam in the tracker's frame: z along it, y against the plate, at its first point."""
    return build(z=fit_line(p).value, y=-plane, origin=p[0]).T


@pytest.mark.parametrize(("scene", "raw"), [*((scene, True) for scene in FILES), ("edge", False)])
def test_scenes_are_those_of_the_reference(tracker: Path, reference: dict[str, Any], scene: str, raw: bool) -> None:
    cloud, flat = (tracker / name for name in FILES[scene])
    want = reference["scenes"][scene] if raw else reference["scenes"][scene]["renormalised"]
    p, plate = read_cloud(cloud).p, read_plane(flat, raw=raw)
    plane = Plane.of(plate.normal, plate.point)
    on = p - np.outer((p - plate.point) @ plate.normal, plate.normal) if raw else project(p, plane)
    line = fit_line(on)
    np.testing.assert_allclose(line.value.v, want["line_v"], rtol=0, atol=JSON)
    np.testing.assert_allclose(1e3 * line.value.r, want["line_r"], rtol=0, atol=JSON)
    T_tracker_seam = seam(on, plane)
    T_base_tracker, T_tracker_table = (read_matrix(tracker / name).T for name in ("T_RB_T.mat", "T_T_Table.mat"))
    np.testing.assert_allclose(millimetres(T_tracker_seam), want["T_T_SEAM"], rtol=0, atol=JSON)
    np.testing.assert_allclose(millimetres(T_base_tracker @ T_tracker_seam), want["T_RB_SEAM"], rtol=0, atol=JSON)
    T_table_tracker = se3.inv(T_tracker_table)  # the rotation transposed as stored: it is off by 7.5e-10
    np.testing.assert_allclose(millimetres(T_table_tracker @ T_tracker_seam), want["T_TAB_SEAM"], rtol=0, atol=JSON)
    if raw:
        assert 1e3 * np.sqrt(2 * len(p) - 4) * line.sigma[0] / 2 == pytest.approx(want["line_rms_mm"], abs=1e-9)
        np.testing.assert_allclose(1e3 * plane.distance(p), want["point_plane_distance_mm"], rtol=0, atol=3e-4)


@pytest.mark.parametrize("scene", ["edge", "fixture"])
def test_planes_and_lines_of_the_reference(tracker: Path, reference: dict[str, Any], scene: str) -> None:
    want = reference["scenes"][scene]
    p = read_cloud(tracker / FILES[scene][0]).p
    flat = fit_plane(p, normal=want["fitplane_cloud"]["n"], limit=0.3).value  # seams: nearly lines
    np.testing.assert_allclose(flat.n, want["fitplane_cloud"]["n"], rtol=0, atol=JSON)
    np.testing.assert_allclose(1e3 * flat.n * flat.d, want["fitplane_cloud"]["r"], rtol=0, atol=JSON)
    T_base_tracker = read_matrix(tracker / "T_RB_T.mat").T
    plate = read_plane(tracker / FILES[scene][1])
    plane = Plane.of(plate.normal, plate.point).moved(T_base_tracker)
    raw = read_plane(tracker / FILES[scene][1], raw=True)
    length = np.linalg.norm(raw.normal)  # six decimals
    np.testing.assert_allclose(length * plane.n, want["plane_in_RB"]["n"], rtol=0, atol=JSON)
    on = p - np.outer((p - raw.point) @ raw.normal, raw.normal)
    line = fit_line(on).value.moved(T_base_tracker)
    np.testing.assert_allclose(line.v, want["line_in_RB"]["v"], rtol=0, atol=JSON)
    np.testing.assert_allclose(1e3 * line.r, want["line_in_RB"]["r"], rtol=0, atol=JSON)


def test_the_outlier_of_the_fixture_is_flagged_by_both(tracker: Path) -> None:
    p = read_cloud(tracker / "CloudSeam_Fixture.txt").p
    plate = read_plane(tracker / "PlaneSeam_Fixture.txt")
    line = fit_line(p, robust=True)
    away = 1e3 * np.linalg.norm(line.residuals, axis=1)
    assert line.outliers.tolist() == [False, False, False, True]
    assert away[:3].max() <= 0.09
    assert away[3] == pytest.approx(17.96, abs=0.005)
    found = check_offset(Plane.of(plate.normal, plate.point), p)
    np.testing.assert_allclose(1e3 * found.distances, [-0.251, -0.351, -0.223, 17.738], rtol=0, atol=5e-4)
    assert found.outliers.tolist() == [False, False, False, True]


@pytest.mark.parametrize("scene", ["edge", "edge2", "straight"])
def test_no_point_of_the_other_clouds_is_flagged(tracker: Path, scene: str) -> None:
    cloud, flat = (tracker / name for name in FILES[scene])
    p, plate = read_cloud(cloud).p, read_plane(flat)
    found = check_offset(Plane.of(plate.normal, plate.point), p)
    assert not found.outliers.any()
    assert abs(found.offset) == pytest.approx(0.005, abs=2e-4)  # the probe's tip
    assert not fit_line(p, robust=True).outliers.any()
