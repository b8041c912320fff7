"""Descriptors that other code closes."""

from __future__ import annotations

import os
from pathlib import Path

from armlab._descriptors import Descriptor, apart


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
