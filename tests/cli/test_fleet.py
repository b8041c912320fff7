"""``armlab fleet``: the verbs for many robots."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import cli, log, models, robots
from armlab.fleet import Router
from armlab.fleet.identification import Identified

from ..processes import free_port


def test_a_router_says_where_it_listens(command) -> None:
    port = free_port()
    said = command(["fleet", "router", "--port", port, "--seconds", "0"]).err
    assert said == f"zenoh router at tcp/127.0.0.1:{port}\n"


def test_an_empty_fleet(tmp_path: Path, command) -> None:
    port = free_port()
    with Router(port=port):
        where = ["--router", f"127.0.0.1:{port}"]
        assert command(["fleet", "list", *where, "--seconds", "0"]).out == "No robots found.\n"
        assert json.loads(command(["fleet", "list", *where, "--json"]).out) == []
        said = command(["fleet", "record", *where, "-o", tmp_path / "new", "--seconds", "0"]).out
        assert said == "No robots recorded.\n"
    assert threading.active_count() < 20  # the listening threads have ended


@pytest.fixture
def logs(truth, excited, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "logs").mkdir()
    log.write(excited, tmp_path / "logs/one.mcap", truth.robot)
    (tmp_path / "logs/bad.mcap").write_bytes(b"nonsense")
    return tmp_path / "logs"


@pytest.mark.slow  # 5 s beside other work
def test_the_robot_is_the_one_of_the_recordings_and_skipped_logs_are_named(logs: Path, truth, command) -> None:
    model = logs.parent / "model.toml"
    words = ["fleet", "identify", str(logs), "-o", str(model)]
    said = json.loads(command([*words, "--json"], cli.DOUBTFUL).out)
    assert said["used"] == [str(logs / "one.mcap")]
    assert list(said["skipped"]) == [str(logs / "bad.mcap")]
    assert len(said["parameters"]) > 20
    assert models.load(model).robot_name == truth.robot.name
    assert len(list((logs.parent / "cache/armlab/sums").iterdir())) == 1
    assert "--force" in command(words, cli.WRONG_USE).err


def test_bad_input(logs: Path, tmp_path: Path, command) -> None:
    (logs / "one.mcap").unlink()
    words = ["fleet", "identify", str(logs), "-o", str(tmp_path / "model.toml")]
    for more, code, sentence in (
        ([], cli.WRONG_USE, "Add --robot"),
        (["--robot", "yumi_left"], cli.FAILED, "a usable log among 1, got none"),
        (["--robot", "yumi_left", "--workers", "0"], cli.WRONG_USE, "at least one worker, got 0"),
    ):
        assert sentence in command([*words, *more], code).err
    assert not (tmp_path / "model.toml").exists()


def test_estimates_and_exports_of_many_logs(logs: Path, model, tmp_path: Path, command) -> None:
    models.save(model, tmp_path / "model.toml")
    words = ["fleet", "estimate", str(logs), "--model", str(tmp_path / "model.toml"), "-o", str(tmp_path / "new")]
    said = command(words, cli.DOUBTFUL)
    assert "2-sigma [N]" in said.out
    assert f"skipped {logs / 'bad.mcap'}" in said.err
    assert (tmp_path / "new/one_estimate.mcap").is_file()
    assert "--force" in command(words, cli.WRONG_USE).err
    told = json.loads(command([*words, "--force", "--csv", "--json"], cli.DOUBTFUL).out)["logs"][str(logs / "one.mcap")]
    assert told["contacts"] == 0
    assert told["peak"] is None  # there was no contact

    words = ["fleet", "export", str(logs), "--format", "csv", "-o", str(tmp_path / "text"), "--json"]
    (path,) = json.loads(command(words, cli.DOUBTFUL).out)["files"].values()
    assert log.read(path).sha256 == log.read(logs / "one.mcap").sha256


def test_logs_of_other_programs_with_their_columns(logs: Path, model, excited, tmp_path: Path, command) -> None:
    n = excited["q"].shape[1]
    names = [f"{own}{k}" for own in ("angle", "speed", "torque") for k in range(1, n + 1)]
    rows = np.hstack([excited.t[:, None], *(excited[name] for name in ("q", "qd", "tau"))])
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    np.savetxt(foreign / "one.csv", rows, delimiter=",", header=",".join(["t", *names]), comments="")
    models.save(model, tmp_path / "model.toml")
    columns = f"q=angle{{1..{n}}} [rad],qd=speed{{1..{n}}} [rad/s],tau=torque{{1..{n}}} [N m]"
    words = ["fleet", "estimate", foreign, "--model", tmp_path / "model.toml", "--robot", model.robot_name]
    words += ["-o", tmp_path / "new", "--json"]
    assert "columns q and tau" in command(words, cli.FAILED).err
    (found,) = json.loads(command([*words, "--columns", columns]).out)["logs"].values()
    assert found["rows"] == len(excited)
    words = ["fleet", "export", foreign, "--format", "csv", "-o", tmp_path / "text", "--columns", columns, "--json"]
    (path,) = json.loads(command(words).out)["files"].values()
    np.testing.assert_allclose(log.read(path)["tau"], excited["tau"])


@pytest.mark.slow  # a thousand logs
def test_a_damaged_log_among_a_thousand_is_named(short_arm, tmp_path: Path, capsys) -> None:
    logs, robot = tmp_path / "logs", tmp_path / "short.toml"
    logs.mkdir()
    robots.save(short_arm.robot, robot)
    made = [short_arm.log(k, 600) for k in range(20)]
    for k in range(999):
        log.write(made[k % 20].rows(slice(k // 20, None)), logs / f"log{k:03d}.parquet")
    whole = (logs / "log000.parquet").read_bytes()
    (logs / "log500_damaged.parquet").write_bytes(whole[: len(whole) // 2])
    words = ["fleet", "identify", str(logs), "-o", str(tmp_path / "model.toml"), "--robot", str(robot), "--no-cache"]
    assert cli.main([*words, "--workers", "2"]) == cli.DOUBTFUL == 3
    said = capsys.readouterr()
    assert "999 logs used, 1 skipped" in said.out
    assert f"skipped {logs / 'log500_damaged.parquet'}: " in said.out
    assert "1000 of 1000 logs, " in said.err
    assert "log500_damaged" in (tmp_path / "model.toml").read_text()


def test_a_model_that_is_not_good_is_saved_by_force_only(logs: Path, fitted, monkeypatch, command) -> None:
    found = Identified(replace(fitted, doubts=("Joint 2 reads half.",)), (str(logs / "one.mcap"),), {})
    monkeypatch.setattr("armlab.fleet.identify", lambda *_, **__: found)
    words = ["fleet", "identify", logs / "one.mcap", "-o", logs / "model.toml"]
    said = command(words, cli.DOUBTFUL)
    assert "problems: Joint 2 reads half." in said.out
    assert "not saved" in said.err
    assert not (logs / "model.toml").exists()
    command([*words, "--force"])
    assert models.load(logs / "model.toml", "torque_model").n == 7
