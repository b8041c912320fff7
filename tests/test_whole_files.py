"""A file is there whole or not at all, also when the disk is full or somebody interrupts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from armlab._whole_files import whole_file


def test_a_file_is_replaced_in_one_step(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("old")
    with whole_file(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_names_the_file_and_leaves_the_old_one(tmp_path: Path, full_disk: Any) -> None:
    path = tmp_path / "a.toml"
    path.write_text("old")
    with full_disk(), pytest.raises(OSError, match=r"too large.*a\.toml'$"), whole_file(path) as part:
        part.write_bytes(bytes(1000))
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_what_fails_leaves_nothing(error: type[BaseException], tmp_path: Path) -> None:
    def fail() -> None:
        raise error

    with pytest.raises(FileNotFoundError, match=r"none/a'$"), whole_file(tmp_path / "none" / "a") as part:
        part.write_text("new")
    with pytest.raises(error), whole_file(tmp_path / "a") as part:
        fail() if part.write_text("half") else None
    assert not list(tmp_path.iterdir())
