"""The figure of a periodic primitive: one turn over the phase, several over time."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.glossary import label
from armlab.motion import PeriodicDmp, fit_periodic_dmp
from armlab.plots import periodic_dmp

T = np.linspace(0.0, 4.0, 401)
Y = np.stack([0.3 + 0.1 * np.sin(np.pi * T), 0.05 * np.cos(np.pi * T)], axis=1)


@pytest.fixture(scope="module")
def taught() -> PeriodicDmp:
    return fit_periodic_dmp(T, Y, period=2.0).value


def test_one_turn_and_several_are_shown(taught: PeriodicDmp) -> None:
    figure = periodic_dmp(taught, (T + 1.0, Y), turns=2.0)
    position, forcing, kernels, several = figure.axes
    dots, curves = position.lines[:2], position.lines[2:]
    assert max(np.asarray(dots[0].get_xdata())) <= 2 * np.pi
    np.testing.assert_array_equal(dots[1].get_ydata(), Y[:, 1])
    phi = np.linspace(0.0, 2 * np.pi, 501)
    y = taught.g + taught.steady(phi)[0]
    np.testing.assert_allclose([curve.get_ydata() for curve in curves], y.T, rtol=0, atol=1e-6)
    psi = taught.primitive_from().basis(phi)
    np.testing.assert_allclose(forcing.lines[0].get_ydata(), psi @ taught.weights[:, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose([line.get_ydata() for line in kernels.lines], psi.T, atol=1e-12)
    begun = np.asarray(several.lines[0].get_xydata())
    assert begun[-1, 0] == pytest.approx(4.0)
    assert begun[0, 1] == pytest.approx(taught.g[0])
    np.testing.assert_allclose(begun[-500:, 1], y[1:, 0], rtol=0, atol=1e-4)  # soon the steady motion
    assert [panel.get_ylabel() for panel in figure.axes] == [label("y"), label("forcing"), "kernels [1]", label("y")]
    assert (kernels.get_xlabel(), several.get_xlabel()) == ("phi [rad]", "t [s]")
    plt.close(figure)


def test_bad_input_gets_a_sentence(taught: PeriodicDmp) -> None:
    for misuse in (
        lambda: periodic_dmp(taught, (T, Y[:, :1])),
        lambda: periodic_dmp(taught, turns=0.0),
        lambda: periodic_dmp(taught, ax=plt.subplots(3)[1]),
    ):
        with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
            misuse()
    plt.close("all")
