"""A file whose descriptor other code closes."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from armlab.log.recording.file import PersistentFile


def close_it(file: PersistentFile, folder: Path) -> int:
    os.close(file.fileno())
    return -1


def replace_it(file: PersistentFile, folder: Path) -> int:
    """Close it and open another file, which gets its number."""
    number = file.fileno()
    os.close(number)
    assert os.open(folder / "other", os.O_CREAT | os.O_WRONLY) == number
    return number


@pytest.mark.parametrize("lose", [close_it, replace_it])
def test_writing_goes_on_at_the_same_place(lose: Callable[[PersistentFile, Path], int], tmp_path: Path) -> None:
    file = PersistentFile(tmp_path / "run")
    file.write(b"0123456789")
    file.seek(2)
    number = lose(file, tmp_path)
    assert file.write(b"ab") == 2
    file.seek(4)
    file.truncate(8)
    os.fsync(file.fileno())
    assert (tmp_path / "run").read_bytes() == b"01ab4567"
    file.close()
    if number >= 0:
        os.close(number)
        assert (tmp_path / "other").read_bytes() == b""


def test_the_file_of_somebody_else_is_neither_written_nor_closed(tmp_path: Path) -> None:
    file = PersistentFile(tmp_path / "run")
    number = replace_it(file, tmp_path)
    file.close()
    os.write(number, b"theirs")
    os.close(number)
    with pytest.raises(OSError, match="Bad file descriptor"):
        file.write(b"x")
    assert (tmp_path / "run").read_bytes() == b""


def test_another_file_of_the_same_name_is_not_written(tmp_path: Path) -> None:
    file = PersistentFile(tmp_path / "run")
    close_it(file, tmp_path)
    (tmp_path / "run").rename(tmp_path / "moved")
    (tmp_path / "run").write_bytes(b"theirs")
    with pytest.raises(FileNotFoundError, match="another file has its name"):
        file.write(b"x")
    assert (tmp_path / "run").read_bytes() == b"theirs"
    with pytest.raises(FileExistsError):
        PersistentFile(tmp_path / "run")
