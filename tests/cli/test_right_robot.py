"""The right robot: each verb refuses a recording, motion or model of another robot description, and says why."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import log, models, robots
from armlab.cli.support.log_input import model_for
from armlab.errors import ModelMismatchError
from armlab.lie import se3, so3
from armlab.live import read_arms
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.motion import fit_dmp
from armlab.robots import Robot

LEFT = robots.load("yumi_left")


def _longer(robot: Robot) -> Robot:
    links = robot.links.copy()
    links[3, :3, 3] *= 1.1
    return replace(robot, links=links)


TILTED = LEFT.T_base_mount @ se3.from_rp(so3.exp([0.0, 0.2, 0.0]), np.zeros(3))
OTHERS: dict[str, tuple[Robot, str]] = {
    "tool": (LEFT.with_tool(se3.from_rp(np.eye(3), [0.0, 0.0, 0.12])), "tool moved by 0.12 m"),
    "mount": (LEFT.with_base(TILTED), "mount rotated by 11.46 deg"),
    "limits": (replace(LEFT, qd_max=LEFT.qd_max * 0.5), "speed limit of joint 1"),
    "links": (_longer(LEFT), "link from joint 3 to joint 4"),
    "arm": (robots.load("yumi_right"), "mount moved by"),
}
VERBS = {
    "estimate": "estimate {robot} {log} --model {model}",
    "identify": "identify {robot} {log} -o new.toml",
    "identify --test": "identify {robot} {plain} --test {log} -o new.toml",
    "payload": "payload {robot} {log} --model {model}",
    "payload --without": "payload {robot} {plain} --without {log} --model {model}",
    "view": "view {log} --robot {robot}",
    "excite": "excite {robot} --saved {log} -o new.csv",
    "excite, motion": "excite {robot} --saved {motion} -o new.csv",
    "estimate, model": "estimate {robot} {plain} --model {other}",
    "payload, model": "payload {robot} {plain} --model {other}",
    "view, model": "view {plain} --robot {robot} --model {other}",
    "plot robot": "plot robot {robot} {log} -o new.png",
    "plot poses": "plot poses {log} --robot {robot} -o new.png",
    "plot torque_fit": "plot torque_fit {model} {log} -o new.png",
    "plot torque_fit, robot": "plot torque_fit {model} {log} --robot {robot} -o new.png",
    "dmp fit": "dmp fit {log} --robot {robot} -o new.toml",
    "dmp fit, pose": "dmp fit {log} --kind pose --robot {robot} -o new.toml",
    "dmp play, file": "dmp play {primitive} --robot {robot} -o new.csv",
    "dmp play": "dmp play {primitive} --robot {robot}",
}


@pytest.fixture(scope="module")
def files(excited: Table, model: TorqueModel, tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("right")
    table = excited.between(0.0, 1.0)
    motion = replace(table, source=(f"designed for {LEFT.name} {LEFT.hash}",))
    return {
        "log": log.write(table, folder / "run.mcap", LEFT),
        "plain": log.write(table, folder / "plain.csv"),
        "motion": log.write(motion, folder / "motion.csv"),
        "other": models.save(model, folder / "model.toml"),
        "primitive": fit_dmp(table.t, table["q"]).save(folder / "dmp.toml", [f"taught on {LEFT.name} {LEFT.hash}"]),
    }


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("verb", VERBS)
def test_another_robot_is_refused_in_words(verb: str, other: str, files, model, tmp_path, monkeypatch, command) -> None:
    monkeypatch.chdir(tmp_path)
    robot, words = OTHERS[other]
    robots.save(robot, "arm.toml")
    models.save(model.moved_to(robot), "own.toml")
    typed = VERBS[verb].format(robot="arm.toml", model="own.toml", **files)
    said = command(shlex.split(typed), code=2).err
    assert "Expected the robot of" in said
    assert "--force" in said or verb == "view, model"
    by_hash = verb == "excite, motion" or verb.startswith("dmp play")
    if not by_hash and not (other == "limits" and (verb.endswith("model") or "torque_fit" in verb)):
        assert words in said
    assert not list(Path().glob("new.*"))


@pytest.mark.filterwarnings("default")
def test_by_force_it_goes_on_with_the_named_robot(files, tmp_path, command) -> None:
    robots.save(OTHERS["tool"][0], tmp_path / "arm.toml")
    words = ["--model", files["other"], "--force", "-o"]
    said = command(["estimate", tmp_path / "arm.toml", files["log"], *words, tmp_path / "a.csv"]).err
    assert said.count("which differs: tool moved by 0.12 m") == 2  # for the recording and for the model
    command(["estimate", "yumi_left", files["log"], *words, tmp_path / "b.csv"])
    with pytest.raises(ModelMismatchError, match="tool moved"):
        model_for(files["other"], OTHERS["tool"][0])
    moved = model_for(files["other"], OTHERS["tool"][0], force=True)
    assert np.array_equal(moved.frames, OTHERS["tool"][0].frames)
    a, b = (log.read(tmp_path / name)["wrench_hat_cov"] for name in ("a.csv", "b.csv"))
    assert not np.allclose(a, b)


def test_a_written_estimate_can_be_viewed(files, tmp_path, command) -> None:
    command(["estimate", "yumi_left", files["log"], "--model", files["other"], "-o", tmp_path / "force.mcap"])
    (arm,) = read_arms([tmp_path / "force.mcap"])
    assert arm.robot == LEFT
    assert arm.wrench is not None
    assert arm.wrench.shape == (len(arm.t), 6)


@pytest.mark.filterwarnings("default")
def test_by_force_a_figure_and_a_motion_go_on(files, model, tmp_path, command, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    robots.save(OTHERS["tool"][0], "arm.toml")
    command(["dmp", "fit", files["log"], "-o", "motion.toml"])
    figure = ["plot", "robot", "arm.toml", files["log"], "-o", "new.png"]
    for words in (figure, ["dmp", "play", "motion.toml", "--robot", "arm.toml", "-o", "new.csv"]):
        command(words, code=2)
        assert "Expected the robot of" in command([*words, "--force"]).err
        assert Path(words[-1]).exists()
    command(["dmp", "play", "motion.toml", "--robot", "yumi_left", "-o", "own.csv"])
