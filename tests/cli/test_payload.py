"""armlab payload: a load with its deviations, a file, a page, or a sentence and nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import identify, models
from armlab.cli import main
from armlab.log import Table
from armlab.robots import inertia


@pytest.fixture(scope="module")
def tables(truth) -> dict[str, Table]:
    """A log with 0.5 kg, one without, one with 5 g."""
    motion = identify.design_excitation(truth.robot, seconds=12, speed=0.4, acceleration=8.0, seed=3)

    def log(mass: float, seed: int) -> Table:
        links = truth.links.copy()
        pi = inertia.from_body(mass, [0.03, 0.0, 0.052], np.zeros((3, 3)))
        links[-1] += inertia.transform(truth.robot.links[-1], pi)
        return replace(truth, links=links).log(motion, seed=seed)

    return {"full.mcap": log(0.5, 1), "empty.mcap": log(0.0, 2), "crumb.mcap": log(0.005, 3)}


@pytest.fixture
def words(monkeypatch, tables: dict[str, Table], model, tmp_path: Path) -> list[str]:
    """The logs by name, and the model file."""
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: tables[path.name])
    saved = models.save(model, tmp_path / "model.toml")
    return ["payload", "yumi_left", "full.mcap", "--model", str(saved)]


@pytest.mark.slow  # 5 s beside other work
def test_a_load_is_weighed_saved_and_reported(words: list[str], tmp_path: Path, capsys) -> None:
    files = [tmp_path / name for name in ("load.toml", "load.html", "load.png")]
    options = [word for pair in zip(("-o", "--report", "--figure"), map(str, files)) for word in pair]
    assert main([*words, "--without", "empty.mcap", *options]) == 0
    said = capsys.readouterr().out
    assert "centre z" in said
    assert "good: The load of" in said
    load = models.load(files[0], kind="payload")
    assert load.mass == pytest.approx(0.5, rel=0.03)
    np.testing.assert_allclose(load.centre, [0.03, 0.0, 0.052], atol=5e-3)
    page = files[1].read_text(encoding="utf-8")
    assert "m c_z" in page
    assert "data:image/png" in page
    assert files[2].exists()
    assert main([*words, *options]) == 2
    assert "--force" in capsys.readouterr().err


def test_json_and_mode(words: list[str], capsys) -> None:
    assert main([*words, "--json", "--mode", "dynamic", "--gain", "0.01"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["mass"] == pytest.approx(0.5, rel=0.03)
    assert [entry["name"] for entry in found["parameters"]][4:] == ["I_xx", "I_xy", "I_yy", "I_xz", "I_yz", "I_zz"]
    assert found["parameters"][0]["sd"] < 0.01


def test_a_crumb_is_not_claimed(words: list[str], capsys) -> None:
    assert main([*words[:2], "crumb.mcap", *words[3:], "--gain", "0"]) == 0
    assert "not good" in capsys.readouterr().out


def test_without_a_load_none_is_to_be_added(words: list[str], capsys) -> None:
    assert main([*words[:2], "empty.mcap", *words[3:]]) == 0
    said = capsys.readouterr().out
    assert "cannot be told from no load" in said
    assert "as it is" in said
    assert "added_to" not in said


def test_the_model_of_another_arm_is_refused(words: list[str], capsys) -> None:
    assert main([words[0], "yumi_right", *words[2:]]) == 2
    assert "yumi_left" in capsys.readouterr().err


def test_a_log_in_degrees_is_refused(words: list[str], tables: dict[str, Table], monkeypatch, capsys) -> None:
    log = tables["full.mcap"]
    degrees = log.with_column("q", np.rad2deg(log["q"])).with_column("qd", np.rad2deg(log["qd"]))
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: degrees)
    assert main(words) == 1
    said = capsys.readouterr()
    assert "degrees" in said.err
    assert said.out == ""


def test_torque_that_is_not_explained_is_not_called_good(words: list[str], tables, monkeypatch, capsys) -> None:
    log = tables["full.mcap"]
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: log.with_column("tau", -log["tau"]))
    assert main([*words, "--json"]) == 0
    verdict = json.loads(capsys.readouterr().out)["verdict"]
    assert not any("explain" in said for said in verdict["good"])
    assert any("% of the torque's deviation unexplained" in said for said in verdict["bad"])


def test_of_an_arm_that_rests_in_part_the_joints_that_move_are_judged(
    words: list[str], truth, monkeypatch, capsys
) -> None:
    motion = identify.design_excitation(truth.robot, seconds=12, speed=0.4, acceleration=8.0, seed=3)

    rests = np.arange(7) < 3

    def wrist(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q, qd, qdd = motion.sample(t)
        return np.where(rests, truth.robot.q_home, q), np.where(rests, 0.0, qd), np.where(rests, 0.0, qdd)

    monkeypatch.setattr(
        "armlab.log.reading.read", lambda path, **_: truth.log(identify.Trajectory(motion.seconds, wrist), seed=1)
    )
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "left out, at rest: axis_1, axis_2, axis_7" in said
    assert "Arm and load together" in said
