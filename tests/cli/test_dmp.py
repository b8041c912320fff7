"""armlab dmp: a primitive from a log, played on the simulated arm."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from armlab import log, robots
from armlab.cli import main
from armlab.cli.dmp import dmp, fit, play
from armlab.log import Table
from armlab.motion import Dmp, profiles


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of rest, a motion of a second, and rest."""
    q0 = robots.load("yumi_left").q_home
    motion = profiles.minimum_jerk(q0, q0 + np.deg2rad([10, -5, 8, -10, 5, 5, 20]), 1.0)
    t = np.arange(0, 2.5, 0.004)
    q, qd, _ = motion.at(t - 0.5)
    path = tmp_path_factory.mktemp("taught") / "taught.csv"
    return log.write(Table(t, {"q": q, "qd": qd}), path)


@pytest.fixture(scope="module")
def primitive(taught: Path) -> Path:
    path = taught.with_name("motion.toml")
    assert main(["dmp", "fit", str(taught), "-o", str(path)]) == 0
    return path


def test_a_motion_is_fitted_without_the_rest_around_it(taught: Path, primitive: Path, tmp_path: Path, capsys) -> None:
    value = Dmp.load(primitive)
    assert value.n == 7
    assert 0.9 < value.duration < 1.25
    assert main(["dmp", "fit", str(taught), str(taught), "-o", str(tmp_path / "two.toml"), "--whole", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["duration"] == pytest.approx(2.496)
    assert max(said["rms"]) < 1e-3
    assert "sha256" in primitive.read_text()


def test_what_was_fitted_is_told(taught: Path, tmp_path: Path, capsys) -> None:
    words = [
        "dmp",
        "fit",
        str(taught),
        "-o",
        str(tmp_path / "m.toml"),
        "--start",
        "0.4",
        "--end",
        "1.6",
        "--basis",
        "20",
    ]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "1 demonstration with" in said
    assert "20 kernels" in said
    assert "RMS" in said


@pytest.mark.slow  # 3 s
def test_it_is_played_on_the_simulated_arm(primitive: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["dmp", "play", "yumi_left", str(primitive), "--link", "sim://yumi_left?lockstep=true", "--json"]
    assert main([*words, "--log", "first.mcap"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["goal_error"] < 0.01
    table = log.read(said["log"])
    np.testing.assert_allclose(table["q"][0], Dmp.load(primitive).y0, atol=0.01)


def test_what_cannot_be_is_refused_before_anything_moves(taught: Path, primitive: Path, tmp_path: Path, capsys) -> None:
    for words, sentence in {
        ("fit", "-o", str(tmp_path / "x.toml")): "log of a motion",
        ("fit", str(taught), "-o", str(tmp_path / "x.csv")): ".toml",
        ("fit", str(taught), "-o", str(primitive)): "--force",
        ("fit", str(taught), "-o", str(tmp_path / "x.toml"), "--column", "speed"): "speed",
        ("fit", str(taught), "-o", str(tmp_path / "x.toml"), "--end", "0.2"): "rest",
        ("play", "ur5e", str(primitive)): "6 joints",
        ("play", "yumi_left", str(primitive), *(["--goal", "9"] * 7)): "within the limits",
    }.items():
        assert main(["dmp", *words]) == 1
        assert sentence in capsys.readouterr().err
    assert dmp.name == ("dmp",)
    assert fit.__doc__
    assert play.__doc__
