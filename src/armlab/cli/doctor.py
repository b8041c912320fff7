"""``armlab doctor``: check the computer, the network and the robot before a run. Sends nothing to a robot."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from armlab.cli.support.options import Json, known_ports, load_robot, ports_in
from armlab.cli.support.output import note, print_findings
from armlab.errors import ConfigError, LinkError

if TYPE_CHECKING:
    from armlab.bridge.doctor.machine import Finding

_ROW_BYTES = 600  # compressed bytes per recorded packet of seven joints with torques
_PACKETS = 250 * 3600  # packets per hour
_LEAST_HOURS = 1.0
_LEAST_SPEED = 5e6  # bytes/s, ten times the data rate of two arms
_BLOCK = bytes(1 << 20)
_LONGEST_SYNC = 0.5  # s; the recorder syncs every 0.8 s


def doctor(
    *robot: str,
    port: str | None = None,
    seconds: float = 5.0,
    rws: str | None = None,
    insecure: Annotated[bool, Parameter(help="Accept any TLS certificate from the controller.")] = False,
    ca: Path | None = None,
    json: Json = False,
) -> int:
    """Check the computer, the network and the robot; print the verdict, finding and advice of each check.

    Listens on the ports and sends nothing to a robot. Exit codes: 0 success, 3 warnings, 1 failures.

    Parameters:
        robot: Robot expected at each port (library name or robot file); its axes and posture are checked.
        port: UDP ports, separated by commas; default: 6510, 6511 and 6512, or the ports of `armlab record` for these
            robots.
        seconds: Listening time [s].
        rws: Address of the ABB controller. With this option, the command also reports why EGM is not running, like
            armlab abb status.
        ca: Certificate file of the controller or its certificate authority.
    """
    from armlab.bridge.doctor.report import LONGEST, examine

    arms = [load_robot(name) for name in robot]
    ports = ports_in(port) if port is not None else known_ports(arms) if arms else None
    if not 0.0 < seconds <= LONGEST:
        raise ConfigError(f"Expected --seconds above 0 and at most {LONGEST:g}, got {seconds:g}.")
    note(f"Listening for {seconds:g} s; nothing is sent to a robot.")
    findings = [*examine(ports, seconds, arms), disk(Path.cwd())]
    if rws is not None:
        findings += _controller(rws, ports, insecure, ca)
    return print_findings(findings, json)


def _controller(host: str, ports: Sequence[int] | None, insecure: bool, ca: Path | None) -> list[Finding]:
    """Return findings on the controller and on the tasks that send to these ports, or on all tasks if no task does."""
    from armlab.bridge.doctor.controller import controller_findings, known_tasks, port_findings, senders
    from armlab.bridge.doctor.machine import Finding
    from armlab.cli.abb import connected

    try:
        with connected(host, insecure, ca) as controller:
            found = controller.status(texts=True)
            tasks = [task for port, task in senders(found).items() if port in (ports or ())] or known_tasks(found)
            return [*controller_findings(found, tasks), *port_findings(found, ports or ())]
    except LinkError as error:
        return [Finding("controller", "failure", f"{host} cannot be used", str(error))]


def disk(folder: Path) -> Finding:
    """Measure the write speed and sync time of the log disk, and its free space in hours of recording."""
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
        return Finding("disk", "failure", f"cannot write to {folder} ({error.strerror})", "Choose another folder.")
    hours = shutil.disk_usage(folder).free / (_ROW_BYTES * _PACKETS)
    value = f"{1e-6 * speed:.0f} MB/s, sync {1e3 * max(syncs):.1f} ms at most, space for {hours:.0f} h of one arm"
    bad = hours < _LEAST_HOURS or speed < _LEAST_SPEED or max(syncs) > _LONGEST_SYNC
    advice = "Record to a local disk with enough space: rows that cannot be written in time are counted as lost."
    return Finding.judged("disk", "warning", bad, value, advice)
