"""What must hold in every run, whatever failed: what was sent is within the limits, and the log is what was sent."""

from __future__ import annotations

import numpy as np

from armlab.bridge.control.feedback import READY_AFTER
from armlab.bridge.control.limits import Limits
from armlab.log import Table
from armlab.wire.egm import EgmCodec, Reference

from .bench import PERIOD, ROBOT, Bench, Outcome

__all__ = ["judge", "log_is_what_was_sent", "met_in_motion", "within_limits"]

LIMITS = Limits.of(ROBOT)
GAP = 3 * PERIOD  # s that a reference may move on at most at full speed, however long nothing was sent
SLACK = 1e-9  # of degrees on the wire


def judge(bench: Bench, outcome: Outcome, since: int = 0, ahead: float = 0.0) -> None:
    """Judge a run that sent the replies of the bench from number `since` on; `ahead` as in `within_limits`."""
    within_limits(bench, since, ahead)
    log_is_what_was_sent(bench, outcome.table, since)
    for station in bench.stations:
        q, qd = (np.array(values) for values in zip(*station.motion))
        assert ((q >= ROBOT.q_min) & (q <= ROBOT.q_max)).all(), "the arm left its limits"
        assert (np.abs(qd) <= ROBOT.qd_max).all(), "the arm was too fast"


def met_in_motion(bench: Bench, at: float) -> None:
    """What was sent last before a time had a speed."""
    before = [reply.qd for reply, sent in zip(bench.heard(), bench.sent, strict=True) if sent.t <= at]
    assert before[-1].any(), "the arm was at rest before anything failed"


def within_limits(bench: Bench, since: int = 0, ahead: float = 0.0) -> None:
    """Every reply is within the limits for the robot time since the one before, and a gap allows no larger step.

    Parameters
    ----------
    since : first reply. ahead : time by which a clock of the robot may be believed beyond arrivals [s].
    """
    answered: set[tuple[int, int]] = set()
    before: tuple[np.ndarray, np.ndarray, float] | None = None
    echoes = READY_AFTER
    stations = {source: station for station in bench.stations for source in station.sources}
    for reply, sent in zip(bench.heard()[since:], bench.sent[since:], strict=True):
        assert reply.q is not None
        assert reply.qd is not None
        assert reply.tm_ms is not None
        assert np.isfinite([reply.q, reply.qd]).all()
        assert ((reply.q >= LIMITS.q_min - SLACK) & (reply.q <= LIMITS.q_max + SLACK)).all()
        feedback, guides, now = stations[sent.to].packets[reply.tm_ms]
        assert (sent.to[1], reply.tm_ms) not in answered, "two replies to one packet"
        answered.add((sent.to[1], reply.tm_ms))
        if not guides:
            assert np.abs(reply.q - feedback).max() < SLACK, "before guidance, feedback goes back"
            assert not reply.qd.any()
            before = None
            continue
        if before is None or reply.seqno == 0:
            before, echoes = (feedback, np.zeros_like(feedback), now - PERIOD), READY_AFTER
        if echoes and np.abs(reply.q - feedback).max() < SLACK and not reply.qd.any():
            before, echoes = (feedback, np.zeros_like(feedback), now), echoes - 1  # not ready yet
            continue
        echoes = 0
        q, qd, then = before
        longest = 1.01 * (now - then) + ahead
        moved, step = reply.q - q, longest
        if reply.qd.any():  # the time in which this speed makes this step
            step = float(moved @ reply.qd / (reply.qd @ reply.qd))
            assert 0.0 < step <= longest, f"a speed of another time at {sent.t:.3f} s"
        assert np.abs(moved - reply.qd * step).max() <= SLACK, f"not as fast as said at {sent.t:.3f} s"
        braked = np.maximum(np.abs(qd) - LIMITS.qdd_max * step, 0.0) * step
        furthest = np.maximum(LIMITS.qd_max * min(step, 1.01 * GAP), braked)
        assert (np.abs(moved) <= furthest + SLACK).all(), f"a jump at {sent.t:.3f} s"
        assert (np.abs(reply.qd) <= LIMITS.qd_max + SLACK).all(), f"too fast at {sent.t:.3f} s"
        assert (np.abs(reply.qd - qd) <= LIMITS.qdd_max * step + SLACK / PERIOD).all(), f"too sudden at {sent.t:.3f} s"
        before = reply.q, reply.qd, now


def log_is_what_was_sent(bench: Bench, table: Table, since: int = 0, end: int | None = None) -> None:
    """Every reply has its row, and what the row says makes the same bytes again."""
    codec = EgmCodec(ROBOT, extension=True)
    heard, sent = bench.heard()[since:end], bench.sent[since:end]
    if not sent:
        assert "seq_sent" not in table or not np.isfinite(np.asarray(table["seq_sent"], dtype=float)).any()
        return
    rows = np.flatnonzero(np.isfinite(np.asarray(table["seq_sent"], dtype=float)))
    assert len(rows) == len(sent), "every reply has its row"
    q, qd, seqs = table["q_sent"][rows], table["qd_sent"][rows], np.asarray(table["seq_sent"], dtype=float)[rows]
    for k, reply in enumerate(heard):
        reference = Reference(
            q[k], qd[k], None, int(seqs[k]), reply.tm_ms or 0, reply.echo_seq or 0, reply.echo_mono_ns or 0
        )
        assert codec.encode(reference) == sent[k].data, f"row {rows[k]} is not what was sent"
