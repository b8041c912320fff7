"""One model from many logs: the same bits everywhere, skipped logs, and the cache of sums."""

from __future__ import annotations

import os
import pickle
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
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


def bits(found: fleet.Identified) -> list[bytes]:
    fit = found.fit
    return [np.ascontiguousarray(x).tobytes() for x in (fit.parameters, fit.cov, fit.residuals, fit.sigma)]


def test_the_same_bits_here_in_threads_and_in_processes_also_when_one_is_killed(folder: Path, short_arm) -> None:
    here = fleet.identify(folder, short_arm.robot)
    assert len(here.used) == 6
    with ThreadPoolExecutor(3) as pool:
        assert bits(fleet.identify(folder, short_arm.robot, pool)) == bits(here)
    with ProcessPoolExecutor(2) as pool:
        assert bits(fleet.identify(folder, short_arm.robot, pool)) == bits(here)
    killed: list[int] = []

    def kill(done: int, total: int, what: str) -> None:
        if total == 6 and done >= 3 and not killed:
            killed.append(next(iter(pool._processes)))
            os.kill(killed[0], signal.SIGKILL)

    with ProcessPoolExecutor(2) as pool:
        found = fleet.identify(folder, short_arm.robot, pool, progress=kill)
    assert killed
    assert bits(found) == bits(here)
    assert found.skipped == {}


def test_it_is_the_fit_of_all_logs_at_once(folder: Path, short_arm) -> None:
    """The draft of a third of them has chosen its own terms of friction; the base parameters are the same."""
    found = fleet.identify(folder, short_arm.robot).fit
    tables = [log.read(path) for path in sorted(folder.iterdir())]
    whole = identify.fit_dynamics(tables, short_arm.robot)
    one, other = short_arm.of_base(found), short_arm.of_base(whole)
    assert one.names == other.names
    assert np.abs((one.parameters - other.parameters) / other.sd).max() < 0.5
    assert found.n == sum(map(len, tables))
    assert found.value.quality.seconds == pytest.approx(whole.value.quality.seconds)


def spoilt(short_arm) -> dict[str, tuple[Table, str]]:
    good, rows = short_arm.log(50, 1000), np.arange(1000)[:, None]
    return {
        "nan": (good.with_column("tau", np.where(rows == 5, np.nan, good["tau"])), "finite tau"),
        "other": (Table(good.t, {name: np.tile(good[name], 2) for name in good.names}), "with 2 joints"),
        "mute": (Table(good.t, {"q": good["q"], "qd": good["qd"]}), "none for tau"),
        "slow": (good.rows(slice(None, None, 2)), "sampling rate of the first logs, 100 Hz, got 50 Hz"),
    }


def test_logs_that_cannot_be_used_are_named_with_their_sentence(folder: Path, short_arm, tmp_path: Path) -> None:
    logs = shutil.copytree(folder, tmp_path / "logs")
    (logs / "torn.parquet").write_bytes(b"PAR1 and nothing else")
    wrong = {"torn": "torn.parquet"}
    for name, (table, sentence) in spoilt(short_arm).items():
        log.write(table, logs / f"{name}.parquet")
        wrong[name] = sentence
    found = fleet.identify(logs, short_arm.robot)
    alone = fleet.identify(sorted(logs.glob("log*")), short_arm.robot)  # cuts them into more stretches of time
    np.testing.assert_allclose(found.fit.parameters, alone.fit.parameters, rtol=1e-9)
    assert {Path(name).stem for name in found.skipped} == set(wrong)
    report, sources = found.report(), "\n".join(found.fit.value.sources)
    assert "6 logs used, 5 skipped" in report
    for name, reason in found.skipped.items():
        assert wrong[Path(name).stem] in reason
        assert f"skipped {name}: {reason}" in report
        assert f"{name} skipped: {reason}" in sources


def test_a_log_whose_rate_differs_first_does_not_decide(short_arm, tmp_path: Path) -> None:
    """One at another rate among the first is read for the draft, and left out of it."""
    tables = [short_arm.log(k, 1000) for k in range(3)]
    tables.insert(1, short_arm.log(9, 1000).rows(slice(None, None, 2)))
    found = fleet.identify(tables, short_arm.robot)
    assert [name[-2:] for name in found.skipped] == ["#2"]


