"""Logs: `Table`, the recorder that survives kill -9, and the readers."""

from __future__ import annotations

from armlab.log.column import Column
from armlab.log.growing import Log, Tail
from armlab.log.reading import read
from armlab.log.recorder import Recorder
from armlab.log.rows import Tick
from armlab.log.table import Table

__all__ = ["Column", "Log", "Recorder", "Table", "Tail", "Tick", "read"]
