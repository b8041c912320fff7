"""`plots.torque_fit`: measured, modelled, residual and band of each joint."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab.errors import ShapeError, UnknownName
from armlab.log import Column, Table
from armlab.plots.torques import torque_fit

N = 500


@pytest.fixture
def fitted() -> Table:
    rng = np.random.default_rng(1)
    model = np.cumsum(rng.normal(size=(N, 3)), axis=0)
    tau = model + 0.1 * rng.normal(size=(N, 3))
    tau[100:110] = np.nan
    table = Table(np.arange(N) * 0.004, {"tau": tau}, {"tau": Column(labels=("a", "b", "c"))})
    return table.with_column("tau_model", model, unit="N m").with_column("tau_sigma", np.full((N, 3), 0.1), unit="N m")


def test_each_joint_has_its_numbers(fitted: Table) -> None:
    figure = torque_fit(fitted)
    assert len(figure.axes) == 6
    for i in range(3):
        left, right = figure.axes[2 * i], figure.axes[2 * i + 1]
        assert np.array_equal(left.lines[0].get_ydata(), fitted["tau"][:, i], equal_nan=True)
        assert np.array_equal(left.lines[1].get_ydata(), fitted["tau_model"][:, i])
        residual = fitted["tau"][:, i] - fitted["tau_model"][:, i]
        assert np.array_equal(right.lines[0].get_ydata(), residual, equal_nan=True)
        edges = right.collections[0].get_paths()[0].vertices[:, 1]
        assert (edges.min(), edges.max()) == pytest.approx((-0.2, 0.2))
        assert left.get_title(loc="left") == "abc"[i]
        known = np.isfinite(residual)
        explained = 1 - residual[known].var() / fitted["tau"][known, i].var()
        inside = np.mean(np.abs(residual[known]) < 0.2)
        title = right.get_title(loc="left")
        assert title.startswith(f"{100 * explained:.2f} % explained")
        assert f"{100 * inside:.0f} % in band" in title
        assert left.get_ylabel() == "tau [N m]"
        assert right.get_ylabel() == "residual [N m]"
    assert [t.get_text() for t in figure.legends[0].get_texts()] == [
        "measured",
        "model",
        "± 2 sigma",
        "measured - model",
    ]


def test_missing_columns_and_wrong_axes(fitted: Table) -> None:
    with pytest.raises(UnknownName, match="tau_sigma"):
        torque_fit(fitted.without("tau_sigma"))
    axes = plt.figure().subplots(3, 2)
    assert torque_fit(fitted, ax=axes) is axes[0, 0].figure
    with pytest.raises(ShapeError, match="Expected 6 Axes"):
        torque_fit(fitted, ax=axes[0])


def test_a_joint_that_never_moves_has_no_verdict(fitted: Table) -> None:
    figure = torque_fit(fitted.with_column("tau", np.full((N, 3), np.nan)))
    assert figure.axes[1].get_title(loc="left") == ""
