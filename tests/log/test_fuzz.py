"""Cut and damaged files give a table or one sentence, never another exception."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError
from armlab.log import inspect, read, recover
from armlab.log.mcap.records import MAGIC, records


@pytest.fixture
def data(recording: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> bytes:
    monkeypatch.setattr("armlab.log.recording.file.MAX_CHUNK_ROWS", 8)
    return recording(30, name="whole.mcap").read_bytes()


def check_sentence(error: LogError, path: Path) -> None:
    assert str(error).endswith(".")
    assert str(path) in str(error)


def attempt(path: Path, data: bytes, whole: dict[int, np.ndarray]) -> int | None:
    """Read, inspect and repair the bytes; return the number of rows, None when they were refused."""
    path.write_bytes(data)
    repaired = path.with_name("repaired.mcap")
    repaired.unlink(missing_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for look in (inspect, lambda p: recover(p, repaired)):
            try:
                look(path)
            except LogError as error:
                check_sentence(error, path)
        try:
            table = read(path)
        except LogError as error:
            check_sentence(error, path)
            return None
    for seq, q in zip(table["seq"].tolist(), table["q"], strict=True) if len(table) else ():
        assert np.array_equal(whole[seq], q)  # what is read is what was written
    return len(table)


def reference(path: Path, data: bytes) -> dict[int, np.ndarray]:
    path.write_bytes(data)
    table = read(path)
    return dict(zip(table["seq"].tolist(), table["q"], strict=True))


def borders(data: bytes) -> Iterator[int]:
    for _, start, stop in records(memoryview(data), len(MAGIC), len(data)):
        yield from (start - 9, start, stop)


def cuts(data: bytes, tmp_path: Path, number: int, every: int) -> None:
    whole = reference(tmp_path / "whole.mcap", data)
    places = sorted({place + d for place in borders(data) for d in (-1, 0, 1) if 0 <= place + d <= len(data)})[::every]
    places += np.random.default_rng(3).integers(0, len(data), number).tolist()
    found = {place: attempt(tmp_path / "cut.mcap", data[:place], whole) for place in places}
    rows = [found[place] or 0 for place in sorted(found)]
    assert rows == sorted(rows)  # more bytes never give fewer rows
    assert max(rows) >= 24


def flips(data: bytes, tmp_path: Path, number: int) -> None:
    whole = reference(tmp_path / "whole.mcap", data)
    rng = np.random.default_rng(4)
    rows = []
    for place, value in zip(rng.integers(0, len(data), number), rng.integers(1, 256, number), strict=True):
        damaged = bytearray(data)
        damaged[place] ^= value
        rows.append(attempt(tmp_path / "flip.mcap", bytes(damaged), whole))
    read_at_all = [count for count in rows if count]
    assert len(read_at_all) > 0.8 * number
    assert np.median(read_at_all) >= 22


def test_cut_files(data: bytes, tmp_path: Path) -> None:
    cuts(data, tmp_path, number=60, every=7)


def test_flipped_bytes(data: bytes, tmp_path: Path) -> None:
    flips(data, tmp_path, number=120)


@pytest.mark.slow
def test_files_cut_at_every_border_and_at_2000_places(data: bytes, tmp_path: Path) -> None:
    cuts(data, tmp_path, number=2000, every=1)


@pytest.mark.slow
def test_1000_flipped_bytes(data: bytes, tmp_path: Path) -> None:
    flips(data, tmp_path, number=1000)


def test_noise_after_the_magic_bytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for _ in range(40):
        noise = MAGIC + rng.integers(0, 256, int(rng.integers(0, 400)), dtype=np.uint8).tobytes()
        assert attempt(tmp_path / "noise.mcap", noise, {}) is None
