"""What a recording says of itself."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from armlab.errors import RobotError
from armlab.log.recording.metadata import attached, described, metadata, revision
from armlab.robots import Robot, from_toml, load, to_toml


def git(folder: Path, *words: str) -> str:
    who = ["-c", "user.name=a", "-c", "user.email=a@localhost", "-c", "commit.gpgsign=false"]
    done = subprocess.run(["git", "-C", str(folder), *who, *words], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_the_commit_of_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    assert revision(folder) == ""
    revision.cache_clear()
    git(folder, "init", "-q")
    (folder / "controller.py").write_text("gain = 1")
    git(folder, "add", ".")
    git(folder, "commit", "-qm", "first")
    assert revision(folder) == git(folder, "rev-parse", "HEAD")
    revision.cache_clear()
    (folder / "controller.py").write_text("gain = 2")
    assert revision(folder) == git(folder, "rev-parse", "HEAD") + "+"


def test_the_robot_that_attachments_describe() -> None:
    left, right = load("yumi_left"), load("yumi_right")
    files = {"model.toml": b"1", "robot.toml": to_toml(left).encode(), "robot-2.toml": to_toml(right).encode()}
    assert described(files, "yumi_right", "run.mcap") == right
    assert described(files, "irb120", "run.mcap") is None
    with pytest.raises(RobotError, match=r"run\.mcap, robot\.toml"):
        described({"robot.toml": b"\xff"}, "yumi_left", "run.mcap")


def test_without_git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert revision(tmp_path / "other") == ""


def test_metadata_has_the_hashes_of_what_is_attached(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["armlab", "run", "--token", "abc", "--api-key=xyz", "tokens.py", "--seed", "3"])
    about = metadata(robot, {"model.toml": b"1"}, "mine")
    assert about["command"] == "armlab run --token *** --api-key=*** tokens.py --seed 3"
    assert (about["robot"], about["robot_hash"], about["note"]) == (robot.name, robot.hash, "mine")
    assert json.loads(about["attachments"]) == {"model.toml": hashlib.sha256(b"1").hexdigest()}


def test_secrets_in_settings_are_replaced(robot: Robot) -> None:
    found = attached(robot, {"cell.toml": b"[token]\nkey = 'abc'", "data.bin": b"token = 1"})
    assert tomllib.loads(found["cell.toml"].decode()) == {"token": "***"}
    assert found["data.bin"] == b"token = 1"


def test_the_description_of_the_robot_is_there(robot: Robot) -> None:
    assert from_toml(attached(robot, {})["robot.toml"].decode(), "it").hash == robot.hash
    assert attached(robot, {"robot.toml": b"mine"}) == {"robot.toml": b"mine"}
