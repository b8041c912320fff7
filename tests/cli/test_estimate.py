"""armlab estimate: the range per axis and the contacts."""

from __future__ import annotations

import json

import numpy as np
import pytest

from armlab import identify, models
from armlab.cli import main
from armlab.cli.estimate import Prior, estimate
from armlab.log.reading import read


@pytest.fixture
def pushed(monkeypatch, truth, model, tmp_path) -> str:
    """A log with a press of 8 N along +x for one second, and the model file."""

    def hand(t: np.ndarray) -> np.ndarray:
        return np.outer(8.0 * ((t > 3) & (t < 4)), np.eye(6)[0])

    table = truth.log(identify.dither(truth.robot.q_home, 6.0), seed=5, wrench=hand)
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: table)
    return str(models.save(model, tmp_path / "model.toml"))


def test_the_press_is_found(pushed: str, tmp_path, capsys) -> None:
    figure = tmp_path / "wrench.png"
    assert main(["estimate", "yumi_left", "push.mcap", "--model", pushed, "--figure", str(figure)]) == 0
    said = capsys.readouterr().out
    (line,) = [line for line in said.splitlines() if line.startswith("contact")]
    start, end, fx = float(line.split()[1]), float(line.split()[3]), float(line.split()[7])
    assert start == pytest.approx(3.0, abs=0.15)
    assert end == pytest.approx(4.0, abs=0.15)
    assert fx == pytest.approx(8.0, abs=1.0)
    assert figure.exists()


