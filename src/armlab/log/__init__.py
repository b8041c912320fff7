"""Logs: `Table`, the recorder that survives kill -9, and the readers."""

from __future__ import annotations

from armlab.log import nikon
from armlab.log.abb import read_abb
from armlab.log.arm_log import read_arm
from armlab.log.column import Column
from armlab.log.delimited import read_csv
from armlab.log.growing import Log, Tail
from armlab.log.inspection import inspect
from armlab.log.labcomm import read_labcomm
from armlab.log.mat_file import read_mat
from armlab.log.orca import from_orca
from armlab.log.reading import read
from armlab.log.recorder import Recorder
from armlab.log.recovery import recover
from armlab.log.resample import concat
from armlab.log.rows import Tick
from armlab.log.splicing import cut, merge
from armlab.log.table import Table
from armlab.log.topic_reading import read_topics
from armlab.log.writing import write

__all__ = [
    "Column",
    "Log",
    "Recorder",
    "Table",
    "Tail",
    "Tick",
    "concat",
    "cut",
    "from_orca",
    "inspect",
    "merge",
    "nikon",
    "read",
    "read_abb",
    "read_arm",
    "read_csv",
    "read_labcomm",
    "read_mat",
    "read_topics",
    "recover",
    "write",
]
