"""The regression problem of a record: base parameters, columns, friction structure, places of the parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.dynamics import BaseParameters, base_parameters
from armlab.identify import design_excitation, prepare
from armlab.identify.friction_structure import (
    DELTAS,
    FOLDS,
    SMOOTH_SPEEDS,
    STRIBECK_SPEEDS,
    FrictionColumns,
    FrictionStructure,
    StructureChoice,
    choose,
)
from armlab.identify.record import Decimation
from armlab.identify.regression import Design, ParameterLayout, independent_rotors
from armlab.identify.solve import alternate, refined
from armlab.kernels import presliding
from armlab.lie import se3


def test_ranks_of_the_yumi_arm_are_the_published_ones() -> None:
    """14 for gravity, 45 rigid, 50 with rotor inertia (specification, section 4.2)."""
    robot = robots.load("yumi_left")
    base = base_parameters(robot)
    assert isinstance(base, BaseParameters)
    assert len(base.names) == len(base.kept) == 50
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.uniform(-2, 2, (3, 400, 7))
    Y = robot.chain.rigid_regressor(q, qd, qdd, robot.gravity).reshape(-1, 70)
    at_rest = robot.chain.rigid_regressor(q, 0 * q, 0 * q, robot.gravity).reshape(-1, 7, 10)
    G = at_rest[..., :4].reshape(-1, 28)
    assert np.linalg.matrix_rank(Y) == 45
    assert np.linalg.matrix_rank(G) == 14


@pytest.mark.parametrize("name", ["yumi_left", "irb2400", "ur5e"])
def test_axes_that_are_a_little_off_do_not_count_as_others(name: str) -> None:
    """A calibrated arm: 1 mm and 1 mrad add no nearly dependent columns; torques agree to 0.5 %."""
    robot, rng = robots.load(name), np.random.default_rng(1)
    frames = robot.frames @ se3.exp(1e-3 * rng.standard_normal((robot.n + 1, 6)))
    frames[0] = robot.frames[0]
    arm = robots.from_local_poe(name, frames, np.tile([0.0, 0, 0, 0, 0, 1], (robot.n, 1)))
    base, pi = base_parameters(arm), rng.standard_normal(11 * robot.n)
    q, qd, qdd = rng.uniform(-3, 3, (3, 50, robot.n))
    Y = arm.chain.rigid_regressor(q, qd, qdd, arm.gravity)
    own = np.eye(robot.n) * qdd[:, :, None]
    A = np.concatenate([Y, own], axis=2).reshape(-1, 11 * robot.n)
    kept = A[:, base.kept] / np.linalg.norm(A[:, base.kept], axis=0)
    assert np.linalg.cond(kept) < 1e3
    expected = A @ pi
    np.testing.assert_allclose(A @ base.lift @ base.B @ pi, expected, rtol=0, atol=5e-3 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["yumi_left", "yumi_right", "irb2400", "irb7600"])
def test_base_parameters_give_the_torque_of_any_link_parameters(name: str) -> None:
    robot = robots.load(name)
    base = base_parameters(robot)
    rng = np.random.default_rng(1)
    pi = rng.standard_normal(11 * robot.n)
    links, rotor = base.links_and_rotors(base.B @ pi)
    q, qd, qdd = rng.uniform(-3, 3, (3, 50, robot.n))

    def torque(links: np.ndarray, rotor: np.ndarray) -> np.ndarray:
        return robot.chain.rnea(q, qd, qdd, robot.gravity, links) + rotor * qdd

    expected = torque(pi[: 10 * robot.n].reshape(-1, 10), pi[10 * robot.n :])
    np.testing.assert_allclose(torque(links, rotor), expected, atol=1e-9 * np.abs(expected).max())
    assert np.linalg.norm([*links.ravel(), *rotor]) <= np.linalg.norm(pi) * (1 + 1e-9)


def lift() -> robots.Robot:
    """A vertical prismatic joint that carries a revolute one."""
    turned = np.eye(4)
    turned[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    return robots.from_links("lift", [np.eye(4), turned, np.eye(4)], prismatic=[True, False])


def test_weight_on_a_vertical_slide_counts_as_its_offset() -> None:
    """Gravity on everything a lift carries is constant, so only the inertia is a base parameter."""
    robot = lift()
    base = base_parameters(robot)
    assert base.offset_names[0].startswith("offset")
    assert "9.80665 m1 + 9.80665 m2" in base.offset_names[0]
    assert base.offset_names[1] == f"offset {robot.joint_names[1]}"
    assert not any(name.startswith("m1") for name in base.names)
    rng = np.random.default_rng(2)
    pi = rng.uniform(0.5, 1.0, 22)
    links, rotor = base.links_and_rotors(base.B @ pi)
    q, qd, qdd = rng.uniform(-1, 1, (3, 40, 2))
    expected = robot.chain.rnea(q, qd, qdd, robot.gravity, pi[:20].reshape(2, 10)) + pi[20:] * qdd
    found = robot.chain.rnea(q, qd, qdd, robot.gravity, links) + rotor * qdd
    np.testing.assert_allclose(found + base.D @ pi, expected, atol=1e-10)


def test_names_bounds_and_units_say_what_moves_with_what() -> None:
    """Sums of masses, inertias and rotors are not negative; gravity alone has masses and first moments."""
    robot = robots.load("yumi_left")
    base = base_parameters(robot)
    assert {"m c_y1 + m c_z2", "rotor7"} < set(base.names)
    bounded = [name for name, low in zip(base.names, base.lower) if low == 0]
    assert "rotor7" in bounded
    assert any(name.startswith("I_zz1") and name.endswith("rotor1") for name in bounded)
    assert not any(name.startswith("m c_") or " - " in name for name in bounded)
    still = base_parameters(robot, quasi_static=True)
    assert still.quasi_static
    assert len(still.names) == 14
    assert set(still.units) <= {"kg", "kg m"}


# Regression columns and decimation.


@pytest.fixture(scope="module")
def data(truth, excited):
    """A record of two segments."""
    whole = prepare(excited, truth.robot)
    return replace(whole, segments=((0, 5000), (5000, len(whole.t))))


def test_decimation_is_the_zero_phase_filter_at_the_rows_that_are_kept(data) -> None:
    decimation = Decimation.of(data, 25.0, 4)
    got = decimation.run(lambda a, b: data.tau[a:b], data.tau.shape[1])
    expected = data.filter(data.tau, 25.0)[decimation.rows]
    inside = np.concatenate([np.arange(50, 1200), np.arange(1300, len(got) - 50)])
    scale = np.std(expected, axis=0)
    assert np.max(np.abs(got - expected)[inside] / scale) < 1e-5
    assert np.max(np.abs(got - expected) / scale) < 0.1, "ends are continued in another way"


@pytest.mark.parametrize("rows", [100, 5000])
def test_ends_are_continued_by_point_reflection(data, rows: int) -> None:
    """Also where the filter reaches beyond the other end of the segment."""
    short = replace(data, rate=2500.0, segments=((0, rows),))
    decimation = Decimation.of(short, 25.0, 10)
    reach = len(decimation.taps) // 2
    assert reach > 200
    x = data.tau[:rows]
    wide = np.pad(x, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    expected = [decimation.taps @ wide[k : k + 2 * reach + 1] for k in decimation.rows]
    np.testing.assert_allclose(decimation.run(lambda a, b: x[a:b], x.shape[1]), expected, rtol=1e-9, atol=1e-9)


# The regression problem of a record: columns, places of the parameters, rows for the solver.


@pytest.mark.slow  # 5 s beside other work
def test_design_finds_the_shape_of_friction_and_the_parameters_of_a_clean_log(truth) -> None:
    """Noise-free data, truth between the grids DELTAS and STRIBECK_SPEEDS: both shapes come out within 15 %."""
    robot = truth.robot
    data = prepare(truth.log(design_excitation(robot, seconds=20, seed=2), noise=0.0), robot)
    design, theta = refined(*alternate(Design.build(data, robot, base_parameters(robot)), "wls"), "wls")
    assert truth.friction.delta[0] not in DELTAS
    assert not design.structure.smooth.any()
    np.testing.assert_allclose(design.structure.delta, truth.friction.delta, rtol=0.15)
    np.testing.assert_allclose(design.structure.speed, STRIBECK_SPEEDS[1], rtol=0.15)
    assert design.structure.terms[:, :2].all()
    relative = np.sqrt(np.mean(design.residuals(theta) ** 2, axis=0)) / np.std(design.tau, axis=0)
    assert np.all(relative < 5e-3)
    assert len(design.layout.units) == len(design.layout.names) == len(design.layout.lower) == len(theta)
    assert design.model(theta).shape == design.tau.shape == (len(design.rows), 7)
    pieces = list(design.stream(np.zeros(len(design.rows), dtype=int)))
    assert sum(len(piece.y) for piece in pieces) == design.tau.size


def test_without_known_gears_there_is_no_ripple_line(truth, excited) -> None:
    """A ratio of 1 would give cos 2q and sin 2q, which are harmonics of gravity."""
    robot = truth.robot
    data = prepare(excited, robot)
    base = base_parameters(robot)
    assert robots.load("irb7600").coupling[0, 0] == 1.0
    silent = Design.build(data, replace(robot, coupling=np.eye(7)), base)
    assert not silent.geared
    assert not any("ripple" in name for name in silent.layout.names)
    assert len(silent.layout.names) == len(silent.layout.units) == 50 + 5 * 7
    geared = Design.build(data, robot, base)
    assert geared.geared
    np.testing.assert_allclose(geared.cycles, [200, 200, 200, 200, 200, 202, 200], rtol=1e-12)


def test_ripple_that_folds_back_is_not_fitted(truth, excited) -> None:
    """At 50 Hz, a line of 200 rad/rad is too fast in most samples; at 250 Hz it is cut only where it is too fast."""
    robot, base = truth.robot, base_parameters(truth.robot)
    with pytest.warns(UserWarning, match=r"ripple below 12\.5 Hz, a quarter.*axis_1.*no ripple is fitted"):
        coarse = Design.build(prepare(excited.rows(slice(None, None, 5)), robot), robot, base)
    assert not coarse.geared
    data = prepare(excited, robot)
    lines = Design.build(data, robot, base).lines
    told = Design.build(prepare(excited.rows(slice(None, None, 5)), robot), robot, base, lines=lines)
    assert told.layout.names == Design.build(data, robot, base).layout.names, "another record may decide"
    fixed = Design.build(data, robot, base, cutoff=np.inf, every=1).fixed
    fast = 202 * np.abs(data.qd[:, 5]) > 2 * np.pi * 62.5
    assert 0.0 < fast.mean() < 0.5
    assert not fixed[fast, 5, 2:].any()
    np.testing.assert_allclose(np.hypot(*fixed[~fast, 5, 2:].T), 1.0)


def test_a_motor_that_moves_two_joints_brings_shared_columns(truth, excited) -> None:
    """Motor 7 turns with q6 + q7: the design has columns for its inertia and friction in both rows."""
    robot = truth.robot
    gears = np.linalg.inv(robot.coupling)
    gears[6, 5] = gears[6, 6]
    robot = replace(robot, coupling=np.linalg.inv(gears))
    data = prepare(excited, robot)
    base = base_parameters(robot)
    design = Design.build(data, robot, base)
    assert design.layout.names[-3:] == tuple(f"{term} of motor axis_6" for term in ("rotor", "viscous", "coulomb"))
    np.testing.assert_array_equal(design.motors, [[0, 0, 0, 0, 0, 1, 1]])
    theta = np.zeros(len(design.layout.names))
    theta[-3:] = 0.02, 0.3, 0.5
    speed = data.qd[:, 5] + data.qd[:, 6]
    torque = 0.02 * data.differentiate(speed) + 0.3 * speed + 0.5 * np.tanh(speed / 0.02)
    expected = np.zeros_like(design.tau)
    expected[:, 5:] = design.decimation.run(lambda a, b: torque[a:b, None], 1)
    np.testing.assert_allclose(design.model(theta), expected, atol=1e-9)


def test_joints_whose_torque_is_not_measured_are_left_out(truth, excited) -> None:
    robot, measured = truth.robot, [1, 3, 4]
    base = base_parameters(robot, joints=measured)
    design = Design.build(prepare(excited, robot), robot, base, joints=measured, cutoff=np.inf, every=10)
    assert design.tau.shape == (750, 3)
    assert len(base.names) < 50
    np.testing.assert_array_equal(design.tau, excited["tau"][::10][:, measured])
    friction, ripple = design.drives(np.arange(1.0, len(design.layout.names) + 1))
    assert np.all(friction.viscous[measured] > 0)
    assert not friction.viscous[[0, 2, 5, 6]].any()
    assert not ripple.cosine[[0, 2, 5, 6]].any()


def test_a_record_of_many_has_the_load_of_the_draft(truth, excited) -> None:
    """Column and slopes of load friction need a load, which the structure of a draft alone does not give."""
    robot, start = truth.robot, FrictionStructure.start(7)
    structure = replace(start, terms=np.tile([True, True, False, True], (7, 1)))
    data, base = prepare(excited.between(0.0, 6.0), robot), base_parameters(robot)
    design = Design.build(data, robot, base, structure=structure)
    rubs = np.zeros(len(design.layout.names))
    rubs[[design.layout.names.index(f"load {name}") for name in robot.joint_names]] = 0.05
    assert not design.model(rubs).any()
    theta = rubs.copy()
    theta[: len(base.names)] = base.B @ np.concatenate([truth.links.ravel(), truth.rotor])
    rubbing = design.with_load(theta).model(rubs)
    qdd = data.differentiate(data.qd)
    load = robot.chain.rnea(data.q, data.qd, qdd, robot.gravity, truth.links)[design.rows]
    fast = np.abs(data.qd[design.rows, :2]) > 0.3
    np.testing.assert_allclose(np.abs(rubbing[:, :2][fast]), 0.05 * np.abs(load[:, :2][fast]), atol=0.3)


def test_every_parameter_has_one_name_unit_bound_and_place(short_arm) -> None:
    robot = short_arm.robot
    base = base_parameters(robot)
    p, motors, seen = len(base.names), np.array([[1.0, 1.0]]), np.array([True])
    terms = (("viscous", "coulomb", "offset", "delta"), ("viscous", "coulomb+", "coulomb-", "offset", "root"))
    layout = ParameterLayout(robot, base, np.arange(2), motors, np.array([1]), seen, terms)
    assert len(layout.names) == len(layout.units) == len(layout.lower) == len(layout.slopes) == p + 4 + 5 + 3
    assert len(set(layout.names)) == len(layout.names)
    np.testing.assert_array_equal(np.flatnonzero(layout.slopes), [p + 3])
    assert layout.names[p + 3] == f"delta {robot.joint_names[0]}"
    assert layout.units[p + 3] == "rad"
    assert layout.units[p + 8] == "N m sqrt(s/rad)"
    np.testing.assert_array_equal(layout.lower[p : p + 4], [0.0, 0.0, -np.inf, -np.inf])
    for i, (columns, own) in enumerate(zip(layout.columns, ([*range(p, p + 4)], [*range(p + 4, p + 9)]))):
        motor = [p + 9, p + 10, p + 11]
        np.testing.assert_array_equal(columns, [*np.flatnonzero(base.seen[i]), *own, *motor])
    behind_a_rod = replace(layout, rotors=np.array([False]))
    assert behind_a_rod.names == tuple(name for name in layout.names if not name.startswith("rotor of motor"))
    assert [c[-1] for c in behind_a_rod.columns] == [p + 10, p + 10]


def test_a_rotor_behind_a_parallel_rod_is_an_inertia_of_the_link() -> None:
    """Axis 3 of an IRB 2400, q_2 + q_3, moves with the upper arm; coupled axes of a wrist do not move with a link."""
    robot = robots.load("irb2400")
    wrist = np.eye(6)
    wrist[5, 4] = 0.5
    for arm, seen in ((robot, [False]), (replace(robot, coupling=wrist), [True])):
        ratios = np.linalg.inv(arm.coupling)
        assert independent_rotors(arm, base_parameters(arm), ratios[np.count_nonzero(ratios, axis=1) > 1]) == seen


# The structure of friction, chosen on held-out blocks.


def record() -> tuple[np.ndarray, np.ndarray]:
    """A joint that moves back and forth at many speeds: q and qd (6000, 1), 100 Hz."""
    rng = np.random.default_rng(0)
    t = np.arange(6000) * 0.01
    f, phase = rng.uniform(0.1, 0.8, 8), rng.uniform(0, 6, 8)
    wave = 2 * np.pi * f * t[:, None] + phase
    return (0.05 * np.sin(wave)).sum(axis=1)[:, None], (0.05 * 2 * np.pi * f * np.cos(wave)).sum(axis=1)[:, None]


def load(q: np.ndarray) -> np.ndarray:
    """Torque transmitted to the links, like that of a weight, between 10 and 90 N m."""
    return 50.0 + 40.0 * np.sin(2.0 * q + np.linspace(0.0, 40.0, len(q))[:, None])


def chosen(torque, noise: float = 0.02, trust: np.ndarray | float = 1.0) -> FrictionStructure:
    """The structure chosen on all rows of an unfiltered record, in folds of half a second."""
    q, qd = record()
    rows = np.arange(len(q))
    y = torque(q, qd) + noise * np.random.default_rng(1).standard_normal(q.shape)
    motion = FrictionColumns(Decimation(((0, len(q)),), 1, np.ones(1), rows), q, qd, np.zeros(1), load(q))
    fixed = np.column_stack([qd, np.ones_like(qd)])
    return choose(StructureChoice(motion, fixed, y[:, 0], rows // 50 % FOLDS, trust * np.ones(len(q))))


def test_presliding_friction_is_told_from_a_smooth_sign_and_refined() -> None:
    delta = 1.3 * DELTAS[4]
    found = chosen(lambda q, qd: presliding(q, np.array([delta]), np.zeros(1)) + 0.3 * qd)
    assert found.smooth[0] == 0
    assert found.delta[0] == pytest.approx(delta, rel=0.1)
    assert not found.terms.any()


def test_a_smooth_sign_with_root_and_asymmetry_is_found() -> None:
    v = 0.7 * SMOOTH_SPEEDS[3]

    def torque(q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        s = np.tanh(qd / v)
        return 1.3 * np.maximum(s, 0) + 0.7 * np.minimum(s, 0) + s * np.sqrt(np.abs(qd))

    found = chosen(torque)
    assert found.smooth[0] == pytest.approx(v, rel=0.15)
    np.testing.assert_array_equal(found.terms[0], [True, False, True, False])


def test_friction_that_grows_with_the_load_is_found() -> None:
    found = chosen(lambda q, qd: presliding(q, DELTAS[[4]], np.zeros(1)) * (1.0 + 0.02 * load(q)))
    np.testing.assert_array_equal(found.terms[0], [False, False, False, True])


def test_stribeck_is_found_with_its_speed() -> None:
    speed = 1.2 * STRIBECK_SPEEDS[1]

    def torque(q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        z = presliding(q, np.array([1e-3]), np.zeros(1))
        return z * (1.0 + 0.5 * np.exp(-((qd / speed) ** 2)))

    found = chosen(torque)
    assert found.terms[0, 1]
    assert found.speed[0] == pytest.approx(speed, rel=0.15)


def test_rows_without_trust_do_not_count() -> None:
    bad = np.arange(6000)[:, None] % 20 == 0

    def torque(q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        return np.where(bad, 50.0, presliding(q, np.array([1e-3]), np.zeros(1)))

    assert chosen(torque, 0.0, 1.0 - bad[:, 0]).delta[0] == pytest.approx(1e-3, rel=0.1)
