"""Files that are complete or absent, also when the disk is full; descriptors that other code closes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from armlab._files import Descriptor, apart, whole_file


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


def opened(path: Path) -> int:
    return os.open(path, os.O_CREAT | os.O_WRONLY)


def test_a_number_that_belongs_to_another_file_is_neither_open_nor_closed(tmp_path: Path) -> None:
    descriptor = Descriptor(opened(tmp_path / "a"))
    assert descriptor.is_open
    os.close(descriptor.number)
    assert not descriptor.is_open
    assert opened(tmp_path / "b") == descriptor.number
    assert not descriptor.is_open
    assert not descriptor.same_file(descriptor.number)
    again = opened(tmp_path / "a")
    assert descriptor.same_file(again)
    descriptor.close()
    os.close(descriptor.number)
    os.close(again)


def test_close(tmp_path: Path) -> None:
    descriptor = Descriptor(opened(tmp_path / "a"))
    for _ in range(2):
        descriptor.close()
    assert not descriptor.is_open
    assert opened(tmp_path / "a") == descriptor.number
    assert not descriptor.is_open, "it was closed, whoever opens the file again"
    os.close(descriptor.number)
    assert not Descriptor(-1).is_open


def test_a_descriptor_that_was_opened_again_takes_no_number_that_others_may_use(tmp_path: Path) -> None:
    number = opened(tmp_path / "a")
    before = Descriptor(number)
    moved = apart(number)
    assert moved >= 512
    assert before.same_file(moved)
    assert not before.is_open
    assert not os.get_inheritable(moved)
    os.close(moved)
