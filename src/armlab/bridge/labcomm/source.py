"""`LabCommSource`: numbers that a LabComm server sends, as a source beside the arms."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from armlab.bridge.labcomm.client import LabCommClient
from armlab.bridge.sources import Reading, ThreadSource, whole
from armlab.errors import ArmlabError, LinkError
from armlab.log import Column
from armlab.wire.labcomm import Sample

__all__ = ["LabCommSource"]

_AGAIN = 0.5  # s between two tries to connect
_LOOK = 0.1  # s
_STAMPS = {"t_us": 1000, "tm": 10**6}  # ns of one unit


class LabCommSource(ThreadSource):
    """The newest value of one sample type, received in a thread of its own; it connects again by itself.

    The type need not be known: the stream defines it. A field ``t_us`` or ``tm`` of the sample is its clock.

    Parameters
    ----------
    name, fields, period, options : see `Source`; fields of the sample by name, or one field for a sample that is no
        struct. Other fields of the sample are left out.
    host, port : of the server. sample : name of the sample; None takes every sample that has the fields.
    dialect : of what is sent, which is only the announcement.
    """

    def __init__(
        self,
        name: str,
        fields: Mapping[str, Column],
        period: float,
        port: int,
        host: str = "127.0.0.1",
        sample: str | None = None,
        dialect: str = "2014v1",
        **options: Any,
    ) -> None:
        super().__init__(name, fields, period, **options)
        self.host, self.port, self._sample, self._dialect = host, port, sample, dialect

    def work(self) -> None:
        """Connect and read, again and again."""
        while not self._over.is_set():
            try:
                with LabCommClient(self.host, self.port, self._dialect, patience=_AGAIN) as client:
                    while not self._over.is_set():
                        for event in client.events(_LOOK):
                            if isinstance(event, Sample):
                                self._take(event)
            except LinkError as error:
                self.problem = str(error)
                self._over.wait(_AGAIN)

    def _take(self, sample: Sample) -> None:
        if self._sample not in (None, sample.name):
            return
        value = sample.value if isinstance(sample.value, dict) else {next(iter(self.fields)): sample.value}
        given = {name: value[name] for name in self.fields if name in value}
        if len(given) < len(self.fields):
            if self._sample is not None:
                missing = ", ".join(name for name in self.fields if name not in given)
                self.problem = f"Expected {missing} in the sample {sample.name}, got {', '.join(value)}."
            return
        last = self._newest
        try:
            stamp_ns = next((whole(value[name], unit) for name, unit in _STAMPS.items() if name in value), 0)
            values = self.values(given)
        except (ArmlabError, ValueError) as error:
            self.problem = str(error)
            return
        self._newest = Reading(values, stamp_ns, time.monotonic_ns(), 0 if last is None else last.seq + 1)
