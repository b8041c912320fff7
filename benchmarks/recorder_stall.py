"""Run of `bench_recorder` over a simulated link in which the disk may stall temporarily."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from armlab import bridge, log, robots
from armlab.log.recording import file as recording_file

BEFORE, AFTER = 3.0, 3.0  # s


@dataclass(frozen=True)
class Stall:
    """Counts of a run: packets, missed and late packets; rows written, dropped, and reported as dropped by events.

    `latencies`: time [s] from arrival to reply of each packet in the middle of the run.
    """

    packets: int
    missed: int
    late: int
    written: int
    dropped: int
    told: int
    latencies: np.ndarray


class Disk:
    """File on a disk that stalls between two times of the monotonic clock."""

    def __init__(self, file: BinaryIO, still: list[float]) -> None:
        self._file, self._still = file, still

    def _wait(self) -> None:
        start, stop = self._still
        if start < (now := time.monotonic()) < stop:
            time.sleep(stop - now)

    def write(self, data: bytes) -> int:
        """Write once the disk responds."""
        self._wait()
        return self._file.write(data)

    def __getattr__(self, name: str) -> object:
        return getattr(self._file, name)


class Watch:
    """Feed that stores the stamps of every tick."""

    def __init__(self) -> None:
        self.stamps: list[tuple[int, int, int]] = []

    def row(self, state: object, command: object, tick: log.Tick) -> None:
        """Store the stamps of a row."""
        self.stamps.append((tick.stamp_ns, tick.receive_ns, tick.send_ns))

    def event(self, text: str, warn: bool = False) -> None:
        """Ignore events, which are in the file."""


def stalled(folder: Path, robot: str, seconds: float, stands: bool) -> Stall:
    """Return the counts of a run whose disk, if requested, stalls for some seconds in mid-run."""
    folder.mkdir()
    real, still, watch = recording_file.open_new, [0.0, 0.0], Watch()

    def opened(path: str | Path) -> tuple[BinaryIO, Path]:
        file, path = real(path)
        return Disk(file, still), path  # type: ignore[return-value]

    recording_file.open_new = opened
    try:
        with bridge.connect(f"sim://{robot}", robots.load(robot), patience=20.0) as link:
            if stands:
                still[:] = time.monotonic() + BEFORE, time.monotonic() + BEFORE + seconds
            run = link.run(lambda state: None, BEFORE + seconds + AFTER, record=folder / "run.mcap", feeds=[watch])
    finally:
        recording_file.open_new = real
    held = log.inspect(folder / "run.mcap")
    told = [re.match(r"(\d+) rows dropped, ticks ", event.text) for event in held.events]
    stamp, came, sent = np.array(watch.stamps).T
    after = 1e-9 * (stamp - stamp[0])
    middle = (after > BEFORE) & (after < BEFORE + seconds) & (sent > 0)
    return Stall(
        packets=len(stamp),
        missed=run.statistics["missed"],
        late=run.statistics["late"],
        written=len(log.read(folder / "run.mcap", raw=True)),
        dropped=held.summary["dropped"],
        told=sum(int(match[1]) for match in told if match),
        latencies=1e-9 * (sent - came)[middle],
    )
