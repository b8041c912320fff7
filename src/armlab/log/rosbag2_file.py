"""A `Table` in a rosbag2, a folder that the tools of ROS 2 play and show; and the same table out of it."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armlab.errors import ArmlabError, LogError, UnknownName
from armlab.log.column import Column
from armlab.log.description import Description, Progress, of_json
from armlab.log.rosbag2_topics import columns_of, messages_of, topics_of, whole_poses
from armlab.log.table import Table

__all__ = ["STORAGES", "is_ours", "read_rosbag2", "write_rosbag2"]

STORAGES = ("mcap", "sqlite3")
VERSION = 8  # of metadata.yaml: the last in which the quality of service is a text, as releases before Jazzy read it
BLOCK = 10_000  # rows
LAST = 2**31 * 10**9  # ns: a header's stamp holds seconds in 31 bits


def write_rosbag2(
    table: Table, folder: Path, storage: str, progress: Progress, joint_names: Sequence[str] = ()
) -> None:
    """Write a folder with metadata.yaml and one file of messages; all types are standard ones of ROS 2.

    Parameters
    ----------
    table : to write. folder : must not exist. storage : one of `STORAGES`. progress : is told the rows.
    joint_names : in JointState messages; those of the columns' labels by default.

    Raises
    ------
    UnknownName : another storage. LogError : times beyond what ROS holds. OSError : the folder cannot be written.
    """
    import sqlite3

    from rosbags.rosbag2 import StoragePlugin, Writer

    from armlab.log.messages import store

    if storage not in STORAGES:
        raise UnknownName.among("storage", storage, STORAGES)
    stamps, poses = _stamps(table), whole_poses(table)
    topics = topics_of(table.columns, poses)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    try:
        with Writer(folder, version=VERSION, storage_plugin=plugin) as bag:
            bag.set_custom_data("armlab", Description.of(table).json(poses=poses))
            connections = [bag.add_connection(topic.name, topic.type, typestore=store()) for topic in topics]
            for start in range(0, len(table), BLOCK):
                rows = slice(start, start + BLOCK)
                part = table.rows(rows)
                messages = zip(*(messages_of(topic, part, stamps[rows], joint_names) for topic in topics), strict=True)
                for stamp, row in zip(stamps[rows].tolist(), messages, strict=True):
                    for connection, message in zip(connections, row, strict=True):
                        bag.write(connection, stamp, message)
                progress(min(start + BLOCK, len(table)), len(table), "rows")
    except sqlite3.Error as error:
        raise OSError(0, str(error)) from None


def _stamps(table: Table) -> np.ndarray:
    """Return the wall clock of each row [ns], from 0 and increasing, so that the order of rows is that of stamps."""
    if not len(table):
        return np.zeros(0, dtype=np.int64)
    if np.abs(table.t).max() >= LAST / 1e9:
        raise LogError(f"Expected times of at most {LAST / 1e9:.3g} s for a rosbag2, got {np.abs(table.t).max():g} s.")
    stamps = np.round(table.t * 1e9).astype(np.int64)
    order = np.arange(len(stamps))
    stamps = np.maximum.accumulate(stamps - order) + order
    start = max(int(table.t0_ns), -int(stamps[0]))
    if start + int(stamps[-1]) >= LAST:
        raise LogError(
            f"Expected a log before the year 2038 for a rosbag2, whose stamps end there, got t0_ns {table.t0_ns}. "
            "Write another format."
        )
    return stamps + start


def is_ours(folder: Path) -> bool:
    """Tell whether `write_rosbag2` has made a folder: its metadata.yaml holds the description of a table."""
    try:
        return re.search(rb"(?m)^\s+armlab:", (folder / "metadata.yaml").read_bytes()) is not None
    except OSError:
        return False


def read_rosbag2(path: Path) -> Table:
    """Return the table in a rosbag2 that `write_rosbag2` has written.

    Parameters
    ----------
    path : of the folder.

    Raises
    ------
    LogError : a damaged bag, or one of another program; lists its topics.
    """
    from rosbags.rosbag2 import Reader

    try:
        with Reader(path) as bag:
            text = (getattr(bag.storage.metadata, "custom", None) or {}).get("armlab")
            if text is None:
                topics = ", ".join(f"{one.topic} ({one.msgtype})" for one in bag.connections) or "none"
                raise LogError(
                    f"Expected a rosbag2 that armlab has written in {path}, got another one; topics: {topics}."
                )
            return _table(path, bag, text)
    except ArmlabError:
        raise
    except Exception as error:  # rosbags raises its own errors, those of SQLite, YAML, zstd, struct and assertions
        what = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise LogError(f"Expected a whole rosbag2 in {path}, got a damaged one: {what[:200]}.") from None


def _table(path: Path, bag: Any, text: str) -> Table:
    about = of_json(text, path)
    columns = {"t": Column((), "s"), **about.described()}
    topics = topics_of(about.described(), json.loads(text).get("poses", ()))
    raws: dict[str, list[bytes]] = {topic.name: [] for topic in topics}
    for connection, _, raw in bag.messages():
        raws.setdefault(connection.topic, []).append(bytes(raw))
    values: dict[str, np.ndarray] = {}
    for topic in topics:
        if len(raws[topic.name]) != len(raws["/t"]):
            raise LogError(
                f"Expected {len(raws['/t'])} messages on {topic.name} in {path}, as on /t, got {len(raws[topic.name])}."
            )
        values |= columns_of(topic, columns, raws[topic.name])
    return about.table(path, values.pop("t"), {name: values[name] for name in about.columns})
