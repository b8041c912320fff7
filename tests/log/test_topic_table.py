"""Streams on one clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError
from armlab.log.column import Column
from armlab.log.topics.streams import JOINTS, Stream
from armlab.log.topics.tables import WRENCH, Choice, table_of_streams, tables_of_streams

PATH = Path("run.mcap")
ROWS = np.arange(10)


def stream(
    topic: str, log_ns: np.ndarray, stamp_ns: np.ndarray | None = None, kind: str = "x", name: str = ""
) -> Stream:
    if kind == JOINTS:
        column = Column(unit="rad", labels=("a", "b"))
        values = {"q": np.stack([log_ns, log_ns], axis=1).astype(float)}
        return Stream(topic, kind, log_ns, stamp_ns, values, {"q": column})
    name = name or topic.strip("/")
    shape = (len(log_ns), 6) if kind == WRENCH else (len(log_ns),)
    column = Column(unit="N, N m" if kind == WRENCH else "1", frame="tool0")
    return Stream(topic, kind, log_ns, stamp_ns, {name: np.ones(shape) * len(topic)}, {name: column})


def test_a_header_of_another_clock_is_not_believed() -> None:
    """A camera with a clock of its own; simulated time beside recorded time."""
    log_ns = 10**18 + ROWS * 10**7
    arm = stream("/joint_states", log_ns, log_ns - 300, JOINTS)
    odd = stream("/cam", log_ns + 1000, ROWS * 10**7 + 5)
    plain = stream("/n", log_ns + 1000)
    table = table_of_streams(PATH, [odd, arm, plain], Choice(), ())
    assert (table.t0_ns, table.clock) == (10**18 - 300, "file")
    np.testing.assert_allclose(table["cam_age"][1:], 0.01 - 1e-6, atol=1e-8)
    np.testing.assert_allclose(table["n_age"][1:], 0.01 - 1e-6, atol=1e-8)
    by_log = table_of_streams(PATH, [arm, plain], Choice(clock="/n"), ())
    assert by_log.t0_ns == 10**18 + 1000  # a clock without headers: everything when it was recorded
    np.testing.assert_allclose(by_log["q_age"], 1e-6, atol=1e-8)


def test_rows_out_of_order() -> None:
    times = np.array([0, 1, 2, 2, 1, 3]) * 10**6 + 1
    arm = stream("/joint_states", np.arange(6), times, JOINTS)
    with pytest.warns(UserWarning, match="2 rows of /joint_states dropped"):
        table = table_of_streams(PATH, [arm], Choice(), ())
    assert table["q"][:, 0].tolist() == [0, 1, 2, 5]
    raw = table_of_streams(PATH, [arm], Choice(raw=True), ())
    assert raw["q"][:, 0].tolist() == [0, 1, 2, 3, 4, 5]


def test_names_that_the_glossary_has_and_names_that_meet() -> None:
    ns = ROWS * 10**6
    streams = [stream("/tau", ns), stream("/t", ns), stream("/a/b", ns, name="a.b"), stream("/a.b", ns, name="a.b")]
    table = table_of_streams(PATH, streams, Choice(), ())
    assert table.names == ("topic.tau", "topic.t", "a.b", "a.b_2")
    two = [stream("/w1", ns, kind=WRENCH), stream("/w2", ns, kind=WRENCH)]
    assert table_of_streams(PATH, two, Choice(), ()).columns["w1"].frame == "tool0"
    one = table_of_streams(PATH, two[:1], Choice(), ())
    assert one.notes == ("wrench_raw is /w1, in axes of tool0",)


def test_several_rates_are_refused_and_equal_ones_are_not() -> None:
    ns = ROWS * 10**6
    arm = stream("/joint_states", ns, None, JOINTS)
    with pytest.raises(LogError, match=r"of one rate in run\.mcap, got several: /n 2000 Hz, /joint_states 1000 Hz\."):
        table_of_streams(PATH, [arm, stream("/n", ns // 2)], Choice(), ())
    table = table_of_streams(PATH, [stream("/n", ns + 7), arm, stream("/once", ns[:1])], Choice(), ())
    assert table.names == ("q", "n", "n_age", "once", "once_age")
    with pytest.raises(LogError, match=r"topics with numbers in run\.mcap, got none; left out: /x\."):
        table_of_streams(PATH, [], Choice(), ["left out: /x"])


def test_each_stream_by_itself() -> None:
    ns = ROWS * 10**6
    streams = [stream("/tf", ns, name="tf.a.b"), stream("/tf", ns[:3], name="tf.c.d"), stream("/n", ns)]
    tables = tables_of_streams(PATH, streams, Choice())
    assert {name: len(table) for name, table in tables.items()} == {"/tf tf.a.b": 10, "/tf tf.c.d": 3, "/n": 10}
