"""The ancestor's weld seams: real clouds, planes and poses of a tracker against an independent computation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.frames import Plane, build, check_offset, fit_line, fit_plane, project
from armlab.lie import se3
from armlab.log.nikon import read_cloud, read_matrix, read_plane

FILES = {  # scene -> cloud, plane
    "edge": ("CloudSeam_edge.txt", "PlaneSeam_edge.txt"),
    "edge2": ("CloudSeam2_edge.txt", "PlaneSeam_edge.txt"),
    "straight": ("CloudSeamStraight.txt", "PlaneSeamStraight.txt"),
    "fixture": ("CloudSeam_Fixture.txt", "PlaneSeam_Fixture.txt"),
}
STORED = {"edge": "T_T_SEAM.mat", "edge2": "T_T_SEAM2.mat", "straight": "T_T_SEAM_Straight.mat"}
JSON = 1e-9  # the file has nine decimals


def millimetres(T: np.ndarray) -> np.ndarray:
    T = T.copy()
    T[:3, 3] *= 1e3
    return T


def seam(p: np.ndarray, plane: Plane) -> np.ndarray:
    """Pose of a seam in the tracker's frame: z along it, y against the plate, at its first point."""
    return build(z=fit_line(p).value, y=-plane, origin=p[0]).T


@pytest.mark.parametrize("scene", FILES)
@pytest.mark.parametrize("raw", [True, False])
def test_scenes_are_those_of_the_reference(tracker: Path, reference: dict[str, Any], scene: str, raw: bool) -> None:
    """With the normal as in the file, as the ancestor used it, and with its length made 1."""
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


@pytest.mark.parametrize("scene", STORED)
def test_stored_results_are_reproduced(tracker: Path, scene: str) -> None:
    """MAT files of version 7.3 that the ancestor wrote, with the normal as in the file: to 1e-9 mm."""
    pytest.importorskip("h5py", reason="needs h5py: MAT files of version 7.3 are HDF5")
    cloud, flat = (tracker / name for name in FILES[scene])
    p, plate = read_cloud(cloud).p, read_plane(flat, raw=True)
    on = p - np.outer((p - plate.point) @ plate.normal, plate.normal)
    stored = read_matrix(tracker / STORED[scene]).T
    found = seam(on, Plane.of(plate.normal, plate.point))
    np.testing.assert_allclose(millimetres(found), millimetres(stored), rtol=0, atol=1e-9)


@pytest.mark.parametrize("scene", FILES)
def test_planes_and_lines_of_the_reference(tracker: Path, reference: dict[str, Any], scene: str) -> None:
    """The clouds themselves, and features moved to the robot's base."""
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


def test_the_matrix_that_is_no_rotation(tracker: Path) -> None:
    found = read_matrix(tracker / "T_TF_M.mat", project=True)
    assert found.distance == pytest.approx(9.3e-6, rel=0.01)
    with pytest.raises(ValueError, match="project=True"):
        read_matrix(tracker / "T_TF_M.mat")