def test_a_file_that_ends_its_reader_is_skipped_by_name_also_among_the_first(
    folder: Path, short_arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reader that ends its process stands for libraries that do so over a damaged file; workers are forked of it."""
    logs = shutil.copytree(folder, tmp_path / "logs")
    deadly, here = logs / "log0 deadly.parquet", os.getpid()
    shutil.copy(folder / "log0.parquet", deadly)

    def read(log, robot):
        if log == deadly and os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        assert log != deadly, "it was read by the caller"
        return as_table(log, robot)

    as_table = identification.as_table
    monkeypatch.setattr(identification, "as_table", read)
    with ProcessPoolExecutor(2, mp_context=get_context("fork")) as pool:
        found = fleet.identify(logs, short_arm.robot, pool)
    assert list(found.skipped) == [str(deadly)]
    assert "killed again" in found.skipped[str(deadly)]
    alone = fleet.identify(sorted(logs.glob("log?.parquet")), short_arm.robot)
    np.testing.assert_allclose(found.fit.parameters, alone.fit.parameters, rtol=1e-9)


def test_shapes_of_friction_that_no_worker_can_choose_end_it(
    folder: Path, short_arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(identification, "choose", lambda choice: (_ for _ in ()).throw(MemoryError("too large")))
    with pytest.raises(LogError, match="structure of friction of joint 1, but: too large"):
        fleet.identify(folder, short_arm.robot)


def test_all_skipped_is_an_error_with_a_reason(short_arm) -> None:
    bad = [table for name, (table, _) in spoilt(short_arm).items() if name != "slow"]
    with pytest.raises(LogError, match=r"among 3, got none.*#1: Expected finite tau"):
        fleet.identify(bad, short_arm.robot)


@pytest.mark.parametrize("place", [2, 6])
def test_a_copy_of_a_log_is_left_out_by_name(folder: Path, short_arm, tmp_path: Path, place: int) -> None:
    """Among the first and behind them: deviations shrank by it, though it says nothing new."""
    logs = [Path(path) for path in sorted(folder.iterdir())]
    copy = shutil.copy(logs[1], tmp_path / "again.parquet")
    found = fleet.identify([*logs[:place], copy, *logs[place:]], short_arm.robot)
    assert list(found.skipped) == [str(copy)]
    assert f"its rows are those of {logs[1]}" in found.skipped[str(copy)]
    assert found.used == tuple(map(str, logs))
    alone = fleet.identify(logs, short_arm.robot)
    np.testing.assert_allclose(found.fit.parameters, alone.fit.parameters, rtol=1e-9)


def test_joints_may_move_in_a_log_each(short_arm) -> None:
    """No log alone tells anything of the joint that rests; together they are excited."""
    poses = [{1: -0.5}, {1: 0.2}, {1: 1.0}, {0: 0.3}, {0: -0.2}]
    tables = [short_arm.log(k, 1000, still=still) for k, still in enumerate(poses)]
    with pytest.raises(NotExcited, match="joint_2"):
        identify.fit_dynamics(tables[0], short_arm.robot)
    with pytest.raises(NotExcited, match="joint_1"):
        identify.fit_dynamics(tables[-1], short_arm.robot)
    found = fleet.identify(tables, short_arm.robot)
    assert len(found.used) == 5
    truth = short_arm.experiment()(0, 1000).truth
    fit = short_arm.of_base(found.fit)
    assert np.abs((fit.parameters - truth) / fit.sd).max() < 5.0


def test_workers_that_try_all_logs_at_once_go_on_with_more_as_one_process_does(short_arm) -> None:
    """The draft's first two logs do not tell enough; four workers know the others by then."""
    poses = [{1: -0.5}, {1: 0.2}, {0: 0.3}, {0: -0.2}]
    tables = [short_arm.log(k, 1000, still=still) for k, still in enumerate(poses)]
    here = fleet.identify(tables, short_arm.robot)
    with ThreadPoolExecutor(4) as pool:
        assert bits(fleet.identify(tables, short_arm.robot, pool)) == bits(here)
    assert len(here.used) == 4


def test_a_recording_that_was_not_finished_is_recovered_and_used(folder: Path, short_arm, tmp_path: Path) -> None:
    whole = log.write(short_arm.log(7, 3000), tmp_path / "whole.mcap", short_arm.robot).read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(whole[: int(0.8 * len(whole))])
    with pytest.warns(UserWarning, match=r"torn\.mcap was not finished"):
        found = fleet.identify([*sorted(folder.iterdir()), torn], short_arm.robot)
    assert found.used[-1] == str(torn)
    assert 7000 < found.fit.n < 9000


@pytest.mark.slow  # 20 s beside other work
def test_errors_shrink_with_more_logs_and_the_covariance_holds(short_arm) -> None:
    """Four times the logs: half the error. NEES of the base parameters near 1 over twelve draws."""
    truth = short_arm.experiment()(0, 1000).truth
    errors, nees = {4: [], 16: []}, []
    for draw in range(12):
        for count, found in errors.items():
            tables = [short_arm.log(1000 * draw + k, 1000) for k in range(count)]
            fit = short_arm.of_base(fleet.identify(tables, short_arm.robot).fit)
            e = fit.parameters - truth
            found.append(e)
            nees.append(e @ np.linalg.solve(fit.cov, e) / len(e))
    few, many = (np.sqrt(np.mean(np.square(found), axis=0)) for found in errors.values())
    assert 0.4 < np.median(many / few) < 0.6
    assert 0.6 < np.mean(nees) < 1.5


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one for each log that is reduced to sums."""
    count: list[int] = []
    make: Callable = identification.log_sums
    monkeypatch.setattr(identification, "log_sums", lambda *given: count.append(1) or make(*given))
    return count


def same(one: fleet.Identified, other: fleet.Identified) -> bool:
    return all(
        np.array_equal(getattr(one.fit, name), getattr(other.fit, name)) for name in ("parameters", "cov", "residuals")
    )


def test_a_second_run_makes_no_sums(folder: Path, short_arm, tmp_path: Path, made: list[int]) -> None:
    logs = shutil.copytree(folder, tmp_path / "logs")
    cache = tmp_path / "cache"
    plain = fleet.identify(logs, short_arm.robot)
    del made[:]
    first = fleet.identify(logs, short_arm.robot, cache=cache)
    assert len(made) == 6
    assert same(fleet.identify(logs, short_arm.robot, cache=cache), first)
    assert same(first, plain)
    assert len(made) == 6


@pytest.mark.slow  # 35 logs
def test_of_thirty_logs_and_more_five_new_ones_cost_five(
    short_arm, tmp_path: Path, made: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armlab.identify.many.FEWEST_BLOCKS", 30)  # a block for each log, of 30 as of 35
    logs, cache = tmp_path / "logs", tmp_path / "cache"
    logs.mkdir()
    for k in range(35):
        log.write(short_arm.log(k, 600), tmp_path / f"log{k:02d}.parquet")
        if k < 30:
            shutil.move(tmp_path / f"log{k:02d}.parquet", logs)
    fleet.identify(logs, short_arm.robot, cache=cache)
    assert len(made) == 30
    for path in tmp_path.glob("*.parquet"):
        shutil.move(path, logs)
    found = fleet.identify(logs, short_arm.robot, cache=cache)
    assert len(found.used) == 35
    assert len(made) == 35
    assert same(found, fleet.identify(logs, short_arm.robot))


CALLER = """
import os, pickle, signal, sys
from pathlib import Path
from armlab import fleet
from armlab.fleet import identification
identification.DRAFT_SECONDS = 15.0

def stop(done, total, what):
    if (done, total) == (3, 6):
        os.kill(os.getpid(), int(sys.argv[4]))

robot = pickle.loads(Path(sys.argv[2]).read_bytes())
fleet.identify(sys.argv[1], robot, None, stop, Path(sys.argv[3]))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_run_goes_on(folder: Path, short_arm, tmp_path: Path, made: list[int], number: int) -> None:
    """The process that called ends half-way, by Ctrl-C or by kill -9; nothing that it kept is made again."""
    cache, robot = tmp_path / "cache", tmp_path / "robot"
    robot.write_bytes(pickle.dumps(short_arm.robot))
    words = [sys.executable, "-c", CALLER, str(folder), str(robot), str(cache), str(int(number))]
    ended = subprocess.run(words, stderr=subprocess.DEVNULL, timeout=300.0)
    assert ended.returncode == -number
    assert len(list(cache.glob("*.npz"))) == 3
    found = fleet.identify(folder, short_arm.robot, cache=cache)
    assert len(made) == 3
    assert same(found, fleet.identify(folder, short_arm.robot))


@pytest.mark.parametrize("name", ["__version__", "VERSION"])
def test_another_version_of_the_code_makes_all_sums_anew(
    folder: Path, short_arm, tmp_path: Path, made: list[int], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    fleet.identify(folder, short_arm.robot, cache=tmp_path)
    monkeypatch.setattr(f"armlab.fleet.identification.{name}", "another")
    fleet.identify(folder, short_arm.robot, cache=tmp_path)
    assert len(made) == 12


def test_another_robot_makes_all_sums_anew(folder: Path, short_arm, tmp_path: Path, made: list[int]) -> None:
    fleet.identify(folder, short_arm.robot, cache=tmp_path)
    other = replace(short_arm.robot, gravity=0.99 * np.asarray(short_arm.robot.gravity))
    fleet.identify(folder, other, cache=tmp_path)
    assert len(made) == 12


def test_files_that_do_not_read_are_made_anew(folder: Path, short_arm, tmp_path: Path, made: list[int]) -> None:
    cache = tmp_path / "cache"
    first = fleet.identify(folder, short_arm.robot, cache=cache)
    files = sorted(cache.iterdir())
    assert len(files) == 6
    files[0].write_bytes(b"")
    files[1].write_bytes(files[1].read_bytes()[:1000])
    files[2].write_bytes(pickle.dumps({"counts": 1}))
    np.savez(files[3], counts=np.array([1, 2]))
    del made[:]
    assert same(fleet.identify(folder, short_arm.robot, cache=cache), first)
    assert len(made) == 4
    assert same(fleet.identify(folder, short_arm.robot, cache=cache), first)
    assert len(made) == 4


def test_two_that_keep_the_sums_of_equal_files_at_once(
    folder: Path, short_arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with one log under two names, or two runs over one folder."""
    first = fleet.identify(folder, short_arm.robot, cache=tmp_path / "cache")
    write, deep = np.savez, []

    def meanwhile(*given, **named) -> None:
        if not deep:
            deep.append(1)
            fleet.identify(folder, short_arm.robot, cache=tmp_path / "other")
        write(*given, **named)

    monkeypatch.setattr(np, "savez", meanwhile)
    assert same(fleet.identify(folder, short_arm.robot, cache=tmp_path / "other"), first)
    assert sorted(path.name for path in (tmp_path / "other").iterdir()) == sorted(
        path.name for path in (tmp_path / "cache").iterdir()
    )


def test_a_cache_that_cannot_be_written_costs_time_only(folder: Path, short_arm, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file in its place")
    found = fleet.identify(folder, short_arm.robot, cache=tmp_path / "cache")
    assert found.skipped == {}
    assert same(found, fleet.identify(folder, short_arm.robot))


def test_nothing_in_them_is_a_pickle(folder: Path, short_arm, tmp_path: Path) -> None:
    fleet.identify(folder, short_arm.robot, cache=tmp_path)
    for path in tmp_path.iterdir():
        with np.load(path, allow_pickle=False) as kept:
            assert {kept[name].dtype.kind for name in kept.files} <= set("fiubU")


def test_the_default_folder_is_the_users(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert default_folder() == Path("/somewhere/armlab/sums")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_folder() == Path.home() / ".cache/armlab/sums"
