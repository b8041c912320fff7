"""The verdict of an estimate: what can be relied on, what cannot, what to do."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import identify
from armlab.cli.estimate.report import judge, write
from armlab.contact import INFEASIBLE, INVALID, SINGULAR, STUCK, Estimator, contacts
from armlab.log import Table
from armlab.models import TorqueModel

PRIOR = np.array([400.0, 400, 400, 4, 4, 4])


@pytest.fixture(scope="module")
def table(truth, model: TorqueModel) -> Table:
    def hand(t: np.ndarray) -> np.ndarray:
        return np.outer(8.0 * ((t > 2) & (t < 3)), np.eye(6)[0])

    log = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5, wrench=hand)
    true = np.where(np.isfinite(hand(log.t)), hand(log.t), 0.0)
    return Estimator(model, truth.robot).run(log).with_column("wrench_true", true)


def test_a_good_estimate_is_called_good(table: Table, model: TorqueModel) -> None:
    verdict = judge(table, model, PRIOR, contacts(table))
    assert any("1 contact; the strongest from" in said for said in verdict.good)
    assert any("Well seen: " in said for said in verdict.good)
    assert any("against the true wrench" in said for said in verdict.good)


def test_without_contact_it_says_so(table: Table, model: TorqueModel) -> None:
    assert any(said.startswith("No contact") for said in judge(table, model, PRIOR, []).good)


@pytest.mark.parametrize(
    ("flag", "sentence"),
    [
        (INVALID, "are not finite"),
        (STUCK, "inside its friction bound"),
        (INFEASIBLE, "contact on another link"),
        (SINGULAR, "singular poses"),
    ],
)
def test_flags_become_sentences(table: Table, model: TorqueModel, flag: int, sentence: str) -> None:
    half = np.where(np.arange(len(table)) % 2, flag, 0)
    flagged = table.with_column("wrench_flags", half, unit="1", kind="count")
    (said,) = [said for said in judge(flagged, model, PRIOR, []).bad if sentence in said]
    assert "50" in said


def test_axes_that_are_hardly_seen_and_logs_that_go_elsewhere_are_named(table: Table, model: TorqueModel) -> None:
    seen = table["observability"].copy()
    seen[: len(seen) // 2, 2] = 0.1
    verdict = judge(table.with_column("observability", seen), model, PRIOR, [])
    assert any("f_z (50 % of the time)" in said for said in verdict.bad)
    assert any("--point" in said for said in verdict.ahead)
    resting = table.with_column("observability", seen).with_column("qd", 0.0 * table["qd"])
    assert any("Sway" in said for said in judge(resting, model, PRIOR, []).ahead)
    far = table.with_column("q", table["q"] + np.where(np.arange(7) == 3, 9.0, 0.0))
    assert any(
        "outside the trained positions" in said and "joint 4 (100 %)" in said
        for said in judge(far, model, PRIOR, []).bad
    )
    fast = table.with_column("qd", table["qd"] + np.where(np.arange(7) == 0, 9.0, 0.0))
    assert any("speeds that were not trained" in said for said in judge(fast, model, PRIOR, []).bad)


def test_a_force_beyond_the_prior_and_a_truth_that_is_missed_are_bad(table: Table, model: TorqueModel) -> None:
    assert any("twice the prior" in said for said in judge(table, model, PRIOR / 100.0, []).bad)
    wrong = table.with_column("wrench_true", table["wrench_true"] + 20.0)
    assert any("against the true wrench" in said for said in judge(wrong, model, PRIOR, []).bad)
    sensor = table.without("wrench_true").with_column("wrench", table["wrench_true"])
    assert any("against the force sensor" in said for said in judge(sensor, model, PRIOR, []).good)
    silent = sensor.with_column("wrench", np.full((len(table), 6), np.nan))
    assert not any("against" in said for said in judge(silent, model, PRIOR, []).good)


def test_the_page_has_coverage_where_there_is_a_truth(table: Table, model: TorqueModel, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr("armlab.plots.png", lambda drawn: plt.close("all") or b"drawn")
    heard: list[str] = []
    found = contacts(table)
    verdict = judge(table, model, PRIOR, found)
    write(
        tmp_path / "est.html",
        table,
        verdict,
        found,
        None,
        "a log",
        lambda done, total, what: heard.append(what),
    )
    assert "drawing coverage by speed" in heard
    page = (tmp_path / "est.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 4
    assert f"{found[0].start:.2f}" in page


def test_the_verdict_leads_to_the_limits_that_are_there(table: Table, model: TorqueModel) -> None:
    stuck = table.with_column("wrench_flags", np.full(len(table), STUCK), unit="1", kind="count")
    assert any("--method interval" in said for said in judge(stuck, model, PRIOR, []).ahead)
    limits = stuck.with_column("wrench_interval", np.zeros((len(table), 6, 2)))
    assert any("wrench_interval" in said for said in judge(limits, model, PRIOR, []).ahead)
    assert judge(table, model, PRIOR, [], ["Expected qd, got q."]).bad[0] == "Expected qd, got q."


def test_gaps_and_rows_that_were_left_out_are_named(table: Table, model: TorqueModel) -> None:
    assert not any("Gap" in said or "are not finite" in said for said in judge(table, model, PRIOR, []).bad)
    rows = np.arange(len(table))
    flags = np.where((rows >= 250) & (rows < 275), INVALID, 0)
    torn = table.with_column("wrench_flags", flags, unit="1", kind="count").rows((rows < 500) | (rows >= 700))
    bad = judge(torn, model, PRIOR, []).bad
    assert any("25 of 800 rows (3.1 %), between 1.00 and 1.10 s, are not finite" in said for said in bad)
    assert any(said.startswith("Gap in the log: 0.804 s after 2.00 s; 0.804 s in all.") for said in bad)
    for first in (100, 300, 800, 900):
        torn = torn.rows((torn.t < first / 250) | (torn.t >= (first + 10) / 250))
    (said,) = [said for said in judge(torn, model, PRIOR, []).bad if "gaps in the log" in said]
    assert said.startswith("5 gaps in the log: ")
    assert "2 shorter ones" in said
