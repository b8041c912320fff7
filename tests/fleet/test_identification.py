"""One model from many logs: the same bits everywhere, skipped logs, and the cache of sums."""

from __future__ import annotations

import os
import pickle
import shutil
import signal
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from armlab import fleet, identify, log
from armlab.errors import LogError, NotExcited
from armlab.fleet import identification
from armlab.fleet.identification import default_folder
from armlab.log import Table

pytestmark = pytest.mark.usefixtures("early")


@pytest.fixture(scope="module")
def sums(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cache of `plain`."""
    return tmp_path_factory.mktemp("sums")


@pytest.fixture(scope="module")
def plain(early: None, folder: Path, short_arm, sums: Path) -> fleet.Identified:
    return fleet.identify(folder, short_arm.robot, cache=sums)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list that grows by one for each log reduced to sums."""
    count, make = [], identification.log_sums
    monkeypatch.setattr(identification, "log_sums", lambda *given: count.append(1) or make(*given))
    return count


def bits(found: fleet.Identified) -> list[bytes]:
    fit = found.fit
    return [np.ascontiguousarray(x).tobytes() for x in (fit.parameters, fit.cov, fit.residuals, fit.sigma)]


@pytest.mark.slow
def test_the_same_bits_in_processes_of_which_one_is_killed(folder: Path, short_arm, plain: fleet.Identified) -> None:
    assert len(plain.used) == 6
    killed: list[int] = []

    def kill(done: int, total: int, what: str) -> None:
        if total == 6 and done >= 3 and not killed:
            killed.append(next(iter(pool._processes)))
            os.kill(killed[0], signal.SIGKILL)

    with ProcessPoolExecutor(2) as pool:
        found = fleet.identify(folder, short_arm.robot, pool, progress=kill)
    assert killed
    assert bits(found) == bits(plain)
    assert found.skipped == {}


def test_it_is_the_fit_of_all_logs_at_once(folder: Path, short_arm, plain: fleet.Identified) -> None:
    """The draft from a third of the logs has chosen its own friction terms; the base parameters are the same."""
    tables = [log.read(path) for path in sorted(folder.iterdir())]
    whole = identify.fit_dynamics(tables, short_arm.robot)
    one, other = short_arm.of_base(plain.fit), short_arm.of_base(whole)
    assert one.names == other.names
    assert np.abs((one.parameters - other.parameters) / other.sd).max() < 0.5
    assert plain.fit.n == sum(map(len, tables))
    assert plain.fit.value.quality.seconds == pytest.approx(whole.value.quality.seconds)


def spoilt(short_arm) -> dict[str, tuple[Table, str]]:
    good, rows = short_arm.log(50, 1000), np.arange(1000)[:, None]
    return {
        "nan": (good.with_column("tau", np.where(rows == 5, np.nan, good["tau"])), "finite tau"),
        "other": (Table(good.t, {name: np.tile(good[name], 2) for name in good.names}), "with 2 joints"),
        "mute": (Table(good.t, {"q": good["q"], "qd": good["qd"]}), "got no tau among"),
    }


def test_logs_that_cannot_be_used_are_named_with_their_sentence(
    folder: Path, short_arm, tmp_path: Path, plain: fleet.Identified
) -> None:
    logs = shutil.copytree(folder, tmp_path / "logs")
    (logs / "torn.parquet").write_bytes(b"PAR1 and nothing else")
    log.write(short_arm.log(9, 1000).rows(slice(None, None, 2)), logs / "log0_slow.parquet")
    wrong = {"torn": "torn.parquet", "log0_slow": "sampling rate as in the first logs, 100 Hz, got 50 Hz"}
    for name in ("log0_copy", "z_copy"):  # among the first logs, and after them
        shutil.copy(logs / "log0.parquet", logs / f"{name}.parquet")
        wrong[name] = f"it repeats the rows of {logs / 'log0.parquet'}"
    for name, (table, sentence) in spoilt(short_arm).items():
        log.write(table, logs / f"{name}.parquet")
        wrong[name] = sentence
    found = fleet.identify(logs, short_arm.robot)
    np.testing.assert_allclose(found.fit.parameters, plain.fit.parameters, rtol=1e-9)
    assert {Path(name).stem for name in found.skipped} == set(wrong)
    report, sources = found.report(), "\n".join(found.fit.value.sources)
    assert "6 logs used, 7 skipped" in report
    for name, reason in found.skipped.items():
        assert wrong[Path(name).stem] in reason
        assert f"skipped {name}: {reason}" in report
        assert f"{name} skipped: {reason}" in sources


@pytest.mark.slow
def test_a_file_that_ends_its_reader_is_skipped_by_name_also_among_the_first(
    folder: Path, short_arm, tmp_path: Path, plain: fleet.Identified, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = shutil.copytree(folder, tmp_path / "logs")
    deadly, here = logs / "log0 deadly.parquet", os.getpid()
    shutil.copy(folder / "log0.parquet", deadly)

    def read(log, robot, *more, **options):
        if log == deadly and os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        assert log != deadly, "it was read by the caller"
        return as_table(log, robot, *more, **options)

    as_table = identification.as_table
    monkeypatch.setattr(identification, "as_table", read)
    with ProcessPoolExecutor(2, mp_context=get_context("fork")) as pool:
        found = fleet.identify(logs, short_arm.robot, pool)
    assert list(found.skipped) == [str(deadly)]
    assert "but it crashed again" in found.skipped[str(deadly)]
    np.testing.assert_allclose(found.fit.parameters, plain.fit.parameters, rtol=1e-9)


def test_shapes_of_friction_that_no_worker_can_choose_end_it(
    folder: Path, short_arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(identification, "choose", lambda choice: (_ for _ in ()).throw(MemoryError("too large")))
    with pytest.raises(LogError, match="friction structure for joint 1, but its selection failed: too large"):
        fleet.identify(folder, short_arm.robot)


def test_all_skipped_is_an_error_with_a_reason(short_arm) -> None:
    with pytest.raises(LogError, match=r"among 3, got none.*#1: Expected finite tau"):
        fleet.identify([table for table, _ in spoilt(short_arm).values()], short_arm.robot)


@pytest.mark.slow
def test_joints_may_move_in_a_log_each(short_arm) -> None:
    tables = [short_arm.log(k, 1000, still=still) for k, still in enumerate([{1: -0.5}, {1: 0.2}, {0: 0.3}, {0: -0.2}])]
    for table, joint in ((tables[0], "joint_2"), (tables[-1], "joint_1")):
        with pytest.raises(NotExcited, match=joint):
            identify.fit_dynamics(table, short_arm.robot)
    with ThreadPoolExecutor(4) as pool:
        found = fleet.identify(tables, short_arm.robot, pool)
    assert len(found.used) == 4
    assert bits(found) == bits(fleet.identify(tables, short_arm.robot))
    fit = short_arm.of_base(found.fit)
    assert np.abs((fit.parameters - short_arm.experiment()(0, 1000).truth) / fit.sd).max() < 5.0


def test_a_recording_that_was_not_finished_is_recovered_and_used(folder: Path, short_arm, tmp_path: Path) -> None:
    whole = log.write(short_arm.log(7, 3000), tmp_path / "whole.mcap", short_arm.robot).read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(whole[: int(0.8 * len(whole))])
    with pytest.warns(UserWarning, match=r"torn\.mcap was not finished"):
        found = fleet.identify([*sorted(folder.iterdir())[:2], torn], short_arm.robot)
    assert found.used[-1] == str(torn)
    assert 3000 < found.fit.n < 5000


@pytest.mark.slow  # 15 s beside other work
def test_errors_shrink_with_more_logs_and_the_covariance_holds(short_arm) -> None:
    """Four times the logs: half the error. NEES of the base parameters near 1 over nine draws."""
    truth = short_arm.experiment()(0, 1000).truth
    errors, nees = {4: [], 16: []}, []
    for draw in range(9):
        for count, found in errors.items():
            tables = [short_arm.log(1000 * draw + k, 1000) for k in range(count)]
            fit = short_arm.of_base(fleet.identify(tables, short_arm.robot).fit)
            e = fit.parameters - truth
            found.append(e)
            nees.append(e @ np.linalg.solve(fit.cov, e) / len(e))
    few, many = (np.sqrt(np.mean(np.square(found), axis=0)) for found in errors.values())
    assert 0.4 < np.median(many / few) < 0.6
    assert 0.6 < np.mean(nees) < 1.5


@pytest.mark.slow
def test_a_second_run_makes_no_sums_and_damaged_ones_are_made_anew(
    folder: Path, short_arm, tmp_path: Path, plain: fleet.Identified, sums: Path, made: list[int]
) -> None:
    cache = shutil.copytree(sums, tmp_path / "cache")
    assert bits(fleet.identify(folder, short_arm.robot, cache=cache)) == bits(plain)
    assert made == []
    files = sorted(cache.iterdir())
    assert len(files) == 6
    files[0].write_bytes(b"")
    files[1].write_bytes(files[1].read_bytes()[:1000])
    files[2].write_bytes(pickle.dumps({"counts": 1}))
    np.savez(files[3], counts=np.array([1, 2]))
    assert bits(fleet.identify(folder, short_arm.robot, cache=cache)) == bits(plain)
    assert len(made) == 4
    assert sorted(cache.iterdir()) == files
    for path in files:
        with np.load(path, allow_pickle=False) as kept:  # nothing in it is a pickle
            assert {kept[name].dtype.kind for name in kept.files} <= set("fiubU")


def test_an_interrupted_run_goes_on(
    folder: Path, short_arm, tmp_path: Path, plain: fleet.Identified, made: list[int]
) -> None:
    cache = tmp_path / "cache"

    def stop(done: int, total: int, what: str) -> None:
        if (done, total) == (3, 6):
            assert len(list(cache.glob("*.npz"))) == 3
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fleet.identify(folder, short_arm.robot, None, stop, cache)
    del made[:]
    assert bits(fleet.identify(folder, short_arm.robot, cache=cache)) == bits(plain)
    assert len(made) == 3


def test_another_version_of_the_code_or_another_robot_makes_all_sums_anew(
    folder: Path, short_arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, *_ = logs = sorted(folder.iterdir())[:2]
    robot = short_arm.robot
    patterns = [
        identification.fit_draft([log.read(path) for path in logs], one, 2)[1]
        for one in (robot, replace(robot, gravity=0.99 * np.asarray(robot.gravity)))
    ]
    paths = {identification.SumCache(tmp_path, pattern).path(first) for pattern in patterns}
    for name in ("__version__", "VERSION"):
        with monkeypatch.context() as patch:
            patch.setattr(identification, name, "another")
            paths.add(identification.SumCache(tmp_path, patterns[0]).path(first))
    assert len(paths) == 4
    assert identification.SumCache(tmp_path, patterns[0]).path(first) in paths


@pytest.mark.slow
def test_two_that_keep_the_sums_of_equal_files_at_once(
    folder: Path, short_arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs, write, inner = sorted(folder.iterdir())[:2], np.savez, []

    def meanwhile(*given, **named) -> None:
        if not inner:
            inner.append(None)
            inner[0] = fleet.identify(logs, short_arm.robot, cache=tmp_path)
        write(*given, **named)

    monkeypatch.setattr(np, "savez", meanwhile)
    assert bits(fleet.identify(logs, short_arm.robot, cache=tmp_path)) == bits(inner[0])
    assert len(list(tmp_path.iterdir())) == 2


def test_a_cache_that_cannot_be_written_costs_time_only_and_is_the_users_by_default(
    folder: Path, short_arm, tmp_path: Path, plain, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cache").write_text("a file in its place")
    assert bits(fleet.identify(folder, short_arm.robot, cache=tmp_path / "cache")) == bits(plain)
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert default_folder() == Path("/somewhere/armlab/sums")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_folder() == Path.home() / ".cache/armlab/sums"
