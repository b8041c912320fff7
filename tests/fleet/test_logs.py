"""Selection of logs by name, export, and contact force in many logs."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from armlab import contact, fleet, identify, log
from armlab.errors import ConfigError, LogError, ModelMismatchError, ShapeError
from armlab.fleet.logs import Estimated, Log, as_table, named, targets
from armlab.log import Table
from armlab.robots import load


def test_a_folder_is_the_logs_in_it_and_below_in_the_order_of_their_names(
    tmp_path: Path, ur5e_bag: Path, short_arm
) -> None:
    logs = tmp_path / "logs"
    (logs / "b").mkdir(parents=True)
    for name in ("z.csv", "b/a.mcap", "a.parquet", "notes.txt", "z.csv.toml"):
        (logs / name).touch()
    wanted = [str(logs / name) for name in ("a.parquet", "b/a.mcap", "z.csv")]
    assert list(named(logs)) == list(named(str(logs))) == wanted
    assert list(named([logs / "z.csv", logs / "b"])) == [wanted[2], wanted[1]]
    assert list(named([ur5e_bag])) == [str(ur5e_bag)]
    table = short_arm.log(0, 100)
    found: Mapping[str, Log] = named([table, table])
    assert [name[-2:] for name in found] == ["#1", "#2"]
    assert as_table(found[next(iter(found))], short_arm.robot) is table


def test_bad_input_and_a_file_by_two_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for given, error, sentence in (
        ([], LogError, "at least one log, got an empty list"),
        (tmp_path, LogError, f"Expected logs in {tmp_path}, got no "),
        ([tmp_path / "no.mcap"], LogError, "a folder of logs, but .*no.mcap does not exist"),
        ([3], ShapeError, "got 3"),
        ([__file__, __file__], ShapeError, "test_logs.py twice"),
    ):
        with pytest.raises(error, match=sentence):
            named(given)  # type: ignore[arg-type]
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.mcap").touch()
    (tmp_path / "link.mcap").symlink_to(tmp_path / "logs" / "a.mcap")
    monkeypatch.chdir(tmp_path)
    for given in (["logs", tmp_path / "logs"], ["logs/a.mcap", "link.mcap"], ["logs", "logs/../logs/a.mcap"]):
        with pytest.raises(ShapeError, match="twice"):
            named(given)


def test_files_stand_in_folders_as_the_logs_do(tmp_path: Path) -> None:
    jobs = {name: tmp_path / name for name in ("monday/a.mcap", "monday/b.csv", "tuesday/a.mcap")}
    found = targets(jobs, tmp_path / "new", ".csv", "_estimate")
    wanted = ("monday/a_estimate.csv", "monday/b_estimate.csv", "tuesday/a_estimate.csv")
    assert found == {name: tmp_path / "new" / path for name, path in zip(jobs, wanted, strict=True)}
    assert targets({"a": tmp_path / "deep/a.mcap"}, tmp_path, ".mat") == {"a": tmp_path / "a.mat"}


def test_what_exists_or_cannot_be_named_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t [s]\n")
    logs = {"a": tmp_path / "logs/a.mcap", "b": tmp_path / "logs/b.mcap"}
    table = Table(np.arange(3.0), {"q": np.zeros((3, 1))})
    for jobs, folder, ending, error, sentence in (
        (logs, tmp_path, ".csv", ConfigError, r"but 1 already exist, the first being .*a\.csv.*--force"),
        ({k: tmp_path / f"a.{k}" for k in ("mcap", "csv")}, tmp_path / "new", ".mat", ShapeError, "distinct output"),
        ({"a": table}, tmp_path, ".mat", ShapeError, "got a table"),
        ({"a": tmp_path / "a.mcap"}, tmp_path, ".docx", ConfigError, r"Expected a file extension among \.mcap"),
    ):
        with pytest.raises(error, match=sentence):
            targets(jobs, folder, ending)
    assert targets(logs, tmp_path, ".csv", force=True)["a"] == tmp_path / "a.csv"


def test_a_log_is_never_replaced_by_what_it_becomes(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"rows")
    (tmp_path / "link").symlink_to(tmp_path)
    for folder in (tmp_path, tmp_path / "link"):
        with pytest.raises(
            ConfigError, match=r"but 1 are inputs, the first being .*a\.mcap\. Choose another folder or format"
        ):
            targets({"a": tmp_path / "a.mcap"}, folder, ".mcap", force=True)
    assert targets({"a": tmp_path / "a.mcap"}, tmp_path, ".csv", force=True) == {"a": tmp_path / "a.csv"}


def test_every_log_is_the_same_table_in_the_other_format(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.parquet").write_bytes(b"PAR1 nonsense")
    with ThreadPoolExecutor(2) as pool:
        done = fleet.export([folder, tmp_path / "bad.parquet"], tmp_path / "out", ".csv", pool)
    assert list(done.skipped) == [str(tmp_path / "bad.parquet")]
    assert "Parquet" in done.skipped[str(tmp_path / "bad.parquet")]
    assert len(done.results) == 6
    for name, path in done.results.items():
        assert path.suffix == ".csv"
        assert log.read(path).sha256 == log.read(name).sha256


def test_a_recording_needs_its_robot(folder: Path, tmp_path: Path, short_arm) -> None:
    with pytest.raises(ConfigError, match="--robot"):
        fleet.export(folder, tmp_path, ".mcap")
    done = fleet.export(folder / "log0.parquet", tmp_path, ".mcap", robot=short_arm.robot)
    (path,) = done.results.values()
    np.testing.assert_array_equal(log.read(path)["q"], log.read(folder / "log0.parquet")["q"])


@pytest.fixture(scope="module")
def recordings(truth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with a push, a log without one, and a log without torque."""
    folder = tmp_path_factory.mktemp("recordings")
    motion = identify.design_excitation(truth.robot, seconds=10, f0=0.1, speed=0.3, seed=5)

    def push(t: np.ndarray) -> np.ndarray:
        return np.where(((t > 4.0) & (t < 7.0))[:, None], [0.0, 0.0, -15.0, 0.0, 0.0, 0.0], 0.0)

    log.write(truth.log(motion, seed=6, wrench=push), folder / "pushed.mcap", truth.robot)
    log.write(truth.log(motion, seed=7), folder / "free.mcap", truth.robot)
    log.write(truth.log(motion, seed=8).without("tau"), folder / "no_torque.mcap", truth.robot)
    return folder


