"""Tables of an estimate: per axis, per contact, limits of the method "interval"."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import identify
from armlab.cli.estimate.report import AXES, axes, columns, contact_rows, limits, places, rows
from armlab.contact import Contact, Estimator, contacts, hypotheses
from armlab.log import Table
from armlab.models import TorqueModel


@pytest.fixture(scope="module")
def table(truth, model: TorqueModel) -> Table:
    def hand(t: np.ndarray) -> np.ndarray:
        return np.outer(8.0 * ((t > 2) & (t < 3)), np.eye(6)[0])

    log = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5, wrench=hand)
    return Estimator(model, truth.robot).run(log)


@pytest.fixture
def limited(table: Table) -> Table:
    """With limits of -1 to 3 in every axis; of f_x from 2 s on 5 to 9."""
    interval = np.tile([-1.0, 3.0], (len(table), 6, 1))
    interval[table.t >= 2.0, 0] = 5.0, 9.0
    interval[:10] = np.nan
    return table.with_column("wrench_interval", interval)


def test_the_table_per_axis(table: Table) -> None:
    found = axes(table)
    assert [axis["axis"] for axis in found] == list(AXES)
    assert found[0]["max"] == table["wrench_hat"][:, 0].max()
    head, first, *_ = rows(table)
    assert head[4] == "2-sigma"
    assert first[2] == f"{found[0]['max']:.2f}"


def test_the_place_of_a_contact_is_in_words_and_in_columns(table: Table, truth) -> None:
    believed = hypotheses(table, truth.robot)
    (found,) = contacts(table)
    assert places([found], believed) == [(found, believed.during(found.start, found.end))]
    assert places([found], None) == [(found, "")]
    written = columns(table, believed)
    names = [f"p_{name.replace(' ', '_')}" for name in believed.names]
    assert [name for name in written.names if name.startswith("p_")] == names
    shares = np.stack([written[name] for name in names], axis=1)
    assert shares.sum(axis=1) == pytest.approx(1.0)
    for t in (0.0, 1.9, 2.6, 4.0):
        row = int(np.argmin(np.abs(table.t - t)))
        assert np.array_equal(shares[row], believed.posterior[np.argmin(np.abs(believed.t - table.t[row]))])
    assert "p_none" not in columns(table, None)


def test_limits_per_axis(table: Table, limited: Table) -> None:
    assert "limit_low" not in axes(table)[0]
    f_x, f_y, *_ = axes(limited)
    assert (f_y["limit_low"], f_y["limit_high"], f_y["proven"]) == (-1.0, 3.0, 0.0)
    assert f_x["limit_high"] == 9.0
    assert f_x["proven"] == pytest.approx(np.mean(table.t >= 2.0))
    head, first, *_ = rows(limited)
    assert head[-3:] == ("limit from", "limit to", "share beyond zero")
    assert first[-3:-1] == ("5.00", "9.00")
    nothing = table.with_column("wrench_interval", np.full((len(table), 6, 2), np.nan))
    assert np.isnan(axes(nothing)[0]["limit_low"])
    assert axes(nothing)[0]["proven"] == 0.0


def test_limits_during_a_contact(table: Table, limited: Table) -> None:
    pressed = Contact(2.0, 3.0, (7.0, 0.0, 0.1), 0.5)
    assert limits(table, pressed) == []
    assert limits(limited, pressed) == [(5.0, 9.0), (-1.0, 3.0), (-1.0, 3.0)]
    assert limits(limited, Contact(0.0, 0.01, (0.0, 0.0, 0.0), 0.5)) == []
    head, line = contact_rows(limited, [pressed], None)
    assert len(head) == len(line)
    assert line[2] == "+7.00 (+5.00 to +9.00)"
    assert contact_rows(table, [pressed], None)[1][2] == "+7.00"
