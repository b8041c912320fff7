"""Calibration samples: the same numbers from every format, and error messages for files without samples."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from armlab import log as logs
from armlab import models, robots, sim
from armlab.cli.calibrate.camera import _chained, _edges, at_times, camera_in
from armlab.cli.calibrate.samples import Samples, Wanted, measured_rows, noise_of, read_samples, run_fit, tool_poses
from armlab.errors import ConfigError, LogError
from armlab.kinematics import forward
from armlab.lie import euler, quaternion, se3, so3
from armlab.log import Column, Table

from .conftest import samples_csv


def as_quaternions(name: str, T: np.ndarray, unit: str = "") -> dict[str, np.ndarray]:
    scale = 1e3 if unit == " [mm]" else 1.0
    found = {f"{name}_{axis}{unit}": scale * T[:, k, 3] for k, axis in enumerate("xyz")}
    q = quaternion.from_matrix(T[:, :3, :3])
    return found | {f"{name}_q{axis}": q[:, k] for k, axis in enumerate("wxyz")}


@pytest.fixture(scope="module")
def T() -> np.ndarray:
    return sim.cell(1).hand_eye(N=7).B


def test_a_pose_is_the_same_from_every_format(T: np.ndarray, tmp_path: Path) -> None:
    one, two, three = (tmp_path / f"{k}.csv" for k in range(3))
    found = [samples_csv(one, {"pose": T}), samples_csv(two, as_quaternions("pose", T))]
    found.append(samples_csv(three, {"t [ms]": np.arange(7.0), **as_quaternions("pose", T, " [mm]")}))
    for k, layout in enumerate((T, np.moveaxis(T, 0, -1), T.reshape(7, 16), np.swapaxes(T, 1, 2).reshape(7, 16))):
        savemat(tmp_path / f"{k}.mat", {"pose": layout})
        found.append(tmp_path / f"{k}.mat")
    column = Column(unit="1", kind="pose")
    table = Table(np.arange(7.0), {"q": np.zeros((7, 6)), "pose": T}, {"pose": column})
    found.append(logs.write(table, tmp_path / "one.mcap", robots.load("irb2400")))
    with h5py.File(tmp_path / "hdf5.mat", "w") as file:
        file["pose"] = T  # from another program, which does not transpose
    found.append(tmp_path / "hdf5.mat")
    for path in found:
        read = read_samples(path)
        assert "pose" in read
        np.testing.assert_allclose(read.poses("pose"), T, atol=1e-12, err_msg=path.name)
        assert read.source.startswith(f"{path.name} sha256 ")


def test_four_poses_of_a_mat_file_are_told_by_their_last_rows(T: np.ndarray, tmp_path: Path) -> None:
    for layout in (T[:4], np.moveaxis(T[:4], 0, -1)):
        savemat(tmp_path / "four.mat", {"pose": layout})
        np.testing.assert_array_equal(read_samples(tmp_path / "four.mat").poses("pose"), T[:4])


def test_vectors_and_numbers(tmp_path: Path) -> None:
    f = np.arange(12.0).reshape(4, 3)
    path = samples_csv(tmp_path / "f.csv", {"force": f, "plane": np.arange(4)})
    read = read_samples(path)
    np.testing.assert_array_equal(read.vectors("force", (3, 6)), f)
    np.testing.assert_array_equal(read.numbers("plane"), np.arange(4))
    assert "torque" not in read
    for layout in (f, f.T):
        savemat(tmp_path / "f.mat", {"force": layout, "plane": np.arange(4.0)[:, None]})
        read = read_samples(tmp_path / "f.mat")
        np.testing.assert_array_equal(read.vectors("force", (3,)), f)
        np.testing.assert_array_equal(read.numbers("plane"), np.arange(4))


def test_points_and_vectors_by_their_axes(tmp_path: Path) -> None:
    p = np.arange(24.0).reshape(4, 2, 3)
    flat = {f"led{k + 1}_{axis} [mm]": 1e3 * p[:, k, i] for k in range(2) for i, axis in enumerate("xyz")}
    one = {f"tip_{axis} [mm]": 1e3 * p[:, 0, i] for i, axis in enumerate("xyz")}
    read = read_samples(samples_csv(tmp_path / "p.csv", flat | one))
    np.testing.assert_allclose(read.points("led"), p)
    np.testing.assert_allclose(read.vectors("tip", (3,)), p[:, 0])
    for layout in (p, p.transpose(2, 1, 0), p.reshape(4, 6)):
        savemat(tmp_path / "p.mat", {"led": layout})
        np.testing.assert_array_equal(read_samples(tmp_path / "p.mat").points("led"), p)
    with pytest.raises(LogError, match=r"points a of shape \(N, K, 3\)"):
        Samples(tmp_path / "x.csv", {"a": np.zeros((4, 2, 2))}, "").points("a")


def test_what_is_not_there_is_told(T: np.ndarray, tmp_path: Path) -> None:
    longer = as_quaternions("pose", T)
    longer["pose_qw"] = longer["pose_qw"] * np.where(np.arange(7) == 2, 1.1, 1.0) + (np.arange(7) == 2)
    turned = T.copy()
    turned[:, 3, 0] = 1.0
    empty = Samples(tmp_path / "x.csv", {"a": np.zeros(3), "word": np.array(["one", "two", "six"])}, "")
    quaternions = samples_csv(tmp_path / "q.csv", longer)
    cases = [
        (lambda: empty.poses("pose"), "Expected pose in .*x.csv, got a, word"),
        (lambda: empty.vectors("a", (3,)), r"a of shape \(N, 3\) in .*, got \(3,\)"),
        (lambda: empty.numbers("word"), "numbers in word of .* text such as 'one'"),
        (lambda: Samples(empty.path, {"a": np.zeros((3, 2))}, "").numbers("a"), r"one number per sample .*\(3, 2\)"),
        (lambda: Samples(empty.path, {"pose": turned}, "").poses("pose"), "a last row other than 0 0 0 1"),
        (lambda: read_samples(quaternions).poses("pose"), "length 1 in pose_qw .* in sample 2"),
        (lambda: read_samples(tmp_path / "none.csv"), "none.csv"),
        (lambda: read_samples(tmp_path / "none.mat"), "MAT file at .*none.mat"),
    ]
    for case, words in cases:
        with pytest.raises(LogError, match=words):
            case()


@pytest.mark.parametrize("content", [b"", b"\x00\x01\x02\xff" * 40, b"a,b\n1\n", "a,b\n1;5,2\n".encode("utf-16")])
@pytest.mark.parametrize("ending", [".csv", ".mat", ".mcap"])
def test_files_of_something_else_are_refused_by_a_sentence(content: bytes, ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"bad{ending}"
    path.write_bytes(content)
    with pytest.raises(LogError, match="Expected"):
        read_samples(path)


def test_semicolons_and_tabs_are_seen(T: np.ndarray, tmp_path: Path) -> None:
    text = samples_csv(tmp_path / "a.csv", as_quaternions("pose", T, " [mm]")).read_text(encoding="utf-8")
    for mark in ";\t":
        (tmp_path / "b.csv").write_text(text.replace(",", mark), encoding="utf-8")
        np.testing.assert_allclose(read_samples(tmp_path / "b.csv").poses("pose"), T, rtol=0, atol=1e-12)
    (tmp_path / "c.csv").write_text(text.replace(",", ";").replace(".", ","), encoding="utf-8")
    with pytest.raises(LogError, match="Expected a decimal point"):
        read_samples(tmp_path / "c.csv")


@pytest.mark.parametrize(("name", "unit"), [("force", "N m"), ("acc", "deg"), ("position", "rad")])
def test_a_unit_of_something_else_is_refused(name: str, unit: str, tmp_path: Path) -> None:
    columns = {f"{name}{k} [{unit}]": np.arange(4.0) for k in (1, 2, 3)}
    with pytest.raises(LogError, match=f"Expected {name}1 of .* in .*, got"):
        read_samples(samples_csv(tmp_path / "a.csv", columns)).vectors(name, (3,))


@pytest.mark.parametrize("labels", [("q1 [deg]", "q2"), ("position1 [mm]", "position2"), ("T_x [mm]", "T_y")])
def test_units_for_some_components_are_refused(labels: tuple[str, str], tmp_path: Path) -> None:
    with pytest.raises(LogError, match="unit for all components"):
        read_samples(samples_csv(tmp_path / "a.csv", {label: np.arange(4.0) for label in labels}))


def test_what_a_table_drops_is_said(tmp_path: Path, capsys) -> None:
    read_samples(samples_csv(tmp_path / "a.csv", {"t [s]": np.array([0.0, 0.0, 1.0]), "plane": np.arange(3.0)}))
    assert "a.csv: 1 rows dropped: their time does not increase (line 3)" in capsys.readouterr().err


def test_joints_of_a_bag_are_left_out_since_their_order_is_not_known(ur5e_bag: Path, capsys, monkeypatch) -> None:
    one_rate = logs.read(ur5e_bag, ["q", "tau"])
    monkeypatch.setattr("armlab.log.read", lambda path, *_: one_rate)
    samples = read_samples(ur5e_bag)
    assert "export bag samples.csv --robot NAME" in capsys.readouterr().err
    with pytest.raises(LogError, match=r"Expected q in .*bag"):
        samples.vectors("q", [6])


def samples(**values: np.ndarray) -> Samples:
    return Samples(Path("some.mat"), values, "some.mat sha256 0")


@pytest.mark.slow
def test_several_files_are_fitted_together_and_named(tmp_path: Path, command) -> None:
    seen = sim.cell(5).hand_eye(N=40)
    parts = [(slice(0, 25), "one.mat"), (slice(25, 40), "two.mat")]
    for rows, name in [*parts, (slice(0, 40), "all.mat")]:
        savemat(tmp_path / name, {"T_base_tool": seen.A[rows], "T_cam_marker": seen.B[rows]})
    out = tmp_path / "camera.toml"
    files = [str(tmp_path / name) for _, name in parts]
    page = tmp_path / "camera.html"
    joined = json.loads(command(["calibrate", "hand-eye", *files, "--json", "-o", out, "--report", page]).out)
    assert [source.split()[0] for source in joined["sources"]] == ["one.mat", "two.mat"]
    assert all(source in out.read_text(encoding="utf-8") for source in joined["sources"])
    assert "two.mat sha256" in page.read_text(encoding="utf-8")
    whole = json.loads(command(["calibrate", "hand-eye", tmp_path / "all.mat", "--json"]).out)
    assert whole["parameters"] == joined["parameters"]
    assert models.load(out, "hand_eye").setup == "eye_to_hand"


def test_files_that_measured_something_else_are_refused(tmp_path: Path) -> None:
    for k, width in enumerate((3, 6)):
        savemat(tmp_path / f"{k}.mat", {"y": np.arange(4.0 * width).reshape(4, width)})
    files = [tmp_path / f"{k}.mat" for k in range(2)]
    with pytest.raises(LogError, match=r"\(4, 3\) in 0\.mat, \(4, 6\) in 1\.mat"):
        run_fit("job", files, lambda read: (read.vectors("y"),), lambda y: y, Wanted())


def test_rows_that_were_measured(capsys) -> None:
    q, a, b = np.arange(8.0).reshape(4, 2), np.array([1.0, np.nan, np.nan, 4.0]), np.array([np.nan, 2.0, np.nan, 4.0])
    got = measured_rows(samples(), (q,), (a, b))
    np.testing.assert_array_equal(got[0], q[[0, 1, 3]])
    np.testing.assert_array_equal(got[-1], [0, 1, 3])
    assert "1 of 4 rows of some.mat have no measurement" in capsys.readouterr().err
    assert len(measured_rows(samples(), (q, a))[0]) == 2
    assert len(measured_rows(samples(), (q,), (a, b), every=True)[0]) == 4
    with pytest.raises(LogError, match=r"equal sample counts in some\.mat, got 4, 3"):
        measured_rows(samples(), (q, a[:3]))


def test_noise_and_poses_of_the_tool() -> None:
    assert (noise_of(None), noise_of([0.1]), noise_of([0.1, 0.2])) == (None, 0.1, (0.1, 0.2))
    q = np.random.default_rng(0).uniform(-1, 1, (5, 6))
    T = forward(robots.load("irb2400"), q)
    np.testing.assert_array_equal(tool_poses(samples(q=q), "irb2400"), T)
    np.testing.assert_array_equal(tool_poses(samples(T_base_tool=T), None), T)
    with pytest.raises(LogError, match="Expected T_base_tool"):
        tool_poses(samples(q=q), None)
    with pytest.raises(LogError, match="probably in degrees"):
        tool_poses(samples(q=np.rad2deg(q)), "irb2400")


def test_copies_of_a_sample_count_once_and_held_values_are_told(capsys) -> None:
    seen = sim.cell(5).hand_eye(N=6)
    twice = np.repeat(np.arange(6), 2)
    A, B, rows = measured_rows(samples(), (seen.A[twice], seen.B[twice]))
    np.testing.assert_array_equal(A, seen.A)
    np.testing.assert_array_equal(B, seen.B)
    np.testing.assert_array_equal(rows, np.arange(0, 12, 2))
    assert "6 of 12 rows of some.mat repeat earlier rows" in capsys.readouterr().err
    measured_rows(samples(), (seen.A, seen.B[[0, 0, 2, 3, 3, 5]]))
    assert "2 rows of some.mat repeat the previous measurement" in capsys.readouterr().err
    measured_rows(samples(), (seen.A, seen.B))
    assert capsys.readouterr().err == ""


def test_parts_of_a_measurement_are_refused_by_their_row() -> None:
    seen = sim.cell(5).hand_eye(N=6)
    B = seen.B.copy()
    B[1], B[4, 0, 3] = np.nan, np.nan
    with pytest.raises(LogError, match=r"missing numbers in 1 of 6 rows, first in row 4"):
        measured_rows(samples(), (seen.A, B))


FORMS = {
    "rotvec": lambda R: so3.log(R),
    "xyzw": lambda R: np.roll(quaternion.from_matrix(R), -1, axis=1),
    "wxyz": quaternion.from_matrix,
    "rpy_deg": lambda R: np.rad2deg(euler.to_rpy(R, "zyx")[:, ::-1]),
    "euler_zyz": lambda R: euler.to_rpy(R, "zyz"),
}


@pytest.mark.parametrize("form", FORMS)
def test_poses_of_other_programs_are_read_by_their_representation(form, tmp_path: Path) -> None:
    T = se3.exp(np.random.default_rng(0).normal(size=(5, 6)))
    numbers = np.column_stack([1e3 * T[:, :3, 3], FORMS[form](T[:, :3, :3])])
    path = tmp_path / "poses.csv"
    np.savetxt(path, numbers, delimiter=",", comments="", header=",".join(f"pose_{k}" for k in range(numbers.shape[1])))
    read = read_samples(path, f"T_base_tool:{form}=pose_{{0..}} [mm]")
    np.testing.assert_allclose(read.poses("T_base_tool"), T, rtol=0, atol=1e-12)
    with pytest.raises(ConfigError, match=r"Expected a rotation as wxyz, xyzw, rotvec.*got 'angles'"):
        read_samples(path, "T_base_tool:angles=pose_{0..}")
    named = {"rotvec": ("rx", "ry", "rz"), "rpy_deg": ("roll [deg]", "pitch [deg]", "yaw [deg]")}.get(form)
    if named:
        header = [f"T_cam_marker_{one}" for one in ("x [mm]", "y [mm]", "z [mm]", *named)]
        np.savetxt(path, numbers, delimiter=",", comments="", header=",".join(header))
        np.testing.assert_allclose(read_samples(path).poses("T_cam_marker"), T, rtol=0, atol=1e-12)


def moving(t: np.ndarray) -> np.ndarray:
    turn = np.stack([0.8 * np.sin(0.5 * t), 0.7 * np.cos(0.4 * t), 0.5 * np.sin(0.3 * t + 1)], axis=1)
    return se3.from_rp(so3.exp(turn), 0.2 * np.stack([np.sin(0.6 * t), np.cos(0.5 * t), np.sin(0.7 * t)], axis=1))


def test_two_files_with_one_clock_are_joined_by_time(tmp_path: Path, command) -> None:
    X, Y = se3.exp([0.1, 0, 0.05, 0.3, 0.2, -0.1]), se3.exp([1, 0.2, 0.4, -1, 0.3, 2])
    t, times = 5.0 + 0.008 * np.arange(2000), 6.0 + 0.3 * np.arange(45)
    seen = se3.inv(Y) @ moving(times) @ X @ se3.exp(2e-4 * np.random.default_rng(1).standard_normal((45, 6)))
    robot = samples_csv(tmp_path / "robot.csv", {"t": t, "T_base_tool": moving(t)})
    camera = samples_csv(tmp_path / "camera.csv", {"t": times, "T_cam_marker": seen})
    words = ["calibrate", "hand-eye", robot, camera, "--join", "linear", "--max-gap", "20ms"]
    command([*words, "-o", tmp_path / "eye.toml"])
    found = models.load(tmp_path / "eye.toml")
    assert np.abs(found.X - X).max() < 5e-4
    assert np.abs(found.Y - Y).max() < 5e-4
    for path, name, clock, T in ((robot, "tcp", "stamp", moving(t)), (camera, "pose", "time", seen)):  # other names
        turn = so3.log(T[:, :3, :3]) if name == "tcp" else FORMS["xyzw"](T[:, :3, :3])
        header = ",".join([clock, *(f"{name}_{k}" for k in range(3 + turn.shape[1]))])
        rows = np.column_stack([t if name == "tcp" else times, T[:, :3, 3], turn])
        np.savetxt(path, rows, delimiter=",", comments="", header=header)
    named = "t=stamp|time,T_base_tool:rotvec=tcp_{0..5},T_cam_marker:xyzw=pose_{0..6}"
    command([*words, "--columns", named, "-o", tmp_path / "named.toml"])
    assert np.abs(models.load(tmp_path / "named.toml").X - X).max() < 5e-4
    assert "Expected the columns for T_cam_marker:xyzw in" in command([*words, "--columns", named + "_"], 1).err
    robot = samples_csv(robot, {"t": t, "T_base_tool": moving(t)})
    late = samples_csv(tmp_path / "late.csv", {"t": times + 1e9, "T_cam_marker": seen})
    said = command(["calibrate", "hand-eye", robot, late, "--join", "nearest"], 1).err
    assert "data recorded with one clock, got robot.csv from 5.000" in said
    assert "time above 0, such as 20ms" in command([*words[:-1], "soon"], 2).err
    assert "Expected T_cam_marker or p_cam in one of" in command([*words[:2], robot, robot, "--join", "linear"], 1).err


def test_poses_between_and_beyond_gaps() -> None:
    t = np.delete(0.01 * np.arange(100), np.s_[40:60])
    for join, worst in (("nearest", 5e-3), ("linear", 1e-5)):
        times = np.array([0.103, 0.15, 0.499, 0.99])
        found = at_times(moving(t), t, times, join, 0.02, "robot.csv")
        assert np.isnan(found[2]).all()
        assert np.abs(found[[0, 1, 3]] - moving(times[[0, 1, 3]])).max() < worst


def test_transforms_of_a_bag_are_chained_to_the_frames_that_are_named() -> None:
    t = 0.02 * np.arange(500)
    step = se3.exp([0.1, 0.2, 0.3, 0.1, 0.2, 0.3])
    column = Column(unit="m", kind="pose", frame="base")
    arm = Table(t, {"tf.base.link": moving(t)}, {"tf.base.link": column}, t0_ns=10**18)
    fixed = Table([0.0], {"tf_static.link.tool0": step[None]}, {"tf_static.link.tool0": replace(column, frame="link")})
    eye = Table(t[::7], {"tf.camera.marker": moving(t[::7] + 3)}, {"tf.camera.marker": replace(column, frame="camera")},
                t0_ns=10**18)  # fmt: skip
    tables = {"/tf": arm, "/tf_static": fixed, "/tf camera": eye}
    way = _edges(tables, "/tf:tool0->base", Path("run"))
    T = _chained(way, t[::7] + 1e9, "linear", None, "robot")
    np.testing.assert_allclose(T, se3.inv(moving(t[::7]) @ step), rtol=0, atol=1e-6)
    np.testing.assert_allclose(_edges(tables, "/tf:camera->marker", Path("run"))[0][1], moving(t[::7] + 3))
    with pytest.raises(LogError, match=r"from base to hand in run, got frames base, camera, link, marker, tool0"):
        _edges(tables, "/tf:base->hand", Path("run"))
    with pytest.raises(LogError, match="Expected one pose per message on /pose"):
        _edges(tables, "/pose", Path("run"))


@pytest.mark.parametrize("form", ["opencv", "ros", "json"])
def test_intrinsics_are_read_as_others_write_them(form, tmp_path: Path) -> None:
    K, dist = [800.0, 0, 320, 0, 790, 240, 0, 0, 1], [-0.1, 0.01, 0, 0]
    text = {
        "opencv": "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: {}\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n   data: {}\n",
        "ros": "image_width: 640\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: {}\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 4\n  data: {}\n",
        "json": '{{"K": {}, "D": {}}}',
    }[form].format(K, dist)
    (tmp_path / "camera.yaml").write_text(text)
    found = camera_in(tmp_path / "camera.yaml")
    np.testing.assert_array_equal(found[0].ravel(), K)
    np.testing.assert_array_equal(found[1], dist)
    (tmp_path / "camera.yaml").write_text("fx: 800\n")
    with pytest.raises(LogError, match="Expected camera_matrix and distortion_coefficients"):
        camera_in(tmp_path / "camera.yaml")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--images", "pictures"], "Expected --images FOLDER and --board BOARD together"),
        (["--intrinsics", "k.yaml"], "Expected --intrinsics only with --images"),
        (["--robot-topic", "/tf:a->b"], "Expected --robot-topic and --camera-topic together"),
        (["--max-gap", "20ms"], "Expected --max-gap 20ms with --join"),
        (["--images", "p", "--board", "b", "--join", "linear"], "Expected --images without --join"),
        (["--join", "linear"], "Expected two files"),
    ],
)
def test_options_that_do_not_belong_together_are_refused(options, words, command) -> None:
    assert words in command(["calibrate", "hand-eye", "samples.csv", *options], 2).err


@pytest.mark.slow
def test_pictures_of_a_board_become_a_calibration_in_one_line(tmp_path: Path, command) -> None:
    cv2 = pytest.importorskip("cv2", reason="OpenCV, the extra vision, is not installed")
    K, rng = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]), np.random.default_rng(0)
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((7, 5), 0.03, 0.022, words).generateImage((420, 300))
    X, Y = se3.exp(0.1 * rng.standard_normal(6)), se3.exp(rng.standard_normal(6))
    seen = se3.from_rp(so3.exp(rng.uniform(-0.5, 0.5, (9, 3))), np.column_stack([rng.uniform(-0.13, -0.08, (9, 2)),
                                                                              rng.uniform(0.35, 0.45, 9)]))  # fmt: skip
    A, folder = Y @ seen @ se3.inv(X), tmp_path / "pictures"
    folder.mkdir()
    for k, T in enumerate(seen):
        plane = np.array([[0.0005, 0, 0.00025], [0, 0.0005, 0.00025], [0, 0, 1]])
        image = cv2.warpPerspective(board, K @ T[:3, [0, 1, 3]] @ plane, (640, 480), borderValue=255)
        cv2.imwrite(str(folder / f"{k}.png"), np.full_like(image, 90) if k == 4 else image)
    header = ["image", *(f"T_base_tool{i}_{j}" for i in range(1, 5) for j in range(1, 5))]
    rows = [",".join([f"{k}.png", *map(repr, map(float, T.ravel()))]) for k, T in enumerate(A)]
    (tmp_path / "poses.csv").write_text("\n".join([",".join(header), *rows]))
    (tmp_path / "k.json").write_text(json.dumps({"K": K.tolist(), "D": []}))
    options = ["--images", folder, "--board", "charuco:7x5:0.03:0.022", "--intrinsics", tmp_path / "k.json"]
    said = command(["calibrate", "hand-eye", tmp_path / "poses.csv", *options, "-o", tmp_path / "eye.toml", "--force"])
    assert "4.png: 0 board corners" in said.err
    found = models.load(tmp_path / "eye.toml")
    assert np.abs(found.Y - Y).max() < 5e-3
    (tmp_path / "poses.csv").write_text("\n".join([",".join(header), rows[0].replace("0.png", "gone.png")]))
    said = command(["calibrate", "hand-eye", tmp_path / "poses.csv", *options], 1)
    assert "1 missing images, first gone.png" in said.err
