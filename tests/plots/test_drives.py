"""`plots.friction_map`, `plots.spectrum`: friction and ripple over position."""

from __future__ import annotations

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.log import Table
from armlab.models import FrictionMap, RadialBasis, TorqueModel
from armlab.plots.drives import friction_map, spectrum

JOINT, CYCLES, SIZE = 2, 200.0, 0.15


@pytest.fixture
def mapped(model: TorqueModel) -> TorqueModel:
    """A map that is +1 N m at one end of the range of joint 3, and 0 at the other."""
    low, high = model.training.q_min, model.training.q_max
    positions = np.linspace(low, high, 4).T
    speeds = np.linspace(0.2, 1.0, 3)[None] * model.training.qd_peak[:, None]
    widths = (
        np.repeat(np.diff(positions, axis=1)[:, :1], 4, axis=1),
        np.repeat(np.diff(speeds, axis=1)[:, :1], 3, axis=1),
    )
    k = np.zeros((3, 2, 4, 3))
    k[JOINT, 0] = np.linspace(1, 0, 4)[:, None]
    return replace(model, friction_map=FrictionMap(RadialBasis(positions, widths[0], speeds, widths[1]), k))


def test_the_map_is_friction_over_position_and_velocity(
    mapped: TorqueModel, model: TorqueModel, excited: Table
) -> None:
    figure = friction_map(mapped, JOINT, excited)
    left, right, bar = figure.axes
    torque = left.collections[0].get_array().reshape(60, 61)
    plain = friction_map(model, JOINT).axes[0].collections[0].get_array().reshape(60, 61)
    added = np.asarray(torque - plain)
    assert added[45:, 0] == pytest.approx(1.0, abs=0.2)
    assert added[45:, -1] == pytest.approx(0.0, abs=0.2)
    assert np.abs(added[:30]).max() < 1e-12  # nothing in the other direction
    assert (left.get_xlabel(), left.get_ylabel()) == ("q [rad]", "qd [rad/s]")
    assert bar.get_ylabel() == "friction [N m]"
    qd = np.asarray(right.lines[0].get_xdata())
    assert (qd[0], qd[-1]) == pytest.approx((-model.training.qd_peak[JOINT], model.training.qd_peak[JOINT]))
    assert [line.get_label() for line in right.lines][1].startswith("q = ")
    assert np.asarray(right.lines[1].get_ydata()) == pytest.approx(np.asarray(torque)[:, 30], abs=1e-9)
    assert any(getattr(area, "hatches", None) == ["///"] for area in left.collections)
    assert left.get_title(loc="left") == "joint 3"


def test_the_spectrum_shows_ripple_without_and_with_the_model(model: TorqueModel, excited: Table) -> None:
    cosine = np.where(np.arange(3) == JOINT, SIZE, 0.0)
    ripple = replace(model.ripple, cycles=np.full(3, CYCLES), cosine=cosine, sine=np.zeros(3))
    tau = excited["tau"] - model.ripple.torque(excited["q"]) + ripple.torque(excited["q"])
    rippled = excited.with_column("tau", tau)
    figure = spectrum(replace(model, ripple=ripple), rippled, joints=[JOINT])
    (ax,) = figure.axes
    without, with_model, mark = ax.lines
    cycles = np.asarray(without.get_xdata())
    peak = int(np.nanargmax(without.get_ydata()))
    assert cycles[peak] == pytest.approx(CYCLES, abs=1.0)
    assert np.asarray(without.get_ydata())[peak] == pytest.approx(SIZE, rel=0.15)
    assert np.asarray(with_model.get_ydata())[peak] < 0.2 * SIZE
    assert np.asarray(mark.get_xdata())[0] == CYCLES
    assert ax.get_xlabel() == "cycles per joint turn"
    assert ax.get_ylabel() == "amplitude [N m]"
    assert ax.child_axes[0].get_xlabel() == "cycles per motor turn"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["without", "with", "line of the model"]


def test_joints_that_are_not_there_and_other_axes_are_refused(model: TorqueModel, excited: Table) -> None:
    with pytest.raises(ShapeError, match="from 0 to 2"):
        friction_map(model, 7)
    with pytest.raises(ShapeError, match="from 0 to 2"):
        spectrum(model, excited, joints=[-1])
    with pytest.raises(ShapeError, match="Expected 2 Axes"):
        friction_map(model, 0, ax=plt.figure().add_subplot())
