"""``armlab doctor``: check computer, network and robot before a run. Sends nothing to a robot."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import armlab
from armlab.cli import DOUBTFUL, FAILED
from armlab.cli.support.options import Json, known_ports, ports_in
from armlab.cli.support.output import note, print_json, result
from armlab.errors import ConfigError

if TYPE_CHECKING:
    from armlab.bridge.doctor.machine import Finding

_ROW_BYTES = 600  # of a recording per packet of seven joints with torques, compressed, rounded up
_PACKETS = 250 * 3600  # per hour
_LEAST_HOURS = 1.0
_LEAST_SPEED = 5e6  # bytes per second: ten times what two arms write
_BLOCK = bytes(1 << 20)
_LONGEST_SYNC = 0.5  # s: the recorder syncs every 0.8 s


def doctor(*robot: str, port: str | None = None, seconds: float = 5.0, json: Json = False) -> int:
    """Check computer, network and robot, one line each: verdict, what was found, what to do.

    Listens on the ports and sends nothing to a robot. Exit codes: 0 all is well, 3 warnings, 1 failures.

    Parameters:
        robot: What is expected at each port: names in the library, or robot files, to compare axes and posture with.
        port: UDP ports, separated by commas; 6510, 6511 and 6512 when not given, or as `armlab record` for these
            robots.
        seconds: How long to listen.
    """
    from armlab.bridge.doctor.report import LONGEST, examine

    arms = [armlab.robots.load(name) for name in robot]
    ports = ports_in(port) if port is not None else known_ports(arms) if arms else None
    if not 0.0 < seconds <= LONGEST:
        raise ConfigError(f"Expected --seconds above 0 and at most {LONGEST:g}, got {seconds:g}.")
    note(f"Listening for {seconds:g} s; nothing is sent to a robot.")
    findings = [*examine(ports, seconds, arms), disk(Path.cwd())]
    if json:
        print_json([asdict(finding) for finding in findings])
    else:
        result("\n".join(_lines(findings)))
    verdicts = {finding.verdict for finding in findings}
    return FAILED if "failure" in verdicts else DOUBTFUL if "warning" in verdicts else 0


def disk(folder: Path) -> Finding:
    """Measure the disk on which a log would be written: speed, how long a sync takes, hours of room."""
    from armlab.bridge.doctor.machine import Finding

    syncs: list[float] = []
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            start = time.perf_counter()
            for _ in range(20):
                file.write(_BLOCK)
                file.flush()
                before = time.perf_counter()
                os.fsync(file.fileno())
                syncs.append(time.perf_counter() - before)
            speed = 20 * len(_BLOCK) / (time.perf_counter() - start)
    except OSError as error:
        return Finding("disk", "failure", f"{folder} cannot be written ({error.strerror})", "Choose another folder.")
    hours = shutil.disk_usage(folder).free / (_ROW_BYTES * _PACKETS)
    value = f"{1e-6 * speed:.0f} MB/s, sync {1e3 * max(syncs):.1f} ms at most, room for {hours:.0f} h of one arm"
    bad = hours < _LEAST_HOURS or speed < _LEAST_SPEED or max(syncs) > _LONGEST_SYNC
    advice = "Record to a local disk with room: rows that cannot be written in time are lost, and counted."
    return Finding.judged("disk", "warning", bad, value, advice)


def _lines(findings: list[Finding]) -> list[str]:
    width = max(len(finding.name) for finding in findings)
    lines: list[str] = []
    for finding in findings:
        lines.append(f"{finding.verdict:7}  {finding.name:{width}}  {finding.value}")
        if finding.advice:
            lines.append(f"{'':7}  {'':{width}}  -> {finding.advice}")
    counts = [f"{sum(f.verdict == verdict for f in findings)} {verdict}" for verdict in ("ok", "warning", "failure")]
    return [*lines, ", ".join(counts)]
