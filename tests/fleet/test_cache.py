"""Sums that are kept: whole, of this log and pattern only, and made anew when they do not read."""

from __future__ import annotations

import pickle
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import fleet, log
from armlab.fleet import identification
from armlab.fleet.identification import SumCache, default_folder

pytestmark = pytest.mark.usefixtures("early")


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


@pytest.mark.slow  # 60 logs
def test_of_sixty_logs_and_more_ten_new_ones_cost_ten(short_arm, tmp_path: Path, made: list[int]) -> None:
    logs, cache = tmp_path / "logs", tmp_path / "cache"
    logs.mkdir()
    for k in range(70):
        log.write(short_arm.log(k, 600), tmp_path / f"log{k:02d}.parquet")
        if k < 60:
            shutil.move(tmp_path / f"log{k:02d}.parquet", logs)
    fleet.identify(logs, short_arm.robot, cache=cache)
    assert len(made) == 60
    for path in tmp_path.glob("*.parquet"):
        shutil.move(path, logs)
    found = fleet.identify(logs, short_arm.robot, cache=cache)
    assert len(found.used) == 70
    assert len(made) == 70
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


def test_another_log_or_pattern_has_another_file(folder: Path, tmp_path: Path) -> None:
    class Pattern:
        sha256 = "a"

    class Other:
        sha256 = "b"

    first, second = sorted(folder.iterdir())[:2]
    names = {SumCache(tmp_path, of()).path(path) for of in (Pattern, Other) for path in (first, second)}  # type: ignore
    assert len(names) == 4


def test_the_default_folder_is_the_users(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert default_folder() == Path("/somewhere/armlab/sums")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_folder() == Path.home() / ".cache/armlab/sums"