def test_each_log_gets_what_one_estimator_says_of_it(truth, model, recordings: Path, tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        done = fleet.estimate(recordings, model, truth.robot, tmp_path, pool)
    assert [Path(name).stem for name in done.skipped] == ["no_torque"]
    assert "got no tau among" in next(iter(done.skipped.values()))
    by_name = {Path(name).stem: one for name, one in done.results.items()}
    pushed, free = by_name["pushed"], by_name["free"]
    assert isinstance(pushed, Estimated)
    assert pushed.path == tmp_path / "pushed_estimate.mcap"
    assert pushed.contacts >= 1
    assert 2.0 < pushed.contact_seconds < 4.0
    assert 10.0 < pushed.peak < 25.0
    assert (free.contacts, free.contact_seconds, free.left_out) == (0, 0, 0)
    assert np.isnan(free.peak)
    given = log.read(recordings / "pushed.mcap")
    expected = contact.Estimator(model, truth.robot).run(given)["wrench_hat"]
    np.testing.assert_array_equal(log.read(pushed.path)["wrench_hat"], expected)


def test_what_leaves_no_log_to_use(truth, model, recordings: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"nonsense")
    with pytest.raises(LogError, match="usable log among 1, got none"):
        fleet.export(tmp_path, tmp_path / "out", ".csv")
    with pytest.raises(ModelMismatchError):
        fleet.estimate(recordings, model, load("irb120"), tmp_path / "out")
    with pytest.raises(LogError, match="usable log among 1, got none"):
        fleet.estimate(recordings / "no_torque.mcap", model, truth.robot, tmp_path / "out")
    assert not (tmp_path / "out").exists()
