"""Files, folders and tables become logs by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from armlab.errors import LogError, ShapeError
from armlab.fleet.logs import Log, as_table, named


def test_a_folder_is_the_logs_in_it_and_below_in_the_order_of_their_names(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    for name in ("z.csv", "b/a.mcap", "a.parquet", "notes.txt", "z.csv.toml"):
        (tmp_path / name).touch()
    wanted = [str(tmp_path / name) for name in ("a.parquet", "b/a.mcap", "z.csv")]
    assert list(named(tmp_path)) == list(named(str(tmp_path))) == wanted
    assert list(named([tmp_path / "z.csv", tmp_path / "b"])) == [wanted[2], wanted[1]]


def test_a_bag_is_one_log(ur5e_bag: Path) -> None:
    assert list(named([ur5e_bag])) == [str(ur5e_bag)]


def test_tables_have_names_by_their_place(short_arm) -> None:
    table = short_arm.log(0, 100)
    found: Mapping[str, Log] = named([table, table])
    assert [name.endswith(end) for name, end in zip(found, ("#1", "#2"))] == [True, True]
    assert as_table(found[next(iter(found))], short_arm.robot) is table


def test_a_file_by_two_names_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.mcap").touch()
    (tmp_path / "link.mcap").symlink_to(tmp_path / "logs" / "a.mcap")
    monkeypatch.chdir(tmp_path)
    for given in (["logs", tmp_path / "logs"], ["logs/a.mcap", "link.mcap"], ["logs", "logs/../logs/a.mcap"]):
        with pytest.raises(ShapeError, match="twice"):
            named(given)


def test_bad_input(tmp_path: Path) -> None:
    for given, error, sentence in (
        ([], LogError, "at least one log, got none"),
        (tmp_path, LogError, f"Expected logs in {tmp_path}, got none"),
        ([tmp_path / "no.mcap"], LogError, "no.mcap, which does not exist"),
        ([3], ShapeError, "got 3"),
        ([__file__, __file__], ShapeError, "test_logs.py twice"),
    ):
        with pytest.raises(error, match=sentence):
            named(given)  # type: ignore[arg-type]
