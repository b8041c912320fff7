"""armlab estimate: the range per axis and the contacts."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import get_args

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import identify, models
from armlab.cli import main
from armlab.cli.estimate import ContactPrior
from armlab.cli.estimate.report import axes, columns, contact_rows, judge, limits, places, rows
from armlab.cli.support.options import ForceMethod
from armlab.contact import INFEASIBLE, INVALID, SINGULAR, STUCK, Estimator, contacts, hypotheses
from armlab.contact.contacts import Contact
from armlab.contact.estimator import METHODS
from armlab.log import Table
from armlab.log.reading import read
from armlab.models import TorqueModel


@pytest.fixture
def pushed(monkeypatch, truth, model, tmp_path) -> str:
    """Prepare a log with a press of 8 N along +x for one second; return the model file."""

    def hand(t: np.ndarray) -> np.ndarray:
        return np.outer(8.0 * ((t > 3) & (t < 4)), np.eye(6)[0])

    table = truth.log(identify.dither(truth.robot.q_home, 6.0), seed=5, wrench=hand)
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: table)
    return str(models.save(model, tmp_path / "model.toml"))


def test_the_press_is_found(pushed: str, monkeypatch, tmp_path, command) -> None:
    monkeypatch.setattr("armlab.plots.style.png", lambda drawn: plt.close("all") or b"drawn")
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed, "-o"]
    figure, report = tmp_path / "wrench.png", tmp_path / "est.html"
    said = command([*words, tmp_path / "est.mcap", "--figure", figure, "--report", report]).out
    (line,) = [line for line in said.splitlines() if line.startswith("contact")]
    start, end, fx = float(line.split()[1]), float(line.split()[3]), float(line.split()[7])
    assert start == pytest.approx(3.0, abs=0.15)
    assert end == pytest.approx(4.0, abs=0.15)
    assert fx == pytest.approx(8.0, abs=1.0)
    assert figure.exists()
    page = report.read_text(encoding="utf-8")
    for part in ("Contact wrench", "1 contact; the strongest lasts from", "possible location", "method map"):
        assert part in page
    assert page.count("data:image/png;base64,") == 4
    written = read(tmp_path / "est.mcap")
    columns = ("wrench_hat", "wrench_hat_cov", "observability", "wrench_flags", "wrench_active")
    beliefs = [name for name in written.names if name.startswith("p_")]
    assert {"p_none", "p_point", "p_wrench"} < set(beliefs)
    assert sorted(written.names) == sorted((*columns, *beliefs, "q", "qd", "tau", "tick", "session"))
    middle = (written.t > 3.2) & (written.t < 3.9)
    assert written["p_none"][middle].max() < 0.01 < 0.5 < written["p_none"][0]
    assert written["wrench_hat"][middle, 0].mean() == pytest.approx(8.0, abs=1.0)
    assert np.all(np.linalg.eigvalsh(written["wrench_hat_cov"]) > 0)
    data = json.loads(command([*words, tmp_path / "est.csv", "--json"]).out)
    assert data["contacts"][0]["force"][0] == pytest.approx(8.0, abs=1.0)
    assert "point" in data["contacts"][0]["where"]
    assert [axis["axis"] for axis in data["axes"]] == ["f_x", "f_y", "f_z", "m_x", "m_y", "m_z"]
    header = (tmp_path / "est.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header.startswith("t [s],wrench_hat1 [N],")


def test_rows_without_torque_are_counted_and_none_at_all_is_an_error(pushed: str, truth, monkeypatch, command) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    rows = np.arange(len(table))[:, None]
    torn = np.where(rows < 500, np.nan, table["q"])
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed]
    for broken, code, sentence in (
        (table.with_column("tau", np.where(rows < 10, np.nan, table["tau"])), 0, "10 of 1000 rows"),
        (table.with_column("tau", np.where(rows >= 0, np.nan, table["tau"])), 1, "none in 1000 rows. Record with the"),
        (table.with_column("q", np.where(rows >= 0, np.nan, table["q"])), 1, "none in 1000 rows. Never finite: q."),
        (
            table.with_column("q", torn).with_column("tau", table["tau"] + 0.0 * torn[::-1]),
            1,
            "Never finite: all three in one row",
        ),
        (table.rows(slice(0, 0)), 1, "none in 0 rows"),
    ):
        monkeypatch.setattr("armlab.log.reading.read", lambda path, broken=broken, **_: broken)
        assert sentence in command(words, code).err


def test_the_command_knows_every_method() -> None:
    assert {*get_args(ForceMethod)} == {*METHODS}


@pytest.mark.parametrize("method", ["interval", "kf", "ls"])
def test_every_method_answers(pushed: str, tmp_path, command, method: str) -> None:
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed, "--method", method]
    assert json.loads(command([*words, "--json", "-o", tmp_path / "est.mcap"]).out)["method"] == method
    assert ("wrench_interval" in read(tmp_path / "est.mcap")) == (method == "interval")
    said = command(words).out
    assert ("limit from  limit to  fraction beyond zero" in said) == (method == "interval")
    assert ("limits [N]" in said) == (method == "interval" and "contact " in said)


def test_prior_and_point_reach_the_estimator(pushed: str, command) -> None:
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed, "--json"]
    assert json.loads(command([*words, "--prior-force", "0.1"]).out)["contacts"][0]["force"][0] < 1.0
    known = json.loads(command([*words, "--point", "0", "0", "0"]).out)
    assert known["axes"][3]["two_sigma"] == pytest.approx(0.0, abs=1e-9)
    assert "got a point 120 m away. Pass metres" in command([*words, "--point", "0", "0", "120"], 2).err
    assert "six positive" in command([*words, "--prior-force=-1"], 2).err
    assert main([*words, "--method", "kalman"]) == 2
    assert "method='kf' only" in command([*words, "--bias"], 2).err
    assert main([*words, "--method", "kf", "--bias", "--force-rate", "smooth"]) == 0
    assert ContactPrior(prior_force=5.0).deviations == [5.0] * 3 + [2.0] * 3


def test_the_model_of_another_arm_and_a_file_of_another_kind_are_refused(pushed: str, truth, tmp_path, command) -> None:
    assert "yumi_left" in command(["estimate", "yumi_right", "push.mcap", "--model", pushed], 2).err
    other = models.save(truth.robot, tmp_path / "load.toml")
    said = command(["estimate", "yumi_left", "push.mcap", "--model", other], 2).err
    assert f"Expected a file of kind 'torque_model' at {other}, got 'robot'." in said


def test_gaps_are_named(pushed: str, truth, monkeypatch, command) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    torn = table.rows((table.t < 2.0) | (table.t >= 2.5))
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: torn)
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed]
    assert "Gap in the log: 0.504 s after 2.00 s" in command(words).out
    data = json.loads(command([*words, "--json"]).out)
    assert data["gaps"] == [{"after": pytest.approx(1.996), "seconds": pytest.approx(0.504)}]
    assert data["left_out"] == 0


def test_a_log_that_cannot_be_true_is_refused_or_nothing_of_it_is_called_good(
    pushed: str, truth, monkeypatch, tmp_path, command
) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed, "-o", str(tmp_path / "est.csv")]
    degrees = table.with_column("q", np.rad2deg(table["q"])).with_column("qd", np.rad2deg(table["qd"]))
    silent = table.with_column("tau", np.zeros_like(table["tau"]))
    for broken, sentence in ((degrees, "degrees"), (silent, "Expected measured torques, got constant values")):
        monkeypatch.setattr("armlab.log.reading.read", lambda path, broken=broken, **_: broken)
        said = command(words, 1)
        assert sentence in said.err
        assert said.out == ""
    assert list(tmp_path.glob("est*")) == []
    backwards = table.with_column("qd", -table["qd"])
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: backwards)
    said = command(words).out
    assert "problems: Expected qd to be the derivative of q" in said
    assert "\ngood: " not in said


PRIOR = np.array([400.0, 400, 400, 4, 4, 4])


@pytest.fixture(scope="module")
def table(truth, model: TorqueModel) -> Table:
    def hand(t: np.ndarray) -> np.ndarray:
        return np.outer(8.0 * ((t > 2) & (t < 3)), np.eye(6)[0])

    log = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5, wrench=hand)
    true = np.where(np.isfinite(hand(log.t)), hand(log.t), 0.0)
    return Estimator(model, truth.robot).run(log).with_column("wrench_true", true)


def flagged(table: Table, flag: int, share: int = 2) -> Table:
    rows = np.where(np.arange(len(table)) % share == 0, flag, 0)
    return table.with_column("wrench_flags", rows, unit="1", kind="count")


def hidden(table: Table) -> Table:
    seen = table["observability"].copy()
    seen[: len(seen) // 2, 2] = 0.1
    return table.with_column("observability", seen)


def moved(table: Table, name: str, joint: int) -> Table:
    return table.with_column(name, table[name] + np.where(np.arange(7) == joint, 9.0, 0.0))


def measured(table: Table) -> Table:
    return table.without("wrench_true").with_column("wrench", table["wrench_true"])


def with_limits(table: Table) -> Table:
    return table.with_column("wrench_interval", np.zeros((len(table), 6, 2)))


@pytest.mark.parametrize(
    ("part", "words", "change"),
    [
        ("good", "Well observable: ", lambda t: t),
        ("good", "No contact", lambda t: t),
        ("good", "against the true wrench", lambda t: t),
        ("bad", "against the true wrench", lambda t: t.with_column("wrench_true", t["wrench_true"] + 20.0)),
        ("good", "against the force sensor", measured),
        ("bad", "50.0 %), between 0.00 and 3.99 s, contain non-finite values", lambda t: flagged(t, INVALID)),
        ("bad", "In 50 % of the rows, every joint torque is within its friction bound", lambda t: flagged(t, STUCK)),
        ("bad", "In 50.0 % of the rows, no wrench at the tool explains", lambda t: flagged(t, INFEASIBLE)),
        ("bad", "50.0 % of the rows are at singular poses", lambda t: flagged(t, SINGULAR)),
        ("ahead", "--method interval", lambda t: flagged(t, STUCK, 1)),
        ("ahead", "wrench_interval", lambda t: with_limits(flagged(t, STUCK, 1))),
        ("bad", "f_z (50 % of the time)", hidden),
        ("ahead", "--point", hidden),
        ("ahead", "Move the joints slightly", lambda t: hidden(t).with_column("qd", 0.0 * t["qd"])),
        ("bad", "joint 4 (100 %)", lambda t: moved(t, "q", 3)),
        ("bad", "at untrained speeds", lambda t: moved(t, "qd", 0)),
    ],
)
def test_the_verdict_names_what_to_rely_on_and_what_not(
    part: str, words: str, change: Callable[[Table], Table], table: Table, model: TorqueModel
) -> None:
    verdict = judge(change(table), model, PRIOR, [])
    assert any(words in said for said in getattr(verdict, part)), verdict.text()


def test_a_force_beyond_the_prior_is_bad_and_a_sensor_without_numbers_says_nothing(
    table: Table, model: TorqueModel
) -> None:
    assert judge(table, model, PRIOR, [], ["Expected qd, got q."]).bad[0] == "Expected qd, got q."
    assert any("twice the prior" in said for said in judge(table, model, PRIOR / 100.0, []).bad)
    silent = measured(table).with_column("wrench", np.full((len(table), 6), np.nan))
    assert not any("against" in said for said in judge(silent, model, PRIOR, []).good)


def test_the_longest_gaps_are_named(table: Table, model: TorqueModel) -> None:
    torn = table.rows((table.t < 2.0) | (table.t >= 2.8))
    for first in (100, 300, 800, 900):
        torn = torn.rows((torn.t < first / 250) | (torn.t >= (first + 10) / 250))
    (said,) = [said for said in judge(torn, model, PRIOR, []).bad if "gaps in the log" in said]
    assert said.startswith("5 gaps in the log: ")
    assert "0.804 s after 2.00 s" in said
    assert "2 shorter ones" in said


@pytest.fixture
def limited(table: Table) -> Table:
    interval = np.tile([-1.0, 3.0], (len(table), 6, 1))
    interval[table.t >= 2.0, 0] = 5.0, 9.0
    interval[:10] = np.nan
    return table.with_column("wrench_interval", interval)


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


def test_limits_of_an_axis_and_of_a_contact(table: Table, limited: Table) -> None:
    assert "limit_low" not in axes(table)[0]
    f_x, f_y, *_ = axes(limited)
    assert (f_y["limit_low"], f_y["limit_high"], f_y["proven"]) == (-1.0, 3.0, 0.0)
    assert f_x["limit_high"] == 9.0
    assert f_x["proven"] == pytest.approx(np.mean(table.t >= 2.0))
    head, first, *_ = rows(limited)
    assert head[-3:] == ("limit from", "limit to", "fraction beyond zero")
    assert first[-3:-1] == ("5.00", "9.00")
    nothing = axes(table.with_column("wrench_interval", np.full((len(table), 6, 2), np.nan)))[0]
    assert np.isnan(nothing["limit_low"])
    assert nothing["proven"] == 0.0
    pressed = Contact(2.0, 3.0, (7.0, 0.0, 0.1), 0.5)
    assert limits(table, pressed) == []
    assert limits(limited, pressed) == [(5.0, 9.0), (-1.0, 3.0), (-1.0, 3.0)]
    assert limits(limited, Contact(0.0, 0.01, (0.0, 0.0, 0.0), 0.5)) == []
    assert contact_rows(limited, [pressed], None)[1][2] == "+7.00 (+5.00 to +9.00)"
    assert contact_rows(table, [pressed], None)[1][2] == "+7.00"
