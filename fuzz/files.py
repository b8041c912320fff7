"""Fuzz targets for files: log formats that armlab decodes itself, and secrets in attached settings."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

import numpy as np

from armlab import log, robots
from armlab.errors import ArmlabError
from armlab.log.file_formats.opening import FIRST, format_of
from armlab.log.recording.metadata import redacted

_FOLDER = tempfile.TemporaryDirectory(prefix="armlab-fuzz-")
_RATE = 250.0


def _file(name: str, data: bytes) -> Path:
    path = Path(_FOLDER.name) / name
    path.write_bytes(data)
    return path


def mcap(data: bytes) -> None:
    """MCAP file, possibly truncated; its recovered copy must contain all readable data."""
    path, copy = _file("a.mcap", data), Path(_FOLDER.name) / "b.mcap"
    copy.unlink(missing_ok=True)
    for look in (log.inspect, log.read_topics):
        with contextlib.suppress(ArmlabError):
            look(path)
    try:
        table = log.read(path)
    except ArmlabError:
        table = None
    if format_of(data[:FIRST]) != "MCAP":  # for example a text file, which cannot be recovered
        return
    try:
        log.recover(path, copy)
        again = log.read(copy)
    except ArmlabError:
        assert table is None or not len(table), "recover loses readable rows"
        return
    if table is not None:
        assert table.names == again.names
        assert all(_equal(table[name], again[name]) for name in table.names)


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def text(data: bytes) -> None:
    """Delimited text, ABB research-interface text or tracker text, with its description after NUL.

    Data read from it must survive a round trip as text.
    """
    content, _, beside = data.partition(b"\0\0")
    described = Path(_FOLDER.name) / "a.csv.toml"
    described.unlink(missing_ok=True)
    if beside:
        described.write_bytes(beside)
    path = _file("a.csv", content)
    for read in (log.nikon.read_cloud, log.nikon.read_plane):
        with contextlib.suppress(ArmlabError):
            read(path)
    try:
        table = log.read_csv(path, rate=None if beside else _RATE if b"rate" in content[:64] else None)
    except ArmlabError:
        return
    with contextlib.suppress(ArmlabError):
        log.from_orca(table, robots.load("yumi_left"), 0)
    if not len(table):
        return
    try:
        written = log.write(table, Path(_FOLDER.name) / "b.csv")
    except ArmlabError:
        return
    again = log.read(written)
    assert again.names == table.names
    assert all(_equal(table[name], again[name]) for name in table.names)


def abb(data: bytes) -> None:
    """Text file of test signals, with its map after NUL."""
    content, _, about = data.partition(b"\0\0")
    with contextlib.suppress(ArmlabError):
        log.read_abb(_file("signals.txt", content), _file("map.toml", about))


def bag(data: bytes) -> None:
    """ROS 1 bag, parsed by `rosbags`."""
    path = _file("a.bag", data)
    for read in (log.read, log.read_topics):
        with contextlib.suppress(ArmlabError):
            read(path)


def secrets(data: bytes) -> None:
    """Settings attached to a log."""
    for ending in ("toml", "json", "yaml", "ini"):
        redacted(f"a.{ending}", data)
