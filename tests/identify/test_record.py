"""Records from logs: sampling rate, checks, segments without gaps, outliers of the torque."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import NotExcited, ShapeError
from armlab.identify import fit_dynamics, prepare, with_velocity
from armlab.identify.record import (
    SLOW_SHARE,
    Record,
    pieces,
    prepare_share,
    slow_enough,
    torque_outliers,
    without_outliers,
)
from armlab.log import Table


def changed(table: Table, **columns: np.ndarray) -> Table:
    values = {name: columns.get(name, table[name]) for name in ("q", "qd", "tau")}
    return Table(table.t, values)


def test_prepare_cuts_at_gaps_and_joins_logs(truth, excited) -> None:
    holed = Table(
        np.delete(excited.t, slice(1000, 1020)),
        {k: np.delete(excited[k], slice(1000, 1020), 0) for k in ("q", "qd", "tau")},
    )
    data = prepare([excited, holed], truth.robot)
    assert isinstance(data, Record)
    N = len(excited)
    assert data.segments == ((0, N), (N, N + 1000), (N + 1000, 2 * N - 20))
    assert data.rate == pytest.approx(250.0)
    np.testing.assert_allclose(data.resolution, 0.5e-5, rtol=1e-3)
    np.testing.assert_allclose(data.dt[[0, 1, N + 1000]], 0.004, rtol=1e-6)
    blocks = data.blocks(1.0)
    assert blocks[0] == 0
    assert np.all(np.diff(blocks) >= 0)
    assert blocks[N + 1000] > blocks[N + 999]
    assert len(data.sources) == 2
    assert excited.sha256 in data.sources[0]


def test_filter_and_differentiate_do_not_reach_across_a_gap(truth, excited) -> None:
    data = prepare([excited, excited.with_column("row", np.arange(len(excited)), unit="1")], truth.robot)
    N = len(excited)
    for result in (data.filter(data.q, 10.0), data.differentiate(data.q)):
        np.testing.assert_array_equal(result[:N], result[N:])


def test_pieces_between_gaps_have_a_hundred_rows() -> None:
    t = np.delete(0.004 * np.arange(500), np.r_[120:130, 180, 300:320])
    assert pieces(t) == [(0, 120), (170, 289), (289, 469)]
    for few in (t[:0], t[:1], t[:99]):
        with pytest.raises(ShapeError, match=f"0 gaps in {len(few)} rows"):
            pieces(few)


def test_a_sliding_joint_moves_when_it_moves_by_millimetres(truth) -> None:
    """5 degrees say nothing about a slide: 30 mm are enough, 10 mm are not, and the message says mm."""
    robot = replace(truth.robot, prismatic=np.arange(7) == 0)
    t = np.arange(0, 10, 0.004)

    def log(stroke: float) -> Table:
        sizes = np.array([stroke, *[1.0] * 6])
        q, qd = 0.5 * sizes * np.sin(t)[:, None], 0.5 * sizes * np.cos(t)[:, None]
        return Table(t, {"q": q, "qd": qd, "tau": q + qd})

    assert prepare(log(0.03), robot).seconds == pytest.approx(9.996)
    with pytest.raises(NotExcited, match=r"10\.0 mm"):
        prepare(log(0.01), robot)


def test_positions_without_velocity_are_refused_by_row_and_too_few_have_none(excited) -> None:
    holes = excited["q"].copy()
    holes[5] = np.nan
    with pytest.raises(ShapeError, match=r"finite q.*first \[5\]"):
        with_velocity(Table(excited.t, {"q": holes}))
    for rows in (0, 1, 50):
        few = with_velocity(Table(excited.t[:rows], {"q": excited["q"][:rows]}))
        assert few["qd"].shape == (rows, 7)
        assert np.isnan(few["qd"]).all()


def test_velocity_is_computed_where_the_log_has_none(truth, excited) -> None:
    """Ten times the motion's band: the derivative of the position is as good as a velocity that was measured."""
    bare = Table(excited.t, {"q": excited["q"], "tau": excited["tau"]})
    found, given = prepare(bare, truth.robot), prepare(excited, truth.robot)
    assert np.std(found.qd - given.qd) < 2e-3
    assert with_velocity(excited) is excited
    holed = bare.rows(np.abs(np.arange(len(bare)) - 3000) > 20)
    assert np.abs(prepare(holed, truth.robot).qd).max() < 1.05 * np.abs(given.qd).max()
    alone = bare.rows(np.r_[0:50, 200:7500])
    assert np.isnan(with_velocity(alone)["qd"][:50]).all()


def test_of_a_share_joints_may_rest_but_what_is_there_is_checked(short_arm) -> None:
    """Others may move them. Two places of rest, in two logs, are no motion whose velocity is missing."""
    logs = [short_arm.log(k, 1000, still={1: position}) for k, position in enumerate((0.0, 0.5))]
    for table in logs:
        with pytest.raises(NotExcited, match="joint_2"):
            prepare(table, short_arm.robot)
        assert prepare_share(table, short_arm.robot).segments == ((0, 1000),)
    assert prepare(logs, short_arm.robot).segments == ((0, 1000), (1000, 2000))
    with pytest.raises(ShapeError, match=r"derivative of q.*joint_1"):
        prepare_share(logs[0].with_column("qd", -logs[0]["qd"]), short_arm.robot)


# Logs that are sampled too slowly are refused; lines of ripple that fold back are not used.


def test_ripple_that_folds_back_is_not_used() -> None:
    """A line of 200 rad/rad at 250 Hz folds from 125 Hz on; a quarter of the rate is 62.5 Hz, 1.96 rad/s."""
    assert SLOW_SHARE == 0.25
    speed = np.array([[0.0, 0.0], [1.9, 1.9], [-2.0, -2.0]])
    expected = [[True, True], [True, True], [False, True]]
    np.testing.assert_array_equal(slow_enough(speed, 250.0, np.array([200.0, 100.0])), expected)


# Spikes of torque, found and replaced.


def test_spikes_are_found_and_replaced_better_by_a_model(short_arm) -> None:
    """The median errs where friction turns round; with the model no replacement is worse than the noise around it."""
    clean, bad = short_arm.log(0, 3000), short_arm.log(0, 3000, bad=0.05)
    data = prepare(bad, short_arm.robot)
    spoilt, found = bad["tau"] != clean["tau"], torque_outliers(data)
    assert np.sum(found & ~spoilt) < 0.02 * found.sum()
    assert found.sum() > 0.98 * spoilt.sum()
    plain = without_outliers(data, found)
    modelled = without_outliers(data, found, fit_dynamics(clean, short_arm.robot).value)
    for tau in (plain, modelled):
        np.testing.assert_array_equal(tau[~found], bad["tau"][~found])
    first, second = (np.sqrt(np.mean((tau - clean["tau"])[found] ** 2)) for tau in (plain, modelled))
    assert second < 0.9 * first
    noise = np.sqrt(np.mean(np.broadcast_to([0.3, 0.2], found.shape)[found] ** 2))
    assert second == pytest.approx(np.hypot(1.0, 0.5) * noise, rel=0.15), "its own noise, and that of a median of nine"


def test_a_clean_record_has_no_spikes(short_arm) -> None:
    assert not torque_outliers(prepare(short_arm.log(1, 3000), short_arm.robot)).any()
