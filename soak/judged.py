"""Assessment of a soak test from the files in its folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from soak import series, verdict
from soak.verdict import Finding

__all__ = ["judged"]

_SHORT = 0.02  # share of the requested duration that may be missing, and of the actual duration without samples
_STILL = 10.0  # s before the end within which every client must still receive messages
_PERIOD = 0.004032  # s between two packets of an arm
_KEPT_UP = 5.0  # % of packets that a simulator may skip; above it, the run was not in real time


def judged(
    about: Mapping[str, Any],
    held: Mapping[str, series.Held],
    recorded: Mapping[str, series.Recorded],
    clients: Mapping[str, np.ndarray],
) -> list[Finding]:
    """Return a finding for each quantity.

    Parameters
    ----------
    about, held, recorded, clients : see `series`.
    """
    return [
        *_length(about, recorded),
        *_processes(about, held),
        *_recordings(recorded),
        *_clients(about, clients),
        *(
            Finding(f"{name}: status", "", float(status not in (0, 130)), 0.0)
            for name, status in about["statuses"].items()
        ),
    ]


def _watched(about: Mapping[str, Any]) -> float:
    return 1e-9 * (about.get("end", 0) - about.get("begin", 0))


def _length(about: Mapping[str, Any], recorded: Mapping[str, series.Recorded]) -> Iterator[Finding]:
    """Assess the duration; in lockstep, it is robot time."""
    robot = max((one.seconds for one in recorded.values()), default=0.0)
    reached = robot if about.get("part") == "lockstep" else _watched(about)
    short = 1.0 - reached / about.get("seconds", np.nan)
    yield Finding("duration, shorter than requested by", " %", 100.0 * short, 100.0 * _SHORT)
    by = about.get("cut_off", "")
    yield Finding(f"cut off by {by}" if by else "cut off", "", float(by != ""), 0.0)


def _processes(about: Mapping[str, Any], held: Mapping[str, series.Held]) -> Iterator[Finding]:
    wanted = ["loop and recorder", "simulator", *(f"server {name}" for name in about.get("servers", ()))]
    for name in dict.fromkeys([*wanted, *held]):
        if name not in held:
            yield verdict.equal(f"{name}: processes", 0, 1)
            continue
        t, values = held[name]
        length = _watched(about)
        yield Finding(f"{name}: last sample, before the end", " s", length - t[-1], _SHORT * length)
        yield verdict.memory(name, t, values["memory"])
        yield verdict.count(f"{name}: descriptors", values["descriptors"])
        yield verdict.count(f"{name}: threads", values["threads"])
        yield verdict.equal(f"{name}: restarts", int(np.sum(np.diff(values["cpu"]) < 0.0)), 0)


def _recordings(recorded: Mapping[str, series.Recorded]) -> Iterator[Finding]:
    for name, one in recorded.items():
        yield verdict.delay(f"{name}: arrival to reply, median", one.p50)
        yield verdict.delay(f"{name}: arrival to reply, 99 %", one.p99)
        if name.startswith("run"):  # excludes the recordings of a commanding client
            share = one.summary.get("packets", np.nan) * _PERIOD / one.summary.get("seconds", np.nan)
            yield Finding(f"{name}: packets skipped of {1 / _PERIOD:.0f} per second", " %", 100 * (1 - share), _KEPT_UP)
        yield verdict.equal(f"{name}: readable rows, of packets", one.rows, one.summary.get("packets", np.nan))
        yield verdict.equal(f"{name}: recordings finished", int(one.is_whole), 1)
        yield verdict.equal(f"{name}: rows dropped", one.summary.get("dropped", np.nan), 0)
        ended = [
            text for text in one.events if "The server restarts in" in text or "The server is not restarted" in text
        ]
        yield verdict.equal(f"{name}: servers that exited", len(ended), 0)


def _clients(about: Mapping[str, Any], clients: Mapping[str, np.ndarray]) -> Iterator[Finding]:
    for name, lines in clients.items():
        yield verdict.delay(f"{name}: stamp to receipt, median", lines[:, 2])
        last = lines[-1, 0] if len(lines) else -np.inf
        yield Finding(f"{name}: without messages at the end", " s", _watched(about) - last, _STILL)
