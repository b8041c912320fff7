"""What `armlab identify` reports: figures for scripts, and the page."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.cli.identify.report import Trial, judge, numbers, try_out, write
from armlab.estimation import Fit
from armlab.log import Table
from armlab.models import TorqueModel


@pytest.fixture(scope="module")
def trial(fitted: Fit[TorqueModel], excited: Table, truth) -> Trial:
    return try_out(fitted.value, truth.robot, excited, unseen=False)


def test_numbers_are_those_of_the_model(fitted: Fit[TorqueModel], trial: Trial) -> None:
    found = numbers(fitted, trial)
    assert [joint["joint"] for joint in found["joints"]] == [1, 2, 3, 4, 5, 6, 7]
    third = found["joints"][2]
    assert third["viscous"] == fitted.value.friction.viscous[2]
    assert third["sigma_motion"] ** 2 == pytest.approx(fitted.value.covariance.alpha2 * fitted.value.covariance.Cinf[2])
    assert np.isnan(third["share_test"])


def test_the_page_tells_how_far_it_is(
    fitted: Fit[TorqueModel], trial: Trial, excited: Table, truth, monkeypatch, tmp_path
) -> None:
    drawings = [("First", "one", "caption", lambda: b"1"), ("Second", "two", "caption", lambda: b"2")]
    monkeypatch.setattr("armlab.cli.identify.report._drawings", lambda *_: drawings)
    heard: list[tuple[float, float, str]] = []
    verdict = judge(fitted, truth.robot, [excited], trial)
    write(tmp_path / "id.html", fitted, verdict, trial, excited, "a log", lambda *words: heard.append(words))
    assert heard == [(0, 2, "drawing first"), (1, 2, "drawing second")]
    page = (tmp_path / "id.html").read_text(encoding="utf-8")
    assert "±" in page
    assert f"{100 * fitted.value.quality.coverage[0]:.1f}" in page
    assert "<h2>Second</h2>" in page