def test_nothing_is_overwritten_and_wrong_names_are_refused_before_the_work(pushed: str, tmp_path, capsys) -> None:
    figure = tmp_path / "mine.png"
    figure.write_text("mine")
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed, "--figure"]
    assert main([*words, str(figure)]) == 2
    assert main([*words, str(tmp_path / "fit.xyz")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "--force" in said.err
    assert ".svg" in said.err
    assert figure.read_text() == "mine"


def test_rows_without_torque_are_counted_and_none_at_all_is_an_error(pushed: str, truth, monkeypatch, capsys) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    rows = np.arange(len(table))[:, None]
    torn = np.where(rows < 500, np.nan, table["q"])
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed]
    for broken, code, sentence in (
        (table.with_column("tau", np.where(rows < 10, np.nan, table["tau"])), 0, "10 of 1000 rows"),
        (table.with_column("tau", np.where(rows >= 0, np.nan, table["tau"])), 1, "none among 1000. Record with the"),
        (
            table.with_column("q", np.where(rows >= 0, np.nan, table["q"])),
            1,
            "none among 1000. Never finite: q. Record",
        ),
        (
            table.with_column("q", torn).with_column("tau", table["tau"] + 0.0 * torn[::-1]),
            1,
            "Never finite: all three in one row",
        ),
        (table.rows(slice(0, 0)), 1, "none among 0"),
    ):
        monkeypatch.setattr("armlab.log.reading.read", lambda path, broken=broken, **_: broken)
        assert main(words) == code
        assert sentence in capsys.readouterr().err


def test_json(pushed: str, capsys) -> None:
    assert estimate.__doc__
    assert main(["estimate", "yumi_left", "push.mcap", "--model", pushed, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert len(data["contacts"]) == 1
    assert data["contacts"][0]["force"][0] == pytest.approx(8.0, abs=1.0)
    assert "point" in data["contacts"][0]["where"]
    assert [axis["axis"] for axis in data["axes"]] == ["f_x", "f_y", "f_z", "m_x", "m_y", "m_z"]


def test_the_model_of_another_arm_is_refused(pushed: str, capsys) -> None:
    assert main(["estimate", "yumi_right", "push.mcap", "--model", pushed]) == 2
    assert "yumi_left" in capsys.readouterr().err


def test_a_file_of_another_kind_is_named(pushed: str, truth, tmp_path, capsys) -> None:
    other = models.save(truth.robot, tmp_path / "load.toml")
    assert main(["estimate", "yumi_left", "push.mcap", "--model", str(other)]) == 2
    said = capsys.readouterr().err
    assert f"Expected a file of kind 'torque_model' at {other}, got 'robot'. Name the right file." in said


def test_the_estimate_of_every_row_goes_to_a_file(pushed: str, tmp_path, capsys) -> None:
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed]
    for name in ("est.mcap", "est.csv"):
        assert main([*words, "-o", str(tmp_path / name)]) == 0
    written = read(tmp_path / "est.mcap")
    columns = ("wrench_hat", "wrench_hat_cov", "observability", "wrench_flags", "wrench_active")
    beliefs = [name for name in written.names if name.startswith("p_")]
    assert {"p_none", "p_point", "p_wrench"} < set(beliefs)
    assert sorted(written.names) == sorted((*columns, *beliefs, "tick", "session"))
    middle = (written.t > 3.2) & (written.t < 3.9)
    assert written["p_none"][middle].max() < 0.01 < 0.5 < written["p_none"][0]
    assert written["wrench_hat"][middle, 0].mean() == pytest.approx(8.0, abs=1.0)
    assert np.all(np.linalg.eigvalsh(written["wrench_hat_cov"]) > 0)
    header = (tmp_path / "est.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header.startswith("t [s],wrench_hat1 [N],")
    assert main([*words, "-o", str(tmp_path / "est.csv")]) == 2
    assert "--force" in capsys.readouterr().err


def test_the_page_has_the_contact_and_its_figures(pushed: str, tmp_path) -> None:
    report = tmp_path / "est.html"
    assert main(["estimate", "yumi_left", "push.mcap", "--model", pushed, "--report", str(report)]) == 0
    page = report.read_text(encoding="utf-8")
    assert "Contact wrench" in page
    assert "1 contact; the strongest from" in page
    assert page.count("data:image/png;base64,") == 4
    assert "where it may be" in page
    assert "method map" in page


@pytest.mark.parametrize("method", ["bounded", "interval", "observer", "kf", "ls", "lund"])
def test_every_method_answers(pushed: str, tmp_path, capsys, method: str) -> None:
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed, "--method", method, "--json"]
    assert main([*words, "-o", str(tmp_path / "est.mcap")]) == 0
    assert json.loads(capsys.readouterr().out)["method"] == method
    assert ("wrench_interval" in read(tmp_path / "est.mcap")) == (method == "interval")


def test_prior_and_point_reach_the_estimator(pushed: str, capsys) -> None:
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed, "--json"]
    assert main([*words, "--prior-force", "0.1"]) == 0
    assert json.loads(capsys.readouterr().out)["contacts"][0]["force"][0] < 1.0
    assert main([*words, "--point", "0", "0", "0"]) == 0
    known = json.loads(capsys.readouterr().out)
    assert known["axes"][3]["two_sigma"] == pytest.approx(0.0, abs=1e-9)
    assert main([*words, "--point", "0", "0", "120"]) == 2
    assert "got one 120 m away. Give metres" in capsys.readouterr().err
    assert main([*words, "--prior-force=-1"]) == 2
    assert "six positive" in capsys.readouterr().err
    assert main([*words, "--method", "kalman"]) == 2
    assert main([*words, "--bias"]) == 2
    assert "method='kf' only" in capsys.readouterr().err
    assert main([*words, "--method", "kf", "--bias", "--force-rate", "smooth"]) == 0
    assert Prior(prior_force=5.0).deviations == [5.0] * 3 + [2.0] * 3


def test_limits_of_the_method_interval_are_printed(pushed: str, capsys) -> None:
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed, "--method", "interval"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "limit from  limit to  share beyond zero" in said
    if "contact " in said:
        assert "limits [N]" in said


def test_gaps_are_named(pushed: str, truth, monkeypatch, capsys) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    torn = table.rows((table.t < 2.0) | (table.t >= 2.5))
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: torn)
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed]
    assert main(words) == 0
    assert "Gap in the log: 0.504 s after 2.00 s" in capsys.readouterr().out
    assert main([*words, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["gaps"] == [{"after": pytest.approx(1.996), "seconds": pytest.approx(0.504)}]
    assert data["left_out"] == 0


def test_a_log_that_cannot_be_true_is_refused_or_nothing_of_it_is_called_good(
    pushed: str, truth, monkeypatch, tmp_path, capsys
) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    words = ["estimate", "yumi_left", "push.mcap", "--model", pushed, "-o", str(tmp_path / "est.csv")]
    degrees = table.with_column("q", np.rad2deg(table["q"])).with_column("qd", np.rad2deg(table["qd"]))
    silent = table.with_column("tau", np.zeros_like(table["tau"]))
    for broken, sentence in ((degrees, "degrees"), (silent, "Expected measured torques, got a constant")):
        monkeypatch.setattr("armlab.log.reading.read", lambda path, broken=broken, **_: broken)
        assert main(words) == 1
        said = capsys.readouterr()
        assert sentence in said.err
        assert said.out == ""
    assert list(tmp_path.glob("est*")) == []
    backwards = table.with_column("qd", -table["qd"])
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: backwards)
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "not good: Expected qd to be the derivative of q" in said
    assert "\ngood: " not in said
