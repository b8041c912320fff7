"""Text files whose lines are too long, that unpack to far more than their size, or whose columns would be holes."""

from __future__ import annotations

import gzip
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from armlab import log
from armlab.errors import LogError
from armlab.log.file_formats.delimited import LONGEST, _numbers_only, open_text, rows_in

SOME = 1 << 16


@contextmanager
def memory(most: float) -> Iterator[None]:
    """Check the bytes that are taken at once."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def put(path: Path, text: bytes, packed: bool = False) -> Path:
    path.write_bytes(gzip.compress(text, 6) if packed else text)
    return path


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> int:
    """Lines of at most so many characters."""
    monkeypatch.setattr("armlab.log.file_formats.delimited.LONGEST", 40)
    return 40


@pytest.mark.parametrize("packed", [False, True])
def test_the_fields_and_bytes_of_text_packed_or_not(tmp_path: Path, packed: bool) -> None:
    path = put(tmp_path / "log", b"t;x\r\n0;1\r1;2\n", packed)
    assert list(rows_in(path, ";")) == [["t", "x"], ["0", "1"], ["1", "2"]]
    with open_text(path) as file:
        assert file.read() == b"t;x\r\n0;1\r1;2\n"


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("block", [1, 7, 30])
@pytest.mark.parametrize("digit", [b"1", b"a"])
def test_a_line_is_as_long_as_is_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short: int, packed: bool, block: int, digit: bytes
) -> None:
    monkeypatch.setattr("armlab.log.file_formats.delimited.BLOCK", block)
    path = put(tmp_path / "log", b"t,x\n0,1\n1," + digit * (short - 3) + b"\n2,3\n", packed)
    assert len(log.read_csv(path)) == 3
    put(path, b"t,x\n0,1\n1," + digit * (short - 2) + b"\n2,3\n", packed)
    with pytest.raises(LogError, match=r"Expected at most 40 characters in line 3 of .*log, got more\. End each row"):
        log.read_csv(path)


@pytest.mark.parametrize("head", [b"", b"t,x\n0,1\n1,"])
@pytest.mark.parametrize("packed", [False, True])
def test_a_line_of_megabytes_takes_no_memory(tmp_path: Path, head: bytes, packed: bool) -> None:
    path = put(tmp_path / "log", head + b"1" * (12 * LONGEST), packed)
    with memory(8 * LONGEST), pytest.raises(LogError, match=f"Expected at most {LONGEST} characters in line"):
        log.read_csv(path)


def test_lines_that_end_in_carriage_returns_are_no_long_header(tmp_path: Path) -> None:
    path = put(tmp_path / "log", b"t,x\r" + b"1,a\r" * (3 * LONGEST))
    with memory(8 * LONGEST):
        assert _numbers_only(path, 0, ",") is None


@pytest.mark.parametrize(("digit", "most"), [(b"12", 16.0), (b"ab", 64.0)])
def test_what_unpacks_to_far_more_than_its_size_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, digit: bytes, most: float
) -> None:
    """Numbers are not read once more as words for that, which take more."""
    monkeypatch.setattr("armlab.log.file_formats.delimited._UNPACKED", SOME)
    text = b"x\n" + (digit + b"\n") * SOME
    path = put(tmp_path / "log", text, packed=True)
    with (
        memory(most * SOME),
        pytest.raises(LogError, match=rf"Expected at most {SOME} bytes of text, 200 times its size, .* gunzip"),
    ):
        log.read_csv(path, rate=250.0)
    assert len(log.read_csv(put(path, text), rate=250.0)) == SOME
    monkeypatch.setattr("armlab.log.file_formats.delimited._UNPACKED", len(text))
    assert len(log.read_csv(put(path, text, packed=True), rate=250.0)) == SOME


def test_more_lines_than_bytes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.file_formats.delimited._LINES", 1000)
    path = put(tmp_path / "log", b"x\n" + b"1\n" * 1000, packed=True)
    with pytest.raises(LogError, match=r"and 1000 lines in .*log, got more\. If you trust it"):
        log.read_csv(path, rate=250.0)


def test_an_arm_that_stands_still_is_no_bomb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.file_formats.delimited._UNPACKED", SOME)
    rows = [f"{0.004 * k:.3f}" + ",0.25" * 30 for k in range(2000)]
    text = "\n".join(["t," + ",".join(f"c{k}" for k in range(30)), *rows])
    assert len(text) > 4 * SOME
    assert len(log.read_csv(put(tmp_path / "log", text.encode(), packed=True))) == 2000


def test_one_long_text_among_short_ones_is_refused(tmp_path: Path) -> None:
    """180 kB, of which 7 GiB would be made."""
    path = put(tmp_path / "log", b"t,note\n" + b"0,a\n" * 20_000 + b"1," + b"a" * 100_000 + b"\n")
    with pytest.raises(LogError, match=r"values that are alike, got 20001 rows .* in log: note"):
        log.read_csv(path)


@pytest.mark.parametrize("line", [b"a\n", b"ab\n"])
def test_words_take_a_bounded_multiple_of_the_file(tmp_path: Path, line: bytes) -> None:
    path = put(tmp_path / "log", b"x\n" + b"ab\n" + line * 40_000)
    with memory(45.0 * path.stat().st_size):
        log.read_csv(path, rate=250.0)
