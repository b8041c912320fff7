"""`plots.table`: the data of the table, labelled with unit, in the right panel."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from armlab.errors import ShapeError, UnknownName
from armlab.log import Column, Table
from armlab.plots.recording import table
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
    assert [text.get_text() for text in legends[0].get_texts()] == ["a1", "a2", "a3", "limit acted"]
    assert legends[1:] == [None, None]  # the same lines: said once
    both = table(data, "tau", "q", "q_ref")
    assert [text.get_text() for text in both.axes[1].get_legend().get_texts()] == ["asked"]  # the rest stands above
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
    assert [text.get_text() for text in ax.get_legend().get_texts()] == [
        "a1",
        "a2",
        "a3",
        "asked",
        "sent",
        "limit acted",
    ]


def test_a_wrench_has_its_components(data: Table) -> None:
    ax = table(data.with_column("wrench_hat", np.zeros((N, 6))), "wrench_hat")
    assert isinstance(ax, Axes)
    assert ax.get_ylabel() == "wrench_hat [N, N m]"
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["f_x", "f_y", "f_z", "m_x", "m_y", "m_z"]


def test_one_panel_per_joint(data: Table, spans) -> None:
    figure = table(data, "tau", split=True)
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["a1", "a2", "a3"]
    for i, ax in enumerate(figure.axes):
        assert np.array_equal(drawn(ax)[0], data["tau"][:, i])
        assert len(spans(ax)) == (1 if i == 1 else 0)


def test_given_axes_are_used_and_counted(data: Table) -> None:
    figure, ax = plt.subplots()
    assert table(data, "grip", ax=ax) is ax
    assert ax.get_ylabel() == "grip [N]"
    assert figure.axes == [ax]
    with pytest.raises(ShapeError, match="Expected 2 Axes"):
        table(data, "q", "tau", ax=ax)


def test_columns_that_cannot_be_drawn(data: Table) -> None:
    with pytest.raises(UnknownName, match="'torque'"):
        table(data, "torque")
    with pytest.raises(UnknownName, match="column to draw"):
        table(data.select("grip"))
    for name, values in (("word", None), ("wrench_hat_cov", np.zeros((N, 6, 6)))):
        with pytest.raises(ShapeError, match=name):
            table(data if values is None else data.with_column(name, values), name)
