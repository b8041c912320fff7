"""What is said of a calibration: numbers, verdict, files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import calibrate, sim
from armlab.cli.calibrate.report import Wanted, judge, numbers
from armlab.errors import ConfigError


@pytest.fixture(scope="module")
def fit():
    return calibrate.fit_hand_eye(**sim.cell(1).hand_eye(wrong=2).given, robust=True)


def test_numbers_are_those_of_the_fit(fit) -> None:
    found = numbers(fit)
    assert [entry["sd"] for entry in found["parameters"]] == fit.sd.tolist()
    assert found["outliers"].tolist() == [0, 1]
    assert found["noise"]["position [m]"] == fit.sigma[0]
    assert found["excitation"]["rank"] == 12


def test_the_verdict_names_what_is_wrong(fit) -> None:
    verdict = judge(fit)
    assert not verdict.bad
    assert "Look at the 2 samples that were left out." in verdict.ahead
    many = replace(fit, outliers=np.arange(30) < 12)
    assert "12 of 30 samples were left out" in judge(many).bad[0]
    few = replace(fit, residuals=fit.residuals[:2])
    assert "hardly more measurements" in judge(few).bad[0]
    held = replace(fit, excitation=replace(fit.excitation, held=("link 3",)))
    assert "A prior holds what the samples do not tell: link 3." in judge(held).bad
    assert not judge(held).good
    rough = replace(fit, sigma=np.array([0.03, 0.001]))
    assert judge(rough).bad == (
        "Noise of position [m] of 0.03 is no noise of a sensor: some samples are wrong, or all.",
    )
    asked = replace(fit, summary=lambda fit: "positions spread over 465 m: millimetres given as metres?")
    assert judge(asked).bad == ("Positions spread over 465 m: millimetres given as metres?",)


def test_files_are_refused_before_the_work(tmp_path: Path) -> None:
    Wanted(output=tmp_path / "a.toml").check()
    for wanted in (
        Wanted(output=tmp_path / "a.txt"),
        Wanted(report=tmp_path / "no" / "a.html"),
        Wanted(figure=tmp_path),
    ):
        with pytest.raises(ConfigError, match="Expected"):
            wanted.check()


def test_a_page_has_everything_inside(fit, tmp_path: Path, capsys) -> None:
    wanted = Wanted(report=tmp_path / "a.html", json=True)
    wanted.write("hand-eye", fit, ("a.csv sha256 00",))
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "From a.csv sha256 00." in page
    assert "T_base_cam rx" in page
    assert '"a.csv sha256 00"' in capsys.readouterr().out
