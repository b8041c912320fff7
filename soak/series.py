"""Time series measured in a soak test: processes, recorded ticks, clients."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from armlab import log
from soak.processes import COLUMNS

__all__ = ["Held", "Recorded", "clients", "description", "held", "levels", "recorded"]

_STRETCHES = 200  # segments per run, for the latency of the loop
_SHORTEST = 0.5e9  # ns, minimum segment length


class Held(NamedTuple):
    """Samples of one process: times [s], and (N,) arrays by name: "cpu" [s] and `processes.COLUMNS`."""

    t: np.ndarray
    values: Mapping[str, np.ndarray]


class Recorded(NamedTuple):
    """One recording: per segment, its end [s], percentiles of arrival to reply [s], and the share of missed ticks.

    Attributes
    ----------
    rows : number of readable rows. summary : final statistics of the recording. is_whole : whether it was finished.
    events : event texts. seconds : robot time [s].
    """

    t: np.ndarray
    p50: np.ndarray
    p99: np.ndarray
    missed: np.ndarray
    rows: int
    summary: Mapping[str, Any]
    is_whole: bool
    events: tuple[str, ...]
    seconds: float


def description(folder: Path) -> dict[str, Any]:
    """Return the description of a run, including "begin" and "end" of monitoring [ns]."""
    return json.loads((folder / "description.json").read_text())


def held(folder: Path) -> dict[str, Held]:
    """Return the samples by process."""
    lines = [line.split(",") for line in (folder / "held.csv").read_text().splitlines()]
    head, rows = lines[0], lines[1:]
    found: dict[str, Held] = {}
    for name in dict.fromkeys(row[1] for row in rows):
        mine = np.array([[float(row[0]), *map(float, row[2:])] for row in rows if row[1] == name])
        found[name] = Held(mine[:, 0], dict(zip(head[2:], mine[:, 1:].T, strict=True)))
    return found


def recorded(folder: Path) -> dict[str, Recorded]:
    """Return the recordings by file name without the date."""
    about = description(folder)
    paths = sorted(folder.glob("*.mcap"))
    return {
        re.sub(r"-\d+T\d+Z", " ", path.stem).strip(): _recorded(path, about["begin"], about["end"]) for path in paths
    }


def _recorded(path: Path, begin: int, end: int) -> Recorded:
    about = log.inspect(path)
    table = log.read(path, columns=["receive_ns", "send_ns", "missed", "late"], raw=True)
    came, sent = table["receive_ns"], table["send_ns"]
    missed = table["missed"] + (sent <= 0) + np.nan_to_num(table["late"])
    length = max((end - begin) / _STRETCHES, _SHORTEST)
    edges = begin + length * np.arange(int((end - begin) / length) + 1)
    at = np.searchsorted(came, edges)
    t, p50, p99, share = [], [], [], []
    for first, last, edge in zip(at[:-1], at[1:], edges[1:], strict=True):
        taken = (sent - came)[first:last][sent[first:last] > 0]
        if len(taken):
            t.append(1e-9 * (edge - begin))
            p50.append(1e-9 * np.percentile(taken, 50.0))
            p99.append(1e-9 * np.percentile(taken, 99.0))
            share.append(missed[first:last].sum() / (last - first + table["missed"][first:last].sum()))
    events = tuple(event.text for event in about.events)
    columns = (np.array(one) for one in (t, p50, p99, share))
    return Recorded(*columns, len(table), about.summary, about.finished, events, float(table.t[-1] - table.t[0]))


def clients(folder: Path) -> dict[str, np.ndarray]:
    """Return (N, 4) per client: time [s], messages, and median and longest delay from stamp to receipt [s]."""
    about, found = description(folder), {}
    for name in about.get("clients", ()):
        lines = (folder / f"{name}.out").read_text().splitlines()
        all_of_it = np.array([line.split() for line in lines], dtype=np.int64).reshape(-1, 4)
        came = all_of_it[:, 0]
        mine = all_of_it[(came >= about["begin"]) & (came <= about["end"])]
        t = 1e-9 * (mine[:, 0] - about["begin"])
        found[name] = np.column_stack([t, mine[:, 1], 1e-9 * mine[:, 2], 1e-9 * mine[:, 3]])
    return found


def levels(
    held: Mapping[str, Held], recorded: Mapping[str, Recorded], clients: Mapping[str, np.ndarray]
) -> dict[str, dict[str, Any]]:
    """Return the reported numbers per process, recording and client: medians over the last quarter, and counts."""
    return {
        "robot_seconds": {name: one.seconds for name, one in recorded.items()},
        "held": {
            name: {
                **{key: float(np.median(one.values[key][len(one.t) * 3 // 4 :])) for key in COLUMNS},
                "cpu": float(np.ptp(one.values["cpu"]) / max(np.ptp(one.t), 1e-9)),
            }
            for name, one in held.items()
        },
        "recordings": {
            name: {
                "rows": one.rows,
                "dropped": one.summary.get("dropped"),
                "missed": float(one.missed.mean()) if len(one.missed) else None,
                "p50": float(np.median(one.p50)),
                "p99": float(np.median(one.p99)),
                "summary": dict(one.summary),
                "events": one.events[-100:],
            }
            for name, one in recorded.items()
        },
        "readers": {
            name: {"messages": int(lines[:, 1].sum()), "delay": float(np.median(lines[:, 2]))}
            for name, lines in clients.items()
        },
    }
