"""armlab calibrate: sample files in, model files with their sources out, or an error message and no file."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from armlab import calibrate as calibration
from armlab import log as logs
from armlab import models, robots, sim
from armlab.cli import main
from armlab.cli.calibrate.samples import judge
from armlab.estimation import Fit
from armlab.kinematics import forward, inverse
from armlab.lie import se3, so3
from armlab.log import Column, Table
from armlab.sim.experiments.kinematics import DualRun, KinematicRun

from .conftest import samples_csv


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder, made = tmp_path_factory.mktemp("samples"), sim.cell(1)
    seen, weighed, scans = made.hand_eye(wrong=2), made.force(torque=0.005), made.laser()
    savemat(folder / "eye.mat", {"T_base_tool": np.moveaxis(seen.A, 0, -1), "T_cam_marker": seen.B})
    T = se3.from_rp(weighed.RA, np.zeros((100, 3)))
    savemat(folder / "force.mat", {"T_base_tool": T, "wrench_raw": weighed.y, "force": weighed.y[:, :3]})
    savemat(folder / "wrench.mat", {"T_base_tool": T, "wrench_raw": weighed.y})
    savemat(folder / "laser.mat", {"T_base_tool": scans.A, "scans": scans.scans, "plane": scans.plane})
    return folder


@pytest.mark.slow  # 5 s beside other work
def test_hand_eye_ends_in_a_file_a_page_and_a_figure(files: Path, tmp_path: Path, command) -> None:
    out = [tmp_path / name for name in ("camera.toml", "camera.html", "camera.svg")]
    options = [word for pair in zip(("-o", "--report", "--figure"), map(str, out)) for word in pair]
    words = ["calibrate", "hand-eye", str(files / "eye.mat"), "--robust", *options]
    said = command(words).out
    assert "2 outliers excluded: 0, 1" in said
    assert "good: 30 samples" in said
    truth = sim.cell(1).hand_eye()
    found = models.load(out[0], "hand_eye")
    assert np.linalg.norm((found.T_base_cam - truth.Y)[:3, 3]) < 1e-3
    assert Fit.load(out[0]).outliers.nonzero()[0].tolist() == [0, 1]
    sha = hashlib.sha256((files / "eye.mat").read_bytes()).hexdigest()
    meta = tomllib.loads(out[0].read_text(encoding="utf-8"))["meta"]
    assert meta["sources"] == [f"eye.mat sha256 {sha}"]
    page = out[1].read_text(encoding="utf-8")
    assert sha in page
    assert "data:image/png" in page
    assert out[2].exists()


def test_rows_between_the_samples_of_a_camera_do_not_count(tmp_path: Path, command) -> None:
    robot, seen = robots.load("irb2400"), sim.cell(2).hand_eye()
    q = np.random.default_rng(3).uniform(-1.0, 1.0, (30, 6))
    B = np.full((60, 4, 4), np.nan)
    B[::2] = se3.inv(seen.Y) @ forward(robot, q) @ seen.X
    table = Table(0.004 * np.arange(60), {"q": np.repeat(q, 2, axis=0), "T_cam_marker": B},
                  {"T_cam_marker": Column(unit="1", kind="pose")})  # fmt: skip
    path = logs.write(table, tmp_path / "run.mcap", robot)
    words = ["calibrate", "hand-eye", str(path), "--robot", "irb2400", "--noise", "1e-4", "1e-4", "--json"]
    said = command(words)
    assert "30 of 60 rows of run.mcap have no measurement" in said.err
    found = json.loads(said.out)
    assert found["samples"] == 30
    assert found["parameters"][6]["value"] == pytest.approx(seen.Y[0, 3], abs=1e-6)


def test_force_sensor(files: Path, tmp_path: Path, command) -> None:
    truth, out = sim.cell(1).force(torque=0.005), tmp_path / "sensor.toml"
    path, g = str(files / "wrench.mat"), ["--gravity", "0", "0", "-9.82"]
    assert "centre z" in command(["calibrate", "force-sensor", path, *g, "--noise", "0.1", "0.005", "-o", out]).out
    sensor = models.load(out, "force_sensor")
    assert so3.angle(sensor.R_tool_sensor, truth.R) < np.radians(0.3)
    assert sensor.mass == pytest.approx(1.0, abs=5e-3)
    said = command(["calibrate", "force-sensor", files / "force.mat", *g, "--noise", "0.1"]).out
    assert "centre" not in said.split("noise of")[0]
    assert "--unknown-gravity, got both" in command(["calibrate", "force-sensor", path, *g, "--unknown-gravity"], 2).err
    assert main(["calibrate", "force-sensor", path, "--unknown-gravity"]) == 0
    assert "Traceback" not in command(["calibrate", "force-sensor", path, *g, "--sign", "-1"], 1).err


def test_noise_of_the_robot_widens_the_deviations(files: Path, command) -> None:
    words = ["calibrate", "hand-eye", files / "eye.mat", "--robust", "--noise", "5e-4", "9e-4", "--json"]
    known, wide = (json.loads(command([*words, *more]).out) for more in ([], ["--noise-robot", "5e-3", "1e-2"]))
    for one, other in zip(known["parameters"], wide["parameters"], strict=True):
        assert other["sd"] > 2.0 * one["sd"]


def test_laser(files: Path, tmp_path: Path, command) -> None:
    out = tmp_path / "laser.toml"
    assert "plane 2 offset" in command(["calibrate", "laser", files / "laser.mat", "-o", out]).out
    away = models.load(out, "laser_sensor").T_tool_sensor - sim.cell(1).laser().X
    assert np.linalg.norm(away[:3, 3]) < 2e-3


@pytest.mark.parametrize("known", [True, False])
def test_hand_eye_from_points(known: bool, tmp_path: Path, command) -> None:
    seen = sim.cell(3).marker_points(N=40)
    p = np.where(seen.visible[:, :, None], seen.p, np.nan)
    path, body = samples_csv(tmp_path / "s.csv", {"T_base_tool": seen.A, "p_cam": p}), tmp_path / "marker.csv"
    body.write_text("marker_x [mm],marker_y [mm],marker_z [mm]\n0,0,0\n100,0,0\n0,100,0\n", encoding="utf-8")
    words = ["--noise", "5e-4", "--json", *(["--marker", body] if known else [])]
    found = json.loads(command(["calibrate", "hand-eye", path, *words]).out)
    values = {one["name"]: one["value"] for one in found["parameters"]}
    assert ("T_tool_marker x" in values) == known
    np.testing.assert_allclose([values[f"T_base_cam {axis}"] for axis in "xyz"], seen.Y[:3, 3], atol=1e-3)
    assert len(found["sources"]) == 1 + known
    assert "noise of points" in command(["calibrate", "hand-eye", path, "--noise", "5e-4", "1e-3"], 1).err


def test_accelerometer(tmp_path: Path, command) -> None:
    data, out = sim.cell(1).accelerometer(), tmp_path / "found.toml"
    T = se3.from_rp(data.RA, np.zeros((50, 3)))
    words = ["calibrate", "accelerometer", samples_csv(tmp_path / "s.csv", {"T_base_tool": T, "acc": data.y})]
    command([*words, "--noise", "0.02", "-o", out])
    assert so3.angle(models.load(out, "accelerometer").R_tool_sensor, data.R) < np.radians(0.2)
    scale = json.loads(command([*words, "--scale", "--json"]).out)["parameters"][3]
    assert scale["name"] == "scale"
    assert scale["value"] == pytest.approx(1.0, abs=0.01)
    said = command([*words, "--gravity", "0", "0", "9.81"], 1).err
    assert "mirrored or the sign is reversed" in said


def test_what_cannot_be_calibrated_is_a_sentence_and_writes_nothing(files: Path, tmp_path: Path, command) -> None:
    T = np.tile(np.eye(4), (20, 1, 1))
    savemat(tmp_path / "still.mat", {"T_base_tool": T, "T_cam_marker": T})
    savemat(tmp_path / "short.mat", {"T_base_tool": T, "T_cam_marker": T[:9]})
    half = np.where(np.arange(20) < 9, 1.5, 1.0)
    savemat(tmp_path / "half.mat", {"T_base_tool": T, "scans": np.zeros((20, 4)), "plane": half})
    out = str(tmp_path / "never.toml")
    for words in (
        ["hand-eye", str(tmp_path / "still.mat")],
        ["hand-eye", str(tmp_path / "short.mat")],
        ["hand-eye", str(files / "force.mat")],
        ["laser", str(files / "eye.mat")],
        ["laser", str(tmp_path / "half.mat")],
    ):
        said = command(["calibrate", *words, "-o", out], 1)
        assert said.err.splitlines()[-1].startswith("armlab: Expected"), said.err
        assert "internal" not in said.err
        assert said.out == ""
        assert not Path(out).exists()


@pytest.fixture(scope="module")
def fit():
    return calibration.fit_hand_eye(**sim.cell(1).hand_eye(wrong=2).given, robust=True)


def test_the_verdict_names_what_is_wrong(fit) -> None:
    verdict = judge(fit)
    assert not verdict.bad
    assert "Inspect the 2 excluded samples." in verdict.ahead
    many = replace(fit, outliers=np.arange(30) < 12)
    assert "12 of 30 samples were excluded" in judge(many).bad[0]
    few = replace(fit, residuals=fit.residuals[:2])
    assert "few measurements" in judge(few).bad[0]
    held = replace(fit, excitation=replace(fit.excitation, held=("link 3",)))
    assert "A prior fixes directions that the samples do not identify: link 3." in judge(held).bad
    assert not judge(held).good
    rough = replace(fit, sigma=np.array([0.03, 0.001]))
    assert judge(rough).bad == [
        "The noise of position [m] is 0.03, which is too large for a sensor. Some samples are probably wrong."
    ]
    asked = replace(fit, doubts=("positions spread over 465 m: were millimetres given as metres?",))
    assert judge(asked).bad == ["Positions spread over 465 m: were millimetres given as metres?"]


NOISE = ["1e-4", "1.75e-4"]


@pytest.fixture(scope="module")
def nominal(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("robot") / "nominal.toml"
    robots.save(sim.cell(1).kinematics().robot, path)
    return str(path)


@pytest.fixture
def run(command) -> Callable[[list[Any]], dict[str, Any]]:
    return lambda words: json.loads(command(["calibrate", *words, "--json"]).out)


def off(robot: Any, arm: KinematicRun) -> float:
    """Return the tool error [mm] at poses that were not fitted."""
    away = (forward(robot, arm.q_valid) - arm.pose_valid)[:, :3, 3]
    return 1e3 * float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


def test_an_arm_from_poses_makes_a_robot(nominal: str, tmp_path: Path) -> None:
    arm = sim.cell(1).kinematics()
    savemat(tmp_path / "arm.mat", {"q": arm.q, "pose": arm.pose})
    out, made = tmp_path / "found.toml", tmp_path / "arm.toml"
    words = ["calibrate", "kinematics", nominal, str(tmp_path / "arm.mat"), "-o", str(out), "--corrected", str(made)]
    assert main(words) == 0
    corrected = robots.load(str(made))
    assert off(corrected, arm) < 0.15
    assert models.load(out, "kinematic_correction").robot.hash == corrected.hash
    assert "arm.mat sha256" in out.read_text(encoding="utf-8")
    assert main(words) == 2


def test_distances_from_a_point_that_is_roughly_known(nominal: str, tmp_path: Path, command, run) -> None:
    arm = sim.cell(2).distances()
    anchor, distance = arm.anchor, arm.distance
    path = samples_csv(tmp_path / "wire.csv", {"q": arm.q, "distance": distance + 0.25})
    words = ["kinematics", nominal, path, "--noise", "5e-5"]
    there = ["--anchor", *(f"{x:.2f}" for x in anchor)]
    found = run([*words, *there, "--length-offset"])
    values = {one["name"]: one["value"] for one in found["parameters"]}
    assert values["length offset"] == pytest.approx(0.25, abs=2e-3)
    assert found["excitation"]["rank"] == 25
    assert "initial guess of the fixed point" in command(["calibrate", *words], 2).err
    said = command(["calibrate", *words[:3], "--noise", "5e-5", "1e-4", *there], 2).err
    assert "Expected 1 numbers for --noise (distance: m), got 2" in said


def test_distances_between_samples_of_several_files(nominal: str, tmp_path: Path, command, run) -> None:
    """Pairs are numbered in each file; a row without joint positions shifts the rows after it."""
    arm = sim.cell(2).distances()
    p, rng = arm.pose[:, :3, 3], np.random.default_rng(1)
    files = []
    for k in range(2):
        part = slice(60 * k, 60 * k + 60)
        q, points = np.insert(arm.q[part], 5, np.nan, axis=0), np.insert(p[part], 5, 0, 0)
        other = np.roll(np.arange(61.0), 7)
        length = np.linalg.norm(points - points[other.astype(int)], axis=1) + 5e-5 * rng.standard_normal(61)
        wrong = np.isnan(q[:, 0]) | np.isnan(q[other.astype(int), 0])
        length[wrong] = other[wrong] = np.nan
        files.append(samples_csv(tmp_path / f"bar{k}.csv", {"q": q, "pair_distance": length, "pair_with": other}))
    found = run(["kinematics", nominal, *files, "--noise", "5e-5"])
    assert found["excitation"]["rank"] == 21
    assert found["noise"]["pair distance [m]"] == pytest.approx(5e-5, rel=0.2)
    assert [source.split()[0] for source in found["sources"]] == ["bar0.csv", "bar1.csv"]
    pairs = {"pair_distance": np.ones(120), "pair_with": np.full(120, 120.0)}
    bad = samples_csv(tmp_path / "bad.csv", {"q": arm.q, **pairs})
    assert "number of another sample" in command(["calibrate", "kinematics", nominal, bad], 1).err


def test_kinds_may_be_mixed_over_files(nominal: str, tmp_path: Path, command, run) -> None:
    arm = sim.cell(2).distances()
    anchor, distance = arm.anchor, arm.distance
    point = arm.pose[:40, :3, 3] + 1e-4 * np.random.default_rng(2).standard_normal((40, 3))
    one = samples_csv(tmp_path / "points.csv", {"q": arm.q[:40], "position": point})
    two = samples_csv(tmp_path / "wire.csv", {"q": arm.q[40:], "distance": distance[40:]})
    words = ["kinematics", nominal, one, two, "--anchor", *(f"{x:.2f}" for x in anchor)]
    found = run([*words, "--noise", "1e-4", "5e-5"])
    assert found["samples"] == 120
    assert found["excitation"]["rank"] == 30
    assert "(position: m, distance: m)" in command(["calibrate", *words, "--noise", "1e-4"], 2).err
    assert "points.csv twice" in command(["calibrate", "kinematics", nominal, one, one], 2).err
    nothing = samples_csv(tmp_path / "nothing.csv", {"q": arm.q})
    assert "of the columns pose, position, distance" in command(["calibrate", "kinematics", nominal, nothing], 1).err


@pytest.mark.parametrize("kind", ["pose", "position"])
def test_two_arms(kind: str, tmp_path: Path) -> None:
    pair = sim.cell(1).two_arms()
    arms = [tmp_path / f"nominal_{letter}.toml" for letter in "ab"]
    for robot, path in zip((pair.robot_a, pair.robot_b), arms, strict=True):
        robots.save(robot, path)
    columns = {"q_a": pair.q_a, "q_b": pair.q_b, kind: pair.pose if kind == "pose" else pair.pose[:, :3, 3]}
    savemat(tmp_path / "pair.mat", columns)
    out, made = tmp_path / "pair.toml", [tmp_path / f"arm_{letter}.toml" for letter in "ab"]
    words = ["calibrate", "dual-arm", *map(str, arms), str(tmp_path / "pair.mat"), "-o", str(out)]
    noise = NOISE if kind == "pose" else NOISE[:1]
    assert main([*words, "--noise", *noise, "--corrected", *map(str, made)]) == 0
    found = models.load(out, "dual_arm_correction")
    Z = found.forward(pair.q_valid_a, pair.q_valid_b)
    away = (Z - pair.relative(pair.q_valid_a, pair.q_valid_b))[:, :3, 3]
    assert np.sqrt(np.mean(np.sum(away**2, axis=1))) < 0.3e-3
    assert [robots.load(str(path)).hash for path in made] == [found.arm_a.robot.hash, found.arm_b.robot.hash]


def joined(pair: DualRun) -> tuple[np.ndarray, np.ndarray]:
    q_a = np.random.default_rng(0).uniform(-0.6, 0.6, (60, 6))
    held = se3.from_rp(so3.exp([3.0, 0.2, 0.1]), [0.05, 0.02, 0.3])
    found = inverse(pair.robot_b, se3.inv(pair.T_basea_baseb) @ forward(pair.robot_a, q_a) @ held)
    return q_a[found.success][:25], found.q[found.success][:25]


def test_two_arms_that_hold_each_other(tmp_path: Path, command, run) -> None:
    pair = sim.cell(1).two_arms(N=40)
    path = samples_csv(tmp_path / "pair.csv", {"q_a": pair.q_a, "q_b": pair.q_b})
    for robot in (pair.robot_a, pair.robot_b):
        robots.save(robot, tmp_path / f"{robot.name}.toml")
    arms = [str(tmp_path / f"arm_{letter}.toml") for letter in "ab"]
    assert "one of the columns pose, position, absolute_a" in command(["calibrate", "dual-arm", *arms, path], 1).err
    q = joined(pair)
    held = samples_csv(tmp_path / "held.csv", {"q_a": q[0], "q_b": q[1]})
    words = ["dual-arm", *arms, held, "--closed", "--noise", "1e-4", "2e-4"]
    assert "overall scale" in command(["calibrate", *words], 1).err
    found = run([*words, "--weak", "prior"])
    assert any("overall scale" in name for name in found["excitation"]["held"])
