"""armlab calibrate: files of samples in, model files with their sources out, or a sentence and nothing."""

from __future__ import annotations

import hashlib
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from armlab import log as logs
from armlab import models, robots, sim
from armlab.cli import main
from armlab.cli.calibrate import calibrate, force_sensor, hand_eye, kinematics, laser
from armlab.estimation import Fit
from armlab.kinematics import forward
from armlab.lie import se3, so3
from armlab.log import Column, Table


def distance(T_a: np.ndarray, T_b: np.ndarray) -> float:
    return float(np.linalg.norm((T_a - T_b)[:3, 3]))


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A folder with the samples of one cell."""
    folder, made = tmp_path_factory.mktemp("samples"), sim.cell(1)
    seen, weighed, scans, arm = made.hand_eye(wrong=2), made.force(torque=0.005), made.laser(), made.kinematics()
    savemat(folder / "eye.mat", {"T_base_tool": np.moveaxis(seen.A, 0, -1), "T_cam_marker": seen.B})
    T = se3.from_rp(weighed.RA, np.zeros((100, 3)))
    savemat(folder / "force.mat", {"T_base_tool": T, "wrench_raw": weighed.y, "force": weighed.y[:, :3]})
    savemat(folder / "wrench.mat", {"T_base_tool": T, "wrench_raw": weighed.y})
    savemat(folder / "laser.mat", {"T_base_tool": scans.A, "scans": scans.scans, "plane": scans.plane})
    savemat(folder / "arm.mat", {"q": arm.q, "pose": arm.pose})
    savemat(folder / "points.mat", {"q": arm.q, "position": arm.pose[:, :3, 3]})
    robots.save(arm.robot, folder / "nominal.toml")
    return folder


def test_hand_eye_ends_in_a_file_a_page_and_a_figure(files: Path, tmp_path: Path, capsys) -> None:
    assert hand_eye.__doc__
    out = [tmp_path / name for name in ("camera.toml", "camera.html", "camera.svg")]
    options = [word for pair in zip(("-o", "--report", "--figure"), map(str, out)) for word in pair]
    words = ["calibrate", "hand-eye", str(files / "eye.mat"), "--robust", *options]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "2 outliers left out: 0, 1" in said
    assert "good: 30 samples" in said
    truth = sim.cell(1).hand_eye()
    found = models.load(out[0], "hand_eye")
    assert distance(found.T_base_cam, truth.Y) < 1e-3
    assert Fit.load(out[0]).outliers.nonzero()[0].tolist() == [0, 1]
    sha = hashlib.sha256((files / "eye.mat").read_bytes()).hexdigest()
    meta = tomllib.loads(out[0].read_text(encoding="utf-8"))["meta"]
    assert meta["sources"] == [f"eye.mat sha256 {sha}"]
    page = out[1].read_text(encoding="utf-8")
    assert sha in page
    assert "data:image/png" in page
    assert out[2].exists()
    assert main(words) == 1
    assert "--force" in capsys.readouterr().err
    assert main([*words, "--force"]) == 0


def test_rows_between_the_samples_of_a_camera_do_not_count(tmp_path: Path, capsys) -> None:
    robot, seen = robots.load("irb2400"), sim.cell(2).hand_eye()
    q = np.random.default_rng(3).uniform(-1.0, 1.0, (30, 6))
    B = np.full((60, 4, 4), np.nan)
    B[::2] = se3.inv(seen.Y) @ forward(robot, q) @ seen.X
    table = Table(0.004 * np.arange(60), {"q": np.repeat(q, 2, axis=0), "T_cam_marker": B},
                  {"T_cam_marker": Column(unit="1", kind="pose")})  # fmt: skip
    path = logs.write(table, tmp_path / "run.mcap", robot)
    words = ["calibrate", "hand-eye", str(path), "--robot", "irb2400", "--noise", "1e-4", "1e-4", "--json"]
    assert main(words) == 0
    said = capsys.readouterr()
    assert "30 of 60 rows of run.mcap have no measurement" in said.err
    found = json.loads(said.out)
    assert found["samples"] == 30
    assert found["parameters"][6]["value"] == pytest.approx(seen.Y[0, 3], abs=1e-6)


def test_force_sensor(files: Path, tmp_path: Path, capsys) -> None:
    assert force_sensor.__doc__
    truth, out = sim.cell(1).force(torque=0.005), tmp_path / "sensor.toml"
    path, g = str(files / "wrench.mat"), ["--gravity", "0", "0", "-9.82"]
    assert main(["calibrate", "force-sensor", path, *g, "--noise", "0.1", "0.005", "-o", str(out)]) == 0
    assert "centre z" in capsys.readouterr().out
    sensor = models.load(out, "force_sensor")
    assert so3.angle(sensor.R_tool_sensor, truth.R) < np.radians(0.3)
    assert sensor.mass == pytest.approx(1.0, abs=5e-3)
    assert main(["calibrate", "force-sensor", str(files / "force.mat"), *g, "--noise", "0.1"]) == 0
    assert "centre" not in capsys.readouterr().out.split("noise of")[0]
    assert main(["calibrate", "force-sensor", path, *g, "--unknown-gravity"]) == 1
    assert "--unknown-gravity, got both" in capsys.readouterr().err
    assert main(["calibrate", "force-sensor", path, "--unknown-gravity"]) == 0
    assert main(["calibrate", "force-sensor", path, *g, "--sign", "-1"]) == 1
    assert "Traceback" not in capsys.readouterr().err


def test_kinematics(files: Path, tmp_path: Path, capsys) -> None:
    assert kinematics.__doc__
    out, arm = tmp_path / "found.toml", tmp_path / "arm.toml"
    nominal = str(files / "nominal.toml")
    words = ["calibrate", "kinematics", nominal, str(files / "arm.mat"), "-o", str(out), "--corrected", str(arm)]
    assert main(words) == 0
    truth = sim.cell(1).kinematics()
    corrected = robots.load(str(arm))
    away = np.linalg.norm((forward(corrected, truth.q_valid) - truth.pose_valid)[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(away**2)) < 0.15e-3
    assert models.load(out, "kinematic_correction").robot.hash == corrected.hash
    assert "arm.mat sha256" in out.read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(["calibrate", "kinematics", nominal, str(files / "points.mat"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["excitation"]["rank"] == 27
    assert main(["calibrate", "kinematics", nominal, str(files / "eye.mat")]) == 1
    assert "either pose or position" in capsys.readouterr().err
    assert main(words) == 1


def test_laser(files: Path, tmp_path: Path, capsys) -> None:
    assert laser.__doc__
    out, page = tmp_path / "laser.toml", tmp_path / "laser.html"
    words = ["calibrate", "laser", str(files / "laser.mat"), "-o", str(out), "--report", str(page)]
    assert main(words) == 0
    assert distance(models.load(out, "laser_sensor").T_tool_sensor, sim.cell(1).laser().X) < 2e-3
    assert "plane 2 offset" in page.read_text(encoding="utf-8")
    assert capsys.readouterr().out


def test_what_cannot_be_calibrated_is_a_sentence_and_writes_nothing(files: Path, tmp_path: Path, capsys) -> None:
    assert calibrate.name == ("calibrate",)
    T = np.tile(np.eye(4), (20, 1, 1))
    savemat(tmp_path / "still.mat", {"T_base_tool": T, "T_cam_marker": T})
    savemat(tmp_path / "short.mat", {"T_base_tool": T, "T_cam_marker": T[:9]})
    out = str(tmp_path / "never.toml")
    for words in (
        ["hand-eye", str(tmp_path / "still.mat")],
        ["hand-eye", str(tmp_path / "short.mat")],
        ["hand-eye", str(tmp_path / "none.csv")],
        ["hand-eye", str(files / "force.mat")],
        ["laser", str(files / "eye.mat")],
    ):
        assert main(["calibrate", *words, "-o", out]) == 1
        said = capsys.readouterr()
        assert said.err.startswith("armlab: Expected"), said.err
        assert "internal" not in said.err
        assert said.out == ""
        assert not Path(out).exists()
    assert main(["calibrate", "hand-eye"]) == 2
    assert main(["calibrate", "hand-eye", str(files / "eye.mat"), "--setup", "upside_down"]) == 2
