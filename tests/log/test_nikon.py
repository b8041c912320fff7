"""Files of a tracker: what is read is what stands there, in metres; damaged files give a value or a sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from armlab.errors import LogError
from armlab.lie import euler, se3, so3
from armlab.log.nikon import Cloud, PlaneFile, PoseFile, read_cloud, read_matrix, read_plane

CLOUD = (
    "[0.000000 , -450.925232 , 144.769196 , -2566.102783 , 10.0 , 20.0 , 30.0 ;\r\n"
    "1.000000 , -451.412628 , 187.260742 , -2575.094238 , -113.191585 , 0.976892 , -139.300146]\r\n"
    "\r\n// REF_OBJECT = \r\n// MEAS_OBJECT = CloudSeam"
)
PLANE = (
    "[-0.011454 , -0.005684 , 0.999918 , -447.610821 ;\r\n0.504093 , 0.863583 , 0.010683 , 239.195030 ;\r\n"
    "-0.863574 , 0.504174 , -0.007026 , -2653.884552 ;\r\n0.000000 , 0.000000 , 0.000000 , 1.000000]\r\n\r\n"
    "// MEAS_OBJECT = PlaneSeam"
)


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "file.txt"
    path.write_bytes(text.encode())
    return path


def test_read_cloud(tmp_path: Path) -> None:
    cloud = read_cloud(write(tmp_path, CLOUD))
    assert isinstance(cloud, Cloud)
    np.testing.assert_allclose(cloud.p[0], [-0.450925232, 0.144769196, -2.566102783], rtol=0, atol=1e-15)
    assert cloud.index.tolist() == [0.0, 1.0]
    np.testing.assert_allclose(cloud.R[0], euler.from_rpy(np.deg2rad([10.0, 20, 30]), "xyz"), atol=1e-15)
    assert (cloud.stopped, cloud.comments) == (4, {"REF_OBJECT": "", "MEAS_OBJECT": "CloudSeam"})
    assert not cloud.p.flags.writeable


@pytest.mark.parametrize(
    "change",
    [
        lambda s: s.replace(" , ", " "),
        lambda s: s.replace(" , ", ","),
        lambda s: s.replace(" , ", "\t,\t"),
        lambda s: s.replace("\r\n", "\n"),
        lambda s: "\ufeff" + s.replace("[", '"[ ').replace("]", "]' "),
        lambda s: s.replace(";", ""),
        lambda s: "\n\n" + s,
    ],
)
def test_other_separators_read_the_same(tmp_path: Path, change) -> None:
    np.testing.assert_array_equal(read_cloud(write(tmp_path, change(CLOUD))).p, read_cloud(write(tmp_path, CLOUD)).p)


def test_an_empty_line_ends_nothing_and_a_word_ends_the_cloud(tmp_path: Path) -> None:
    first, second = CLOUD.split("\r\n")[:2]
    cloud = read_cloud(write(tmp_path, f"{first}\n\n{second}"))
    assert (len(cloud.p), cloud.stopped) == (2, 0)
    cloud = read_cloud(write(tmp_path, f"{first}\n// end\n{second}"))
    assert (len(cloud.p), cloud.stopped) == (1, 2)


def test_read_plane_makes_the_normal_unit_unless_raw(tmp_path: Path) -> None:
    path = write(tmp_path, PLANE)
    plane, raw = read_plane(path), read_plane(path, raw=True)
    assert isinstance(plane, PlaneFile)
    assert np.linalg.norm(plane.normal) == pytest.approx(1.0, abs=1e-15)
    assert raw.normal.tolist() == [0.999918, 0.010683, -0.007026]
    np.testing.assert_allclose(plane.point, [-0.447610821, 0.239195030, -2.653884552], rtol=0, atol=1e-15)
    assert plane.comments == {"MEAS_OBJECT": "PlaneSeam"}


@pytest.mark.parametrize(
    ("read", "text", "sentence"),
    [
        (read_cloud, "", "an empty file"),
        (read_cloud, "hello\n", "'hello' in line 1"),
        (read_cloud, "1 2 3\n", "3 in line 1"),
        (read_cloud, CLOUD.replace("144.769196", "NaN"), "'NaN' in line 1, column 3"),
        (read_cloud, CLOUD.replace("187.260742", "1e999"), "'1e999' in line 2, column 3"),
        (read_cloud, CLOUD.replace("0.976892 , ", ""), "6 in line 2"),
        (read_cloud, PLANE, "4 in line 1"),
        (read_cloud, "a\0b", "bytes"),
        (read_plane, PLANE.replace("1.000000]", "2.000000]"), "last row"),
        (read_plane, "\n".join(PLANE.split("\r\n")[:3]), "3 rows"),
        (read_plane, PLANE.replace("0.999918", "0.899918"), "normal of length 1"),
        (read_plane, CLOUD, "7 in line 1"),
    ],
)
def test_other_files_are_refused_with_line_and_column(tmp_path: Path, read, text: str, sentence: str) -> None:
    with pytest.raises(LogError, match=sentence):
        read(write(tmp_path, text))
    with pytest.raises(LogError, match="No such file"):
        read(tmp_path / "missing.txt")


@pytest.mark.parametrize(("read", "text"), [(read_cloud, CLOUD), (read_plane, PLANE)])
def test_cut_at_every_byte_or_with_wrong_ones(tmp_path: Path, read, text: str) -> None:
    rng = np.random.default_rng(0)
    spoilt = []
    for _ in range(100):
        data = bytearray(text.encode())
        data[rng.integers(0, len(data))] = rng.integers(0, 256)
        spoilt.append(bytes(data))
    path = tmp_path / "spoilt.txt"
    for data in [text.encode()[:n] for n in range(len(text))] + spoilt:
        path.write_bytes(data)
        try:
            read(path)
        except LogError as error:
            assert str(error).endswith(".")  # noqa: PT017


def pose_file(tmp_path: Path, M: np.ndarray, **more: np.ndarray) -> Path:
    path = tmp_path / "pose.mat"
    savemat(path, {"T_a_b": M, **more})
    return path


def test_read_matrix(tmp_path: Path) -> None:
    T = se3.from_rp(so3.exp([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    found = read_matrix(pose_file(tmp_path, T))
    assert isinstance(found, PoseFile)
    np.testing.assert_allclose(found.T[:3, 3], [1e-3, 2e-3, 3e-3], rtol=1e-15)
    np.testing.assert_array_equal(found.T[:3, :3], T[:3, :3])
    assert found.name == "T_a_b"
    two = pose_file(tmp_path, T, other=T)
    assert read_matrix(two, "other").name == "other"
    with pytest.raises(LogError, match="name="):
        read_matrix(two)


def test_a_rotation_that_is_none_is_projected_on_demand_only(tmp_path: Path) -> None:
    T = se3.from_rp(so3.exp([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    T[0, 0] += 1e-5
    path = pose_file(tmp_path, T)
    with pytest.raises(LogError, match=r"project=True"):
        read_matrix(path)
    found = read_matrix(path, project=True)
    assert se3.is_pose(found.T, 1e-14)
    assert found.distance == pytest.approx(1e-5, rel=0.3)
    T[0, 0] -= 1e-5
    T[0, 0] += 1e-8  # rounding of a file: left as it is
    np.testing.assert_array_equal(read_matrix(pose_file(tmp_path, T)).T[:3, :3], T[:3, :3])


@pytest.mark.parametrize(
    ("M", "sentence"),
    [
        (np.diag([1.0, 1, -1, 1]), "left-handed"),
        (np.diag([1.0, 1, 1, 2]), "another matrix"),
        (np.diag([np.nan, 1, 1, 1]), "row 1"),
        (np.zeros((4, 4)), "another matrix"),
        (np.eye(3), "one 4x4 array"),
    ],
)
def test_what_is_no_pose_is_refused(tmp_path: Path, M: np.ndarray, sentence: str) -> None:
    with pytest.raises(LogError, match=sentence):
        read_matrix(pose_file(tmp_path, M), project=True)
