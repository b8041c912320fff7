"""Figures of movement primitives show the primitives' data with units, and refuse data that do not fit."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.glossary import label
from armlab.lie import so3
from armlab.motion import (
    Displace,
    Dmp,
    Hold,
    PeriodicDmp,
    PoseDmp,
    ProMP,
    TwoDofDmp,
    TwoDofRun,
    fit_dmp,
    fit_periodic_dmp,
    fit_pose_dmp,
    fit_promp,
)
from armlab.plots import dmp as plot_dmp
from armlab.plots import dmp_phase, periodic_dmp, pose_dmp, promp, two_dof
from armlab.plots.motion import TAUGHT

T = np.linspace(0.0, 2.0, 101)


def primitive(schedule: str = "canonical") -> Dmp:
    x = np.linspace(0.0, 1.0, 12)
    centres = np.exp(-3 * x) if schedule == "canonical" else x
    weights, goal = 20 * np.random.default_rng(0).normal(size=(12, 2)), np.array([1.0, -0.5])
    shape = {"extent": np.ones(2), "peak_acceleration": np.ones(2), "monotone": np.ones(2, dtype=bool)}
    kernels = {"weights": weights, "centres": centres, "widths": np.full(12, 0.1), "schedule": schedule}
    return Dmp(**kernels, tau_d=2 / 3, duration=2.0, y0=np.zeros(2), v0=np.zeros(2), g=goal, **shape)


@pytest.mark.parametrize("schedule", ["canonical", "position"])
def test_dmp_shows_demonstration_and_rollout(schedule: str) -> None:
    made, demo = primitive(schedule), np.outer(T, [0.5, -0.25])
    figure = plot_dmp(made, (T + 3.0, demo))
    position, velocity, forcing, kernels, weights = figure.axes
    path = made.rollout(np.linspace(0.0, 2.0, 501))
    for panel, values in ((position, path.y), (velocity, path.yd), (forcing, path.forcing)):
        np.testing.assert_array_equal([line.get_ydata() for line in panel.lines[:2]], values.T)
    np.testing.assert_allclose(position.lines[2].get_xydata(), np.column_stack([T, demo[:, 0]]), atol=1e-12)
    np.testing.assert_allclose(velocity.lines[3].get_ydata(), -0.25)
    assert position.lines[2].get_linewidth() == TAUGHT["linewidth"]
    assert len(kernels.lines) == 12 + (2 if schedule == "position" else 1)
    np.testing.assert_array_equal(kernels.lines[12].get_ydata(), path.x if path.x.ndim == 1 else path.x[:, 0])
    np.testing.assert_array_equal([line.get_ydata() for line in weights.lines], made.weights.T)
    assert weights.get_xlabel() == label("t") == "t [s]"
    labels = [panel.get_ylabel() for panel in figure.axes]
    assert labels == [label("y"), label("yd"), label("forcing"), "kernels, x [1]", label("weights")]
    assert all(name.endswith("m/s]" if "yd" in name else "]") for name in labels)


def test_goals_that_change_are_drawn_and_reached() -> None:
    made = primitive()
    figure = plot_dmp(made, goals=[(1.0, [0.5, 0.5]), (0.5, [2.0, -1.0])])
    position, _, forcing = figure.axes[:3]
    steps = position.lines[1]
    np.testing.assert_allclose(steps.get_xydata(), [[0.0, 1.0], [0.504, 2.0], [1.002, 0.5], [3.0, 0.5]], atol=1e-9)
    assert position.lines[0].get_ydata()[-1] == pytest.approx(0.5, abs=0.02)  # pyright: ignore
    free = made.rollout(np.linspace(0.0, 3.0, 501))
    before = free.t < 0.5
    for panel, values in ((position, free.y), (forcing, free.forcing)):
        drawn = np.asarray(panel.lines[0].get_ydata())
        np.testing.assert_allclose(drawn[before], values[before, 0], rtol=0, atol=1e-9)
    assert "goal" in position.get_legend_handles_labels()[1]


def test_phase_plane_leads_from_start_to_goal() -> None:
    panel = dmp_phase(primitive())
    path = primitive().rollout(np.linspace(0.0, 3.0, 501))
    np.testing.assert_array_equal(panel.lines[0].get_xydata(), np.column_stack([path.y[:, 0], path.yd[:, 0]]))
    np.testing.assert_array_equal(panel.lines[5].get_xydata(), [[-0.5, 0.0]])
    assert (panel.get_xlabel(), panel.get_ylabel()) == (label("y"), label("yd"))


T_POSE = np.linspace(0.0, 1.0, 201)
S = 10 * T_POSE**3 - 15 * T_POSE**4 + 6 * T_POSE**5
POSES = np.tile(np.eye(4), (201, 1, 1))
POSES[:, :3, :3] = so3.exp(np.outer(S, [0.8, 0.0, -0.6]))
POSES[:, :3, 3] = np.outer(S, [0.2, -0.1, 0.1]) + np.array([0.4, 0.0, 0.3])


@pytest.fixture(scope="module")
def taught_pose() -> PoseDmp:
    return fit_pose_dmp(T_POSE, POSES, n_basis=12).value


def test_motion_and_demonstration_are_shown_with_their_distance(taught_pose: PoseDmp) -> None:
    figure = pose_dmp(taught_pose, (T_POSE + 2.0, POSES))
    position, rotation, distance, angle = figure.axes
    run = taught_pose.rollout(T_POSE)
    np.testing.assert_allclose([line.get_ydata() for line in position.lines[:3]], run.T[:, :3, 3].T, atol=1e-12)
    np.testing.assert_allclose([line.get_ydata() for line in position.lines[3:]], POSES[:, :3, 3].T, atol=1e-12)
    away = so3.log(POSES[:, :3, :3] @ POSES[-1, :3, :3].T)
    np.testing.assert_allclose([line.get_ydata() for line in rotation.lines[3:]], away.T, atol=1e-12)
    np.testing.assert_allclose([line.get_ydata()[-1] for line in rotation.lines[:3]], 0.0, atol=1e-3)  # pyright: ignore
    off = np.linalg.norm(run.T[:, :3, 3] - POSES[:, :3, 3], axis=1)
    np.testing.assert_allclose(distance.lines[0].get_ydata(), off, atol=1e-15)
    np.testing.assert_allclose(angle.lines[0].get_ydata(), so3.angle(run.T[:, :3, :3], POSES[:, :3, :3]), atol=1e-9)
    units = [panel.get_ylabel()[-5:] for panel in figure.axes]
    assert units == ["n [m]", "[rad]", "r [m]", "[rad]"]
    assert angle.get_xlabel() == "t [s]"
    assert position.get_legend_handles_labels()[1] == ["x", "y", "z", "demonstration"]
    assert len(pose_dmp(taught_pose).axes) == 2


T_TURNS = np.linspace(0.0, 4.0, 401)
Y = np.stack([0.3 + 0.1 * np.sin(np.pi * T_TURNS), 0.05 * np.cos(np.pi * T_TURNS)], axis=1)


@pytest.fixture(scope="module")
def taught_rhythm() -> PeriodicDmp:
    return fit_periodic_dmp(T_TURNS, Y, period=2.0).value


def test_one_turn_and_several_are_shown(taught_rhythm: PeriodicDmp) -> None:
    figure = periodic_dmp(taught_rhythm, (T_TURNS + 1.0, Y), turns=2.0)
    position, forcing, kernels, several = figure.axes
    dots, curves = position.lines[:2], position.lines[2:]
    assert max(np.asarray(dots[0].get_xdata())) <= 2 * np.pi
    np.testing.assert_array_equal(dots[1].get_ydata(), Y[:, 1])
    phi = np.linspace(0.0, 2 * np.pi, 501)
    y = taught_rhythm.g + taught_rhythm.steady(phi)[0]
    np.testing.assert_allclose([curve.get_ydata() for curve in curves], y.T, rtol=0, atol=1e-6)
    psi = taught_rhythm.primitive_from().basis(phi)
    np.testing.assert_allclose(forcing.lines[0].get_ydata(), psi @ taught_rhythm.weights[:, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose([line.get_ydata() for line in kernels.lines], psi.T, atol=1e-12)
    begun = np.asarray(several.lines[0].get_xydata())
    assert begun[-1, 0] == pytest.approx(4.0)
    assert begun[0, 1] == pytest.approx(taught_rhythm.g[0])
    np.testing.assert_allclose(begun[-500:, 1], y[1:, 0], rtol=0, atol=1e-4)  # settled to the steady motion
    assert [panel.get_ylabel() for panel in figure.axes] == [label("y"), label("forcing"), "kernels [1]", label("y")]
    assert (kernels.get_xlabel(), several.get_xlabel()) == ("phi [rad]", "t [s]")


T_UNIT = np.linspace(0.0, 1.0, 101)
RNG = np.random.default_rng(0)
DEMOS = [
    (k * T_UNIT, np.outer(T_UNIT, [a, b]) + 1e-3 * RNG.normal(size=(101, 2)))
    for k, a, b in RNG.normal(2.0, 0.2, (5, 3))
]


@pytest.fixture(scope="module")
def taught_promp() -> ProMP:
    return fit_promp([t for t, _ in DEMOS], [y for _, y in DEMOS], n_basis=6).value


def test_mean_band_and_demonstrations_are_shown(taught_promp: ProMP) -> None:
    figure = promp(taught_promp, DEMOS)
    t = np.linspace(0.0, taught_promp.duration, 301)
    motion = taught_promp.marginal(t)
    for i, panel in enumerate(figure.axes):
        *demos, mean = [line for line in panel.lines if len(np.asarray(line.get_xdata()))]
        np.testing.assert_allclose(mean.get_xydata(), np.column_stack([t, motion.y[:, i]]), atol=1e-12)
        np.testing.assert_array_equal([demo.get_ydata() for demo in demos], [y[:, i] for _, y in DEMOS])
        assert all(demo.get_xdata()[-1] == pytest.approx(taught_promp.duration) for demo in demos)  # pyright: ignore
        (band,) = panel.collections
        edges = band.get_paths()[0].vertices
        for wanted in (motion.y - 2 * motion.sd, motion.y + 2 * motion.sd):
            assert np.abs(edges[:, 1] - wanted[150, i])[np.isclose(edges[:, 0], t[150])].min() < 1e-9  # pyright: ignore
        assert panel.get_ylabel() == f"y{i + 1} [rad, m]"
    assert figure.axes[-1].get_xlabel() == "t [s]"


def test_points_samples_and_what_was_before_are_shown(taught_promp: ProMP) -> None:
    point = taught_promp.marginal([1.0]).y[0] + 0.1
    passing = taught_promp.condition(1.0, point)
    figure = promp(passing, prior=taught_promp, points=[(1.0, point)], samples=3, seed=1)
    panel = figure.axes[1]
    before, mean, *samples, mark = panel.lines
    t = np.linspace(0.0, taught_promp.duration, 301)
    np.testing.assert_allclose(before.get_ydata(), taught_promp.marginal(t).y[:, 1], atol=1e-12)
    np.testing.assert_allclose([one.get_ydata() for one in samples], passing.sample(t, 1, 3)[:, :, 1], atol=1e-12)
    assert list(np.ravel(mark.get_xydata())) == [1.0, point[1]]
    assert np.interp(1.0, *np.asarray(mean.get_xydata()).T) == pytest.approx(point[1], abs=1e-4)
    assert panel.get_legend_handles_labels()[1] == ["before", "mean", "± 2 sd", "samples", "points"]


def run() -> TwoDofRun:
    y = np.outer(1.0 - np.cos(np.pi * T / 2), [0.5, -0.25])
    return TwoDofDmp(fit_dmp(T, y, n_basis=8).value).simulate(0.01, [Hold(0.5, 0.8), Displace(1.2, 0.1)])


def test_two_dof_shows_arm_path_and_what_happened() -> None:
    done = run()
    position, error, slower = two_dof(done).axes
    curves = [line.get_ydata() for line in position.lines[:6]]
    wanted = [values[:, i] for i in range(2) for values in (done.free.y, done.yc, done.ya)]
    np.testing.assert_array_equal(curves, wanted)
    np.testing.assert_array_equal([line.get_ydata() for line in error.lines[:2]], done.e.T)
    np.testing.assert_allclose(slower.lines[0].get_ydata(), done.tau_a / (2 / 3))
    for panel in (position, error, slower):
        (span,) = panel.patches
        assert (span.get_x(), span.get_x() + span.get_width()) == (0.5, pytest.approx(0.8))  # pyright: ignore
        assert list(panel.lines[-1].get_xdata()) == [1.2, 1.2]
    axes = two_dof(done, [1]).axes
    assert axes[0].get_legend_handles_labels()[1] == ["y2", "arm ya", "path yc", "undisturbed", "disturbed"]
    assert [line.get_linestyle() for line in axes[0].lines[:3]] == [":", "--", "-"]
    assert [panel.get_ylabel() for panel in axes] == [label("y"), label("e"), "slow-down [1]"]


def test_bad_input_gets_a_sentence(taught_pose: PoseDmp, taught_rhythm: PeriodicDmp, taught_promp: ProMP) -> None:
    for misuse in (
        lambda: plot_dmp(primitive(), (T, np.zeros((101, 3)))),
        lambda: plot_dmp(primitive(), (T[::-1], np.zeros((101, 2)))),
        lambda: plot_dmp(primitive(), goals=[(0.5, [1.0])]),
        lambda: pose_dmp(taught_pose, (T_POSE, POSES[1:])),
        lambda: pose_dmp(taught_pose, (T_POSE[::-1], POSES)),
        lambda: periodic_dmp(taught_rhythm, (T_TURNS, Y[:, :1])),
        lambda: periodic_dmp(taught_rhythm, turns=0.0),
        lambda: promp(taught_promp, [(T_UNIT, np.zeros((101, 3)))]),
        lambda: promp(taught_promp, points=[(0.5, [1.0])]),
        lambda: two_dof(run(), [2]),
    ):
        with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
            misuse()
