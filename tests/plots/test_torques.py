"""`plots.torque_fit`: measured, modelled, residual and band of each joint."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import identify
from armlab.errors import ModelMismatchError, ShapeError
from armlab.estimation import Fit
from armlab.log import Column, Table
from armlab.models import TorqueModel
from armlab.plots.model import torque_fit, value_of


def test_each_joint_has_its_numbers(fitted: Fit[TorqueModel], excited: Table) -> None:
    figure = torque_fit(fitted, excited)
    predicted = identify.predict(fitted.value, excited)
    assert len(figure.axes) == 6
    for i in range(3):
        left, right = figure.axes[2 * i], figure.axes[2 * i + 1]
        tau, model, sigma = (predicted[name][:, i] for name in ("tau", "tau_model", "tau_sigma"))
        assert np.array_equal(left.lines[0].get_ydata(), tau, equal_nan=True)
        assert np.array_equal(left.lines[1].get_ydata(), model, equal_nan=True)
        assert np.array_equal(left.lines[0].get_xdata(), excited.t)
        assert np.array_equal(right.lines[0].get_ydata(), tau - model, equal_nan=True)
        edges = np.concatenate([path.vertices[:, 1] for path in right.collections[0].get_paths()])
        assert (edges.min(), edges.max()) == pytest.approx((-2 * np.nanmax(sigma), 2 * np.nanmax(sigma)))
        assert left.get_title(loc="left") == f"joint {i + 1}"
        known = np.isfinite(tau - model) & np.isfinite(sigma)
        explained = 1 - np.var((tau - model)[known]) / np.var(tau[known])
        inside = np.mean(np.abs(tau - model)[known] < 2 * sigma[known])
        title = right.get_title(loc="left")
        assert title.startswith(f"{100 * explained:.2f} % explained")
        assert f"{100 * inside:.0f} % in band" in title
        assert (left.get_ylabel(), right.get_ylabel()) == ("tau [N m]", "residual [N m]")
    assert figure.axes[-1].get_xlabel() == "t [s]"
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["measured", "model", "± 2 sigma", "measured - model"]


def test_joints_have_the_names_of_the_log(model: TorqueModel, excited: Table) -> None:
    values = {name: excited[name] for name in excited.names}
    named = Table(excited.t, values, {"tau": Column(labels=("a", "b", "c"))})
    assert [ax.get_title(loc="left") for ax in torque_fit(model, named).axes[::2]] == ["a", "b", "c"]


def test_a_piece_too_short_to_filter_is_a_gap(model: TorqueModel, excited: Table) -> None:
    t = excited.t.copy()
    t[1000:] += 1.0
    t[1050:] += 1.0
    late = Table(t, {name: excited[name] for name in excited.names})
    line = torque_fit(model, late).axes[0].lines[1]
    assert np.isnan(np.asarray(line.get_ydata())[1000:1050]).all()
    assert np.isfinite(np.asarray(line.get_ydata())[:1000]).all()


def test_a_fit_or_its_value(fitted: Fit[TorqueModel], excited: Table) -> None:
    assert value_of(fitted) is value_of(fitted.value) is fitted.value
    with pytest.raises(ModelMismatchError, match=r"models\.load"):
        torque_fit("model.toml", excited)  # type: ignore[arg-type]


def test_other_axes_are_refused(model: TorqueModel, excited: Table) -> None:
    axes = plt.figure().subplots(3, 2)
    assert torque_fit(model, excited, ax=axes) is axes[0, 0].figure
    with pytest.raises(ShapeError, match="Expected 6 Axes"):
        torque_fit(model, excited, ax=axes[0])
