"""Rows for `bench_recorder`, with random numbers, because they must be incompressible."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from armlab.log import Column, Tick
from armlab.state import Command, State

PERIOD = 0.004  # s
START_NS = 1_700_000_000_000_000_000


def signals() -> dict[str, Column]:
    """Return the user's columns."""
    return {"grip": Column((3,), unit="N")}


def full_rows(count: int, only_signals: bool = False) -> list[tuple[State, Command, Tick]]:
    """Return rows with all columns of a bridge, or with only q, qd, tau, a wrench and user columns.

    `count` is the number of different rows.
    """
    rng, rows = np.random.default_rng(0), []
    for i in range(count):
        q, qd, tau, q_ref, qd_ref, q_sent, qd_sent, planned = rng.normal(size=(8, 7))
        stamp = START_NS + round(i * PERIOD * 1e9)
        common = {"q": q, "qd": qd, "tau": tau, "seq": i, "robot_ns": stamp, "wrench_raw": rng.normal(size=6)}
        record = {"grip": rng.normal(size=3)}
        if only_signals:
            state, command = State(i * PERIOD, PERIOD, **common), Command(record=record)
            rows.append((state, command, Tick(i, i, stamp, stamp, stamp, 10)))
            continue
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R * np.sign(np.linalg.det(R)), rng.normal(size=3)
        state = State(i * PERIOD, PERIOD, **common, q_planned=planned, T_frame_tool=T)
        record |= {"wrench_hat": rng.normal(size=6), "wrench_hat_cov": rng.normal(size=(6, 6))}
        sent = {"q_sent": q_sent, "qd_sent": qd_sent, "clamped": np.zeros(7, dtype=np.uint8)}
        tick = Tick(i, i, stamp, stamp, stamp + 90_000, 500, **sent)
        rows.append((state, Command(q_ref, qd_ref, record=record), tick))
    return rows


def fresh(row: tuple[State, Command, Tick], number: int) -> tuple[State, Command, Tick]:
    """Return a new copy of a row, as if just created by a loop; `number` is its tick."""
    state, command, tick = row
    record = {name: np.array(value) for name, value in command.record.items()}
    arrays = {name: np.array(value) for name, value in tick._asdict().items() if isinstance(value, np.ndarray)}
    return _copied(state), replace(_copied(command), record=record), tick._replace(number=number, **arrays)


def _copied(one: Any) -> Any:
    arrays = {field.name: getattr(one, field.name) for field in fields(one)}
    return replace(one, **{name: value.copy() for name, value in arrays.items() if isinstance(value, np.ndarray)})
