"""armlab calibrate kinematics and dual-arm: what was measured of one arm or two, corrected robots out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from armlab import models, robots, sim
from armlab.cli import main
from armlab.kinematics import forward, inverse
from armlab.lie import se3, so3
from armlab.sim.experiments.kinematics import DualRun, KinematicRun

NOISE = ["1e-4", "1.75e-4"]


@pytest.fixture(scope="module")
def nominal(tmp_path_factory) -> str:
    """The description of the arm of the cell, in a file."""
    path = tmp_path_factory.mktemp("robot") / "nominal.toml"
    robots.save(sim.cell(1).kinematics().robot, path)
    return str(path)


def written(path: Path, columns: dict[str, np.ndarray]) -> str:
    """Vectors and numbers as CSV; NaN is an empty cell."""
    flat = {}
    for name, value in columns.items():
        flat |= {f"{name}{k + 1}": value[:, k] for k in range(value.shape[1])} if value.ndim == 2 else {name: value}
    rows = [",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in zip(*flat.values(), strict=True)]
    path.write_text("\n".join([",".join(flat), *rows]), encoding="utf-8")
    return str(path)


def run(words: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert main(["calibrate", *words, "--json"]) == 0, capsys.readouterr().err
    return json.loads(capsys.readouterr().out)


def off(robot: Any, arm: KinematicRun) -> float:
    """Error of the tool [mm] where it was not fitted."""
    away = (forward(robot, arm.q_valid) - arm.pose_valid)[:, :3, 3]
    return 1e3 * float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


def test_an_arm_from_poses_makes_a_robot(nominal: str, tmp_path: Path, capsys) -> None:
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
    capsys.readouterr()


def test_distances_from_a_point_that_is_roughly_known(nominal: str, tmp_path: Path, capsys) -> None:
    arm = sim.cell(2).distances()
    anchor, distance = arm.anchor, arm.distance
    path = written(tmp_path / "wire.csv", {"q": arm.q, "distance": distance + 0.25})
    words = ["kinematics", nominal, path, "--noise", "5e-5"]
    there = ["--anchor", *(f"{x:.2f}" for x in anchor)]
    found = run([*words, *there, "--length-offset"], capsys)
    values = {one["name"]: one["value"] for one in found["parameters"]}
    assert values["length offset"] == pytest.approx(0.25, abs=2e-3)
    assert found["excitation"]["rank"] == 25
    assert main(["calibrate", *words]) == 2
    assert "first guess of the fixed point" in capsys.readouterr().err
    assert main(["calibrate", *words[:3], "--noise", "5e-5", "1e-4", *there]) == 2
    assert "Expected 1 numbers for --noise (distance: m), got 2" in capsys.readouterr().err


def test_distances_between_samples_of_several_files(nominal: str, tmp_path: Path, capsys) -> None:
    """Pairs are numbered in each file; a row without joint positions moves what comes after it."""
    arm = sim.cell(2).distances()
    p, rng = arm.pose[:, :3, 3], np.random.default_rng(1)
    files = []
    for k in range(2):
        q, points = (
            np.insert(arm.q[60 * k : 60 * k + 60], 5, np.nan, axis=0),
            np.insert(p[60 * k : 60 * k + 60], 5, 0, 0),
        )
        other = np.roll(np.arange(61.0), 7)
        length = np.linalg.norm(points - points[other.astype(int)], axis=1) + 5e-5 * rng.standard_normal(61)
        wrong = np.isnan(q[:, 0]) | np.isnan(q[other.astype(int), 0])
        length[wrong] = other[wrong] = np.nan
        files.append(written(tmp_path / f"bar{k}.csv", {"q": q, "pair_distance": length, "pair_with": other}))
    found = run(["kinematics", nominal, *files, "--noise", "5e-5"], capsys)
    assert found["excitation"]["rank"] == 21
    assert found["noise"]["pair distance [m]"] == pytest.approx(5e-5, rel=0.2)
    assert [source.split()[0] for source in found["sources"]] == ["bar0.csv", "bar1.csv"]
    bad = written(tmp_path / "bad.csv", {"q": arm.q, "pair_distance": np.ones(120), "pair_with": np.full(120, 120.0)})
    assert main(["calibrate", "kinematics", nominal, bad]) == 1
    assert "number of another sample" in capsys.readouterr().err


def test_kinds_may_be_mixed_over_files(nominal: str, tmp_path: Path, capsys) -> None:
    arm = sim.cell(2).distances()
    anchor, distance = arm.anchor, arm.distance
    point = arm.pose[:40, :3, 3] + 1e-4 * np.random.default_rng(2).standard_normal((40, 3))
    one = written(tmp_path / "points.csv", {"q": arm.q[:40], "position": point})
    two = written(tmp_path / "wire.csv", {"q": arm.q[40:], "distance": distance[40:]})
    words = ["kinematics", nominal, one, two, "--anchor", *(f"{x:.2f}" for x in anchor)]
    found = run([*words, "--noise", "1e-4", "5e-5"], capsys)
    assert found["samples"] == 120
    assert found["excitation"]["rank"] == 30
    assert main(["calibrate", *words, "--noise", "1e-4"]) == 2
    assert "(position: m, distance: m)" in capsys.readouterr().err
    assert main(["calibrate", "kinematics", nominal, one, one]) == 2
    assert "points.csv again" in capsys.readouterr().err
    nothing = written(tmp_path / "nothing.csv", {"q": arm.q})
    assert main(["calibrate", "kinematics", nominal, nothing]) == 1
    assert "one of pose, position, distance" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["pose", "position"])
def test_two_arms(kind: str, tmp_path: Path, capsys) -> None:
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
    capsys.readouterr()


def joined(pair: DualRun) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions of two arms whose tools are held together."""
    q_a = np.random.default_rng(0).uniform(-0.6, 0.6, (60, 6))
    held = se3.from_rp(so3.exp([3.0, 0.2, 0.1]), [0.05, 0.02, 0.3])
    found = inverse(pair.robot_b, se3.inv(pair.T_basea_baseb) @ forward(pair.robot_a, q_a) @ held)
    return q_a[found.success][:25], found.q[found.success][:25]


def test_two_arms_that_hold_each_other(tmp_path: Path, capsys) -> None:
    pair = sim.cell(1).two_arms(N=40)
    path = written(tmp_path / "pair.csv", {"q_a": pair.q_a, "q_b": pair.q_b})
    for robot in (pair.robot_a, pair.robot_b):
        robots.save(robot, tmp_path / f"{robot.name}.toml")
    arms = [str(tmp_path / f"arm_{letter}.toml") for letter in "ab"]
    assert main(["calibrate", "dual-arm", *arms, path]) == 1
    assert "one of pose, position, absolute_a" in capsys.readouterr().err
    q = joined(pair)
    held = written(tmp_path / "held.csv", {"q_a": q[0], "q_b": q[1]})
    assert main(["calibrate", "dual-arm", *arms, held, "--closed", "--noise", "1e-4", "2e-4"]) == 1
    assert "overall scale" in capsys.readouterr().err
    found = run(["dual-arm", *arms, held, "--closed", "--noise", "1e-4", "2e-4", "--weak", "prior"], capsys)
    assert any("overall scale" in name for name in found["excitation"]["held"])
