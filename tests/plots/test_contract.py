"""The contract of every figure: it uses the given axes, raises no warnings, shows and saves nothing, keeps gaps."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from armlab import calibrate, contact, motion, plots, robots, sim
from armlab.errors import ArmlabError, ShapeError
from armlab.estimation import Fit
from armlab.lie import se3
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.plots.space import PROJECTION

Draw = Callable[..., Any]
NAMES = sorted(plots.__all__)
IN_SPACE = {"manipulability": (True,), "robot": (True,), "scene": (True,), "workspace": (False, False, True)}
N = 400
GAP = slice(150, 170)
T = np.linspace(0.0, 2.0, N)
Q = np.stack([np.sin(T), T**2 / 4], axis=1)
POSES = se3.exp(np.stack([0.1 * T, 0.2 * T, 0 * T, 0.3 * T, 0 * T, 0 * T], axis=1))


def with_gap(values: np.ndarray) -> np.ndarray:
    values = np.array(values, dtype=float)
    values[GAP] = np.nan
    return values


@pytest.fixture(scope="module")
def estimate(model: TorqueModel, truth: Any, excited: Table) -> Table:
    found = contact.Estimator(model, truth.robot).run(excited.rows(slice(0, N)))
    for name in ("wrench_hat", "wrench_hat_cov", "observability", "tau_error", "tau_variance"):
        found = found.with_column(name, with_gap(found[name]), unit=found.units[name])
    stamps = np.arange(N) * 4_000_000
    found = found.with_column("receive_ns", stamps).with_column("send_ns", stamps + 80_000)
    return found.with_column("wrench_true", np.zeros((N, 6))).with_column("q_ref", with_gap(found["q"]))


@pytest.fixture(scope="module")
def drawing(fitted: Fit[TorqueModel], truth: Any, excited: Table, estimate: Table) -> dict[str, tuple[Any, ...]]:
    arm, law = robots.load("irb2400"), motion.fit_dmp(T, Q, n_basis=10).value
    q = np.linspace(arm.q_home, arm.q_home + 0.3, 10)
    believed = contact.hypotheses(estimate, truth.robot, window=0.2)
    return {
        "autocorrelation": (estimate,),
        "calibration": (calibrate.fit_hand_eye(**sim.cell(1).hand_eye(N=12).given),),
        "coverage": (estimate,),
        "dmp": (law, (T, Q)),
        "dmp_phase": (law,),
        "excitation": (fitted.excitation,),
        "friction": (fitted, estimate),
        "friction_map": (fitted, 1, excited),
        "hypotheses": (believed,),
        "latency": (estimate,),
        "manipulability": (arm, q),
        "observability": (estimate,),
        "periodic_dmp": (motion.fit_periodic_dmp(T, Q, period=2.0, n_basis=8).value, (T, Q)),
        "pose_dmp": (motion.fit_pose_dmp(T, POSES, n_basis=8).value, (T, POSES)),
        "poses": (with_gap(POSES), T),
        "promp": (motion.fit_promp([T, T], [Q, 1.1 * Q], n_basis=8).value, [(T, Q)]),
        "residual_speed": (estimate, {"model": fitted.value.covariance}),
        "robot": (arm, q),
        "scene": ({"base": np.eye(4)}, with_gap(POSES), with_gap(POSES[:, :3, 3])),
        "spectrum": (fitted, excited),
        "table": (estimate, "q", "q_ref"),
        "torque_fit": (fitted, excited),
        "two_dof": (motion.TwoDofDmp(law).simulate(T),),
        "velocity_covariance": (fitted,),
        "workspace": (arm,),
        "wrench": (estimate,),
        "wrenches": ({"left": estimate, "right": estimate},),
    }


def panels_of(drawn: Any) -> list[Axes]:
    axes = drawn.axes if isinstance(drawn, Figure) else [drawn]
    return [ax for ax in axes if ax.get_label() != "<colorbar>"]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_figure_is_new_or_in_the_axes_of_the_caller(
    name: str, drawing: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", lambda *_, **__: pytest.fail("shown"))
    settings, draw, arguments = dict(mpl.rcParams), getattr(plots, name), drawing[name]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        drawn = draw(*arguments)
        panels = panels_of(drawn)
        assert isinstance(drawn, Axes) or len(panels) > 1  # one panel is returned itself
        assert len(plt.get_fignums()) == 1
        panels[0].figure.savefig(tmp_path / "a.png", dpi=30)
        assert dict(mpl.rcParams) == settings
        assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
        for ax in panels:
            assert ax.has_data()
            assert ax.get_ylabel()
        assert any(ax.get_xlabel() for ax in panels)
        plt.close("all")
        mine, count = axes_for(name, len(panels)), len(panels)
        drawn = draw(*arguments, ax=mine[0] if count == 1 else np.array(mine))
    assert panels_of(mine[0].figure) == mine
    assert drawn is (mine[0] if isinstance(drawn, Axes) else mine[0].figure)
    assert all(ax.has_data() for ax in mine)
    assert len(plt.get_fignums()) == 1
    with pytest.raises(ShapeError, match=rf"Expected (one|{count}) .*got {count + 1}"):
        draw(*arguments, ax=axes_for("", count + 1))


def axes_for(name: str, count: int) -> list[Axes]:
    """Return new axes of a figure, 2D or 3D as the figure `name` needs them."""
    figure = plt.figure(figsize=(8, 8), layout="constrained")
    in_space = IN_SPACE.get(name, (False,) * count)
    return [figure.add_subplot(count, 1, k + 1, **(PROJECTION if in_space[k] else {})) for k in range(count)]


@pytest.mark.parametrize("name", NAMES)
def test_what_cannot_be_drawn_gets_a_sentence(name: str, drawing: dict[str, Any]) -> None:
    for wrong in ("run.mcap", None, 3.0):
        if (name, wrong) == ("scene", None):
            continue
        with pytest.raises(ArmlabError, match=r"^['\"]?Expected .*got") as error:
            getattr(plots, name)(wrong, *drawing[name][1:])
        assert str(error.value).rstrip("'\"").endswith((".", "]", ")"))
    assert not plt.get_fignums()


OVER_TIME = ("observability", "poses", "table", "wrench", "wrenches")


@pytest.mark.parametrize("name", OVER_TIME)
def test_missing_rows_are_gaps(name: str, drawing: dict[str, Any]) -> None:
    lines = [line for ax in panels_of(getattr(plots, name)(*drawing[name])) for line in ax.lines]
    found = [y for y in (np.asarray(line.get_ydata()) for line in lines) if len(y) > 10 and np.isnan(y).any()]
    assert len(found) >= 2
    for y in found:
        assert np.isnan(y[GAP]).all()
        assert np.isfinite(y[GAP.stop :]).all()


@pytest.mark.parametrize("name", OVER_TIME)
def test_spikes_of_long_logs_stay_visible(name: str, drawing: dict[str, Any], estimate: Table) -> None:
    rows = 100 * N
    t = np.arange(rows) * 0.004

    def long(values: np.ndarray) -> np.ndarray:
        repeated = np.tile(values, (100, *[1] * (values.ndim - 1)))
        repeated[77 * N + 200] *= 1000.0 if values.ndim < 3 else 1.0
        return repeated

    columns = {key: long(estimate[key]) for key in ("q", "q_ref", "wrench_hat", "wrench_hat_cov", "observability")}
    table = Table(t, columns)
    arguments = {"poses": (long(POSES), t), "wrenches": ({"left": table},), "table": (table, "q", "q_ref")}
    drawn = getattr(plots, name)(*arguments.get(name, (table,)))
    lines = [line for ax in panels_of(drawn) for line in ax.lines if len(line.get_xdata()) > 100]
    assert lines
    assert all(len(line.get_xdata()) < 10_000 for line in lines)
    assert all((np.diff(line.get_xdata()) >= 0).all() for line in lines)
    if name not in ("poses", "table"):
        assert all(np.isnan(line.get_ydata()).any() for line in lines), "a gap stays one"
    if name != "poses":
        highest = max(np.nanmax(np.abs(line.get_ydata())) for line in lines)
        source = {"observability": "observability", "table": "q"}.get(name, "wrench_hat")
        assert highest == np.nanmax(np.abs(columns[source][:, :3] if name == "wrenches" else columns[source]))
