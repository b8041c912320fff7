"""Sums that are kept: whole, of this log and pattern only, and made anew when they do not read."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armlab import fleet, log
from armlab.fleet import identification
from armlab.fleet.cache import SumCache, default_folder

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


def test_a_second_run_makes_no_sums_and_more_logs_cost_only_themselves(
    folder: Path, short_arm, tmp_path: Path, made: list[int]
) -> None:
    logs = shutil.copytree(folder, tmp_path / "logs")
    cache = tmp_path / "cache"
    plain = fleet.identify(logs, short_arm.robot)
    del made[:]
    first = fleet.identify(logs, short_arm.robot, cache=cache)
    assert len(made) == 6
    assert same(fleet.identify(logs, short_arm.robot, cache=cache), first)
    assert same(first, plain)
    assert len(made) == 6
    for k in range(2):
        log.write(short_arm.log(10 + k, 1000), logs / f"more{k}.parquet")
    assert len(fleet.identify(logs, short_arm.robot, cache=cache).used) == 8
    # Fewer blocks per log are enough for more logs, until there are sixty of them: then all are made again.
    assert len(made) in (8, 14)


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
