"""`plots.table`: the data of the table, labelled with unit, in the right panel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from armlab._display import AXIS_COLORS
from armlab.errors import ShapeError, UnknownName
from armlab.lie import se3, so3
from armlab.log import Column, Table
from armlab.plots.recording import latency, poses, table
from armlab.plots.style import JOINT_STYLES

N = 40


@pytest.fixture
def data() -> Table:
    rng = np.random.default_rng(1)
    clamped = np.zeros((N, 3), dtype=int)
    clamped[10:20, 1] = 2
    values = {name: rng.normal(size=(N, 3)) for name in ("q", "q_ref", "q_sent", "qd", "tau")}
    values |= {"clamped": clamped, "word": np.array(["a"] * N), "grip": rng.normal(size=N)}
    columns = {"q": Column(labels=("a1", "a2", "a3")), "word": Column(unit="1", kind="text"), "grip": Column(unit="N")}
    return Table(np.arange(N) * 0.1, values, columns)


def drawn(ax: Axes) -> list[np.ndarray]:
    return [np.asarray(line.get_ydata()) for line in ax.lines if len(line.get_xdata())]


def test_usual_columns_each_in_a_panel(data: Table, tmp_path: Path) -> None:
    figure = table(data)
    assert isinstance(figure, Figure)
    assert [ax.get_ylabel() for ax in figure.axes] == ["q [rad]", "qd [rad/s]", "tau [N m]"]
    for ax, name in zip(figure.axes, ("q", "qd", "tau"), strict=True):
        assert np.array_equal(np.stack(drawn(ax), axis=1), data[name])
        assert [line.get_color() for line in ax.lines] == [JOINT_STYLES[i][0] for i in range(3)]
        assert np.array_equal(ax.lines[0].get_xdata(), data.t)
    assert figure.axes[-1].get_xlabel() == "t [s]"
    legends = [ax.get_legend() for ax in figure.axes]
    assert [text.get_text() for text in legends[0].get_texts()] == ["a1", "a2", "a3", "limit active"]
    assert legends[1:] == [None, None]  # the same lines: one legend
    both = table(data, "tau", "q", "q_ref")
    assert [text.get_text() for text in both.axes[1].get_legend().get_texts()] == ["commanded"]  # the rest is above
    figure.savefig(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_asked_and_sent_share_the_panel_dashed(data: Table, spans) -> None:
    ax = table(data, "q", "q_ref", "q_sent")
    assert isinstance(ax, Axes)
    lines = [line for line in ax.lines if len(line.get_xdata())]
    assert np.array_equal(np.stack([line.get_ydata() for line in lines[3:6]], axis=1), data["q_ref"])
    assert [line.get_linestyle() for line in lines] == ["-"] * 3 + ["--"] * 6
    asked, sent = (lines[i]._unscaled_dash_pattern[1] for i in (3, 6))
    assert asked[0] > sent[0]  # long and short dashes
    assert spans(ax) == [pytest.approx((1.0, 2.0))]
    shown = [text.get_text() for text in ax.get_legend().get_texts()]
    assert shown == ["a1", "a2", "a3", "commanded", "sent", "limit active"]
    ax = table(data.with_column("wrench_hat", np.zeros((N, 6))), "wrench_hat")
    assert ax.get_ylabel() == "wrench_hat [N, N m]"
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["f_x", "f_y", "f_z", "m_x", "m_y", "m_z"]


def test_one_panel_per_joint(data: Table, spans) -> None:
    figure = table(data, "tau", split=True)
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["a1", "a2", "a3"]
    for i, ax in enumerate(figure.axes):
        assert np.array_equal(drawn(ax)[0], data["tau"][:, i])
        assert len(spans(ax)) == (1 if i == 1 else 0)


def test_columns_that_cannot_be_drawn(data: Table) -> None:
    with pytest.raises(UnknownName, match="'torque'"):
        table(data, "torque")
    with pytest.raises(UnknownName, match="column to draw"):
        table(data.select("grip"))
    for name, values in (("word", None), ("wrench_hat_cov", np.zeros((N, 6, 6)))):
        with pytest.raises(ShapeError, match=name):
            table(data if values is None else data.with_column(name, values), name)


t = np.linspace(0, 2, 200)
AXIS = np.array([0.6, 0.0, 0.8])
angle = np.linspace(2.0, 6.0, 200)  # passes half a turn
T = se3.from_rp(so3.exp(angle[:, None] * AXIS), np.stack([t, t**2, -t], axis=1))


def values(ax: Axes) -> np.ndarray:
    return np.stack([line.get_ydata() for line in ax.lines], axis=1)


def test_position_and_rotation_over_time() -> None:
    figure = poses(T, t)
    above, below = figure.axes
    assert np.array_equal(values(above), T[:, :3, 3])
    assert values(below) == pytest.approx(angle[:, None] * AXIS, abs=1e-9)  # continues past half a turn
    assert np.array_equal(above.lines[0].get_xdata(), t)
    assert [line.get_color() for line in above.lines] == list(AXIS_COLORS)
    assert (above.get_ylabel(), below.get_ylabel()) == ("position [m]", "rotation vector [rad]")
    assert below.get_xlabel() == "t [s]"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["x", "y", "z"]


def test_missing_poses_leave_gaps_and_small_turns_are_exact() -> None:
    gap = se3.from_rp(so3.exp(np.array([[1e-12, 0, 0], [0, 0, 0], [0, 1e-9, 0]])))
    figure = poses(np.concatenate([np.full((1, 4, 4), np.nan), gap]))
    drawn = values(figure.axes[1])
    assert np.isnan(drawn[0]).all()
    assert drawn[1:] == pytest.approx(np.array([[1e-12, 0, 0], [0, 0, 0], [0, 1e-9, 0]]), rel=1e-9, abs=1e-20)
    assert np.isnan(values(figure.axes[0])[0]).all()
    assert len(poses(np.full((3, 4, 4), np.nan)).axes) == 2
    ax = poses(T, rotation=False)
    assert ax.get_xlabel() == "sample"
    assert np.array_equal(ax.lines[0].get_xdata(), np.arange(200))


def test_poses_that_cannot_be_drawn() -> None:
    for given, times, words in (
        (np.eye(4), None, "Expected poses"),
        (T, t[:-1], r"Expected 200 finite times, one per pose, got t of shape \(199,\)"),
        (T, np.where(t == t[3], np.nan, t), "finite time"),
        (T, ["now"] * len(T), "t to be real numbers"),
    ):
        with pytest.raises(ShapeError, match=words):
            poses(given, times)


def test_every_tick_is_in_the_histogram() -> None:
    rng = np.random.default_rng(1)
    receive = 10**18 + np.arange(1000) * 4_000_000
    late = np.arange(1000) % 100 == 0
    reply = rng.integers(20_000, 300_000, 1000)
    values = {"receive_ns": receive, "send_ns": receive + reply, "step_ns": reply // 4, "wake_ns": reply // 8}
    ax = latency(Table(np.arange(1000) * 0.004, {**values, "late": late, "missed": np.ones(1000, dtype=int)}))
    assert ax.get_title(loc="left") == "1000 ticks, 1000 missed, 10 late"
    assert ax.get_xlabel() == "time [s]"
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts[0].startswith(f"packet to reply:  p50 {np.median(reply) / 1e3:.0f} µs  p99 ")
    assert f"p99.9 {np.quantile(reply, 0.999) / 1e3:.0f} µs  max {reply.max() / 1e3:.0f} µs" in texts[0]
    low, high = ax.patches[0].get_path().get_extents().intervalx
    assert low <= reply.min() * 1e-9 < reply.max() * 1e-9 <= high  # seconds
    assert ax.xaxis.get_major_formatter()(2e-4) == "200 µs"
    steps = [patch for patch in ax.patches if not patch.get_fill()]
    assert [text.split(":")[0] for text in texts] == ["packet to reply", "controller", "wake-up"]
    assert f"p50 {np.median(reply // 8) / 1e3:.1f} µs" in texts[2]
    assert len(steps) == 3
    for outline in steps:
        assert outline.get_path().vertices[1:-1:2, 1].sum() == 1000
    assert ax.get_xscale() == "log"


def test_ticks_without_a_reply_do_not_count() -> None:
    table = Table([0.0, 1.0], {"receive_ns": [1000, 5000], "send_ns": [np.nan, 9000.0]})
    ax = latency(table)
    assert "p50 4 µs " in ax.get_legend().get_texts()[0].get_text()
    with pytest.raises(UnknownName, match="loop times"):
        latency(table.select("receive_ns"))
    with pytest.raises(ShapeError, match="zeros or NaN in 2 rows"):
        latency(Table([0.0, 1.0], {"step_ns": [0, 0]}))
