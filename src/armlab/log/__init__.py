"""Logs: `Table`, a crash-safe recorder, and readers for many formats."""

from __future__ import annotations

from armlab.log import nikon
from armlab.log.column import Column
from armlab.log.file_formats.abb import from_orca, read_abb
from armlab.log.file_formats.delimited import read_csv
from armlab.log.file_formats.labcomm import read_labcomm
from armlab.log.file_formats.mat import read_mat
from armlab.log.mcap.recovery import recover
from armlab.log.reading import read, read_arm
from armlab.log.recording.metadata import inspect
from armlab.log.recording.recorder import Log, Recorder, Tail
from armlab.log.recording.rows import Tick
from armlab.log.recording.splice import cut, merge
from armlab.log.table import Table, concat
from armlab.log.topics.reader import read_topics
from armlab.log.writing import write

__all__ = [
    "Column", "Log", "Recorder", "Table", "Tail", "Tick", "concat", "cut", "from_orca", "inspect", "merge", "nikon",
    "read", "read_abb", "read_arm", "read_csv", "read_labcomm", "read_mat", "read_topics", "recover", "write",
]  # fmt: skip
