"""Pre-run checks of this computer, one function per finding of `armlab doctor`."""

from __future__ import annotations

import gc
import importlib.metadata
import importlib.util
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from armlab.bridge.control.realtime import LOOP_PRIORITY, priority

Verdict = Literal["ok", "warning", "failure"]
"""Verdict of a check; "warning" means usable, but with a risk."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check: its name, the verdict, the observed value, and a remedy if necessary."""

    name: str
    verdict: Verdict
    value: str
    advice: str = ""

    @classmethod
    def judged(cls, name: str, problem: Verdict, is_bad: bool, value: str, advice: str) -> Finding:
        """Return a finding with the verdict `problem` and the advice if `is_bad`, otherwise "ok"."""
        return cls(name, problem, value, advice) if is_bad else cls(name, "ok", value)


_OLDEST = (3, 11)
_CYCLE = 0.004  # s
_LATE = 1e-3  # s: largest acceptable wake-up delay, one cycle at 1 kHz and a quarter of an EGM cycle
_FINE = 1e-6  # s
_LONG = 0.1  # s: a full collection takes longer only if the user has loaded large data
_CONFLICTS = (("viser", "rich", 15), ("viser", "websockets", 17))  # package, dependency, first incompatible version
_SYSTEM = Path("/sys/devices/system/cpu")
_THROTTLE = Path("/proc/sys/kernel/sched_rt_runtime_us")
_ROS_SETTINGS = ("RMW_IMPLEMENTATION", "CYCLONEDDS_URI", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY")


def machine(seconds: float = 2.0) -> list[Finding]:
    return [
        python(),
        packages(),
        ros_on_path(os.environ, sys.path),
        ros_nodes(os.environ),
        clock(),
        real_time(),
        throttle(),
        governor(),
        wake_up(seconds),
        garbage(),
        blas(),
        other_programs(),
    ]


def python(version: tuple[int, ...] = sys.version_info[:3]) -> Finding:
    """Check the Python version and report the armlab version."""
    from armlab import __version__

    value = f"{'.'.join(map(str, version))} ({sys.executable}), armlab {__version__}"
    return Finding.judged("Python", "failure", version[:2] < _OLDEST, value, "Install Python 3.11 or newer.")


def packages(version: Callable[[str], str] = importlib.metadata.version) -> Finding:
    """Check for missing and incompatible packages."""
    found: dict[str, str] = {}
    missing: list[str] = []
    for name in _required():
        try:
            found[name] = version(name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    value = ", ".join(f"{name} {number}" for name, number in found.items())
    if missing:
        return Finding("packages", "failure", f"missing: {', '.join(missing)}", f"pip install {' '.join(missing)}")
    for package, dependency, limit in _CONFLICTS:
        with suppress(importlib.metadata.PackageNotFoundError):
            version(package)
            number = version(dependency)
            if int(number.partition(".")[0]) >= limit:
                advice = f"pip install '{dependency}<{limit}': {package} does not work with {dependency} {number}."
                return Finding("packages", "warning", value, advice)
    return Finding("packages", "ok", value)


def _required() -> list[str]:
    """Return the names of required packages, without extras."""
    lines = importlib.metadata.requires("armlab") or []
    return [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in lines if "extra ==" not in line]


def ros_on_path(environment: Mapping[str, str], path: Iterable[str]) -> Finding:
    """Check that no ROS installation shadows the NumPy and protobuf of this environment."""
    where = [name for name in ("PYTHONPATH", "LD_LIBRARY_PATH") if "/opt/ros" in environment.get(name, "")]
    where += ["sys.path"] if any("/opt/ros" in entry for entry in path) else []
    value = f"/opt/ros on {', '.join(where)}" if where else "not on the path"
    advice = "Use a terminal without a sourced setup.bash, or: env -u PYTHONPATH -u LD_LIBRARY_PATH armlab ..."
    return Finding.judged("ROS", "warning", bool(where), value, advice)


def ros_nodes(environment: Mapping[str, str]) -> Finding:
    """Check that local ROS 2 nodes and the bridge can discover each other."""
    settings = [f"{name}={environment[name][:80]}" for name in _ROS_SETTINGS if environment.get(name)]
    domain = environment.get("ROS_DOMAIN_ID") or "0"
    value = f"domain {domain}, nodes: {', '.join(settings) or 'no settings'}; bridge: 127.0.0.1, no multicast"
    cyclone = environment.get("RMW_IMPLEMENTATION") == "rmw_cyclonedds_cpp"
    finds = environment.get("CYCLONEDDS_URI") or environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE") == "LOCALHOST"
    advice = "Cyclone DDS discovers nodes only by multicast: start nodes with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST."
    return Finding.judged("ROS 2", "warning", cyclone and not finds, value, advice)


def clock(resolution: float = time.get_clock_info("monotonic").resolution) -> Finding:
    value = f"{1e9 * resolution:.0f} ns"
    return Finding.judged(
        "clock", "warning", resolution > _FINE, value, "Use a Linux kernel with high-resolution timers."
    )


def real_time() -> Finding:
    """Check whether the loop may run under SCHED_FIFO."""
    with priority(LOOP_PRIORITY) as permitted:
        pass
    advice = (
        "Add the line `@realtime - rtprio 60` to /etc/security/limits.d/realtime.conf, add yourself to the group "
        "realtime, and log in again; in a container: --cap-add SYS_NICE."
    )
    value = "SCHED_FIFO is permitted" if permitted else "SCHED_FIFO is not permitted: normal priority"
    return Finding.judged("real-time priority", "warning", not permitted, value, advice)


def throttle(file: Path = _THROTTLE) -> Finding:
    """Report the CPU share of real-time threads."""
    try:
        with file.open(encoding="ascii") as opened:
            runtime = int(opened.read())
    except (OSError, ValueError):
        return Finding("real-time throttle", "ok", "unknown, not reported by this kernel")
    value = "off" if runtime < 0 else f"{1e-4 * runtime:.0f} % of the time"
    advice = "Real-time threads get no CPU time. Set sysctl kernel.sched_rt_runtime_us=950000"
    return Finding.judged("real-time throttle", "warning", runtime == 0, value, advice)


def governor(folder: Path = _SYSTEM) -> Finding:
    """Check whether the CPUs keep their clock frequency between packets."""
    kinds: set[str] = set()
    for file in folder.glob("cpu[0-9]*/cpufreq/scaling_governor"):
        with suppress(OSError), file.open(encoding="ascii") as opened:
            kinds.add(opened.read().strip())
    value = ", ".join(sorted(kinds)) or "unknown, not reported by this kernel"
    slow = bool(kinds - {"performance"})
    return Finding.judged("CPU governor", "warning", slow, value, "sudo cpupower frequency-set -g performance")


def wake_up(
    seconds: float = 2.0, sleep: Callable[[float], None] = time.sleep, now: Callable[[], float] = time.monotonic
) -> Finding:
    """Measure the delay of periodic wake-ups at the priority of the control loop."""
    late: list[float] = []
    with priority(LOOP_PRIORITY):
        due = now()
        end = due + seconds
        while due < end:
            due += _CYCLE
            sleep(max(due - now(), 0.0))
            late.append(now() - due)
            due = max(due, now() - _CYCLE)  # skip the cycles missed in a long stall
    if not late:
        return Finding("wake-up", "ok", "not measured")
    p50, p99, worst = np.percentile(late, [50, 99, 100])
    value = f"late by {1e6 * p50:.0f} us (p50), {1e6 * p99:.0f} us (p99), {1e6 * worst:.0f} us (max of {len(late)})"
    advice = (
        "Close other programs; see the findings real-time priority "
        "and CPU governor. On a virtual machine, expect late replies."
    )
    return Finding.judged("wake-up", "warning", bool(p99 > _LATE), value, advice)


def garbage(collect: Callable[[], object] = gc.collect) -> Finding:
    """Measure the duration of a full garbage collection; a run collects only objects created during the run."""
    objects = len(gc.get_objects())
    start = time.perf_counter()
    collect()
    cost = time.perf_counter() - start
    value = f"{objects} objects, {1e3 * cost:.1f} ms for a full collection"
    advice = (
        "Load large data before the run, not in the controller: "
        "a garbage collection during the run takes several cycles."
    )
    return Finding.judged("garbage", "warning", cost > _LONG, value, advice)


def blas() -> Finding:
    """Report the number of BLAS threads; controller results are bit-for-bit reproducible only with one thread."""
    from threadpoolctl import threadpool_info

    pools = [f"{pool['internal_api']} {pool['num_threads']}" for pool in threadpool_info()]
    return Finding("BLAS threads", "ok", ", ".join(pools) or "no BLAS is loaded")


def other_programs(which: Callable[[str], str | None] = shutil.which) -> Finding:
    """Report optional programs used by other parts of armlab; a run does not need them."""
    browser = next((name for name in ("chromium", "chromium-browser", "google-chrome") if which(name)), "no Chromium")
    zenoh = "Zenoh" if importlib.util.find_spec("zenoh") else "no Zenoh"
    return Finding("other programs", "ok", f"{browser}, {zenoh}")
