"""armlab identify and armlab payload: a report and a file, or an error message and no file."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import identify, models
from armlab import identify as identification
from armlab.cli import DOUBTFUL, main
from armlab.cli.identify.report import ModelTrial, judge, numbers, try_out
from armlab.cli.support.html_report import HtmlReport
from armlab.errors import NotExcited
from armlab.estimation import Fit
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.robots import inertia


@pytest.fixture(scope="module")
def logs(excited: Table, truth) -> dict[str, Table]:
    free = truth.log(identification.design_excitation(truth.robot, seconds=12, seed=4, speed=0.4), seed=4)
    return {"run.mcap": excited, "short.mcap": excited.between(0, 2), "free.mcap": free}


@pytest.fixture
def reading(monkeypatch, logs: dict[str, Table]) -> None:
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: logs[path.name])


@pytest.mark.slow
def test_it_prints_a_verdict_and_leaves_model_page_and_figure(reading, fitted, monkeypatch, tmp_path, command) -> None:
    def told(tables, robot, method, progress, force, cutoff) -> Fit[TorqueModel]:
        assert (len(tables), robot.name, method, force) == (1, "yumi_left", "irls", False)
        progress(0, 5, "checking the log")
        return fitted

    monkeypatch.setattr("armlab.identify.fit_dynamics", told)
    monkeypatch.setattr("armlab.plots.style.png", lambda drawn: plt.close("all") or b"drawn")  # real PNGs: test_excite
    words = ["identify", "yumi_left", "run.mcap", "--test", "free.mcap", "-o", tmp_path / "model.toml"]
    out, err = command([*words, "--report", tmp_path / "id.html", "--figure", tmp_path / "fit.png"])
    for words in ("held-out", "excitation good", "good: The motion identifies all parameters", "next: "):
        assert words in out
    assert "identify: checking the log" in err
    assert "report: drawing friction" in err
    model = models.load(tmp_path / "model.toml")
    assert model.robot_name == "yumi_left"
    assert np.array_equal(model.base_values, fitted.value.base_values)
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "id.html").read_text(encoding="utf-8")
    for words in ("Torque model of yumi_left", "From run.mcap, 30 s of motion, method irls.", "Test log"):
        assert words in page
    assert page.count("<tr>") == 16 + 1 + len(fitted.names)
    assert f"<summary>{len(fitted.names)} parameters with standard deviations</summary>" in page
    for title in ("Measured and modelled torque", "Residual over speed", "Friction", "Excitation"):
        assert f"<h2>{title}</h2>" in page
    assert page.count("data:image/png;base64,") == 9


def with_lines(fit: Fit[TorqueModel]) -> Fit[TorqueModel]:
    speeds = np.tile(np.linspace(0, 1, 3), (7, 1))
    size = np.full((7, 3), 0.5), np.full((1, 2, 3, 2), 0.01)
    lines = models.RippleLines(np.array([1]), np.array([200.0]), speeds, *size)
    quality = replace(fit.value.quality, rms_cv=0.5 * fit.value.quality.rms_cv)
    return replace(fit, value=replace(fit.value, lines=lines, quality=quality))


def test_json_has_the_numbers_and_the_verdict(reading, fitted, monkeypatch, tmp_path, capsys) -> None:
    asked: dict[str, object] = {}
    monkeypatch.setattr("armlab.identify.fit_dynamics", lambda *_, **options: asked.update(options) or fitted)
    words = ["identify", "yumi_left", "run.mcap", "-o", str(tmp_path / "model.toml"), "--json", "--method", "lts"]
    monkeypatch.setattr("armlab.identify.fit_friction", lambda tables, model: with_lines(fitted))
    assert main([*words, "--drives"]) == 0
    assert asked["method"] == "lts"
    assert models.load(tmp_path / "model.toml").lines is not None
    said = json.loads(capsys.readouterr().out)
    assert len(said["joints"]) == 7
    assert said["joints"][0]["share_held_out"] < 0.1
    quality = fitted.value.quality
    assert said["joints"][0]["share_held_out"] == pytest.approx(0.5 * quality.rms_cv[0] / quality.torque_sd[0])
    assert said["joints"][0]["share_test"] is None
    assert any("ripple of joint 2." in sentence for sentence in said["verdict"]["good"])
    assert said["condition"] > 1


def test_drives_that_are_refused_leave_the_base_model_and_the_reason(reading, fitted, monkeypatch, tmp_path) -> None:
    asked: dict[str, object] = {}

    def forced(*_, **options) -> Fit[TorqueModel]:
        asked.update(options)
        return replace(fitted, doubts=("joint 2 reads half the torque that these masses require",))

    def refused(*_) -> None:
        raise NotExcited("Expected every joint to slide, got less for joint 4.", ["joint 4"])

    monkeypatch.setattr("armlab.identify.fit_dynamics", forced)
    monkeypatch.setattr("armlab.identify.fit_friction", refused)
    output = tmp_path / "model.toml"
    output.write_text("")
    said = io.StringIO()
    with redirect_stdout(said):
        assert main(["identify", "yumi_left", "run.mcap", "-o", str(output), "--drives", "--force", "--json"]) == 0
    assert asked["force"] is True
    bad = json.loads(said.getvalue())["verdict"]["bad"]
    assert "Joint 2 reads half the torque that these masses require." in bad
    assert "Drives: Expected every joint to slide, got less for joint 4." in bad
    assert np.array_equal(models.load(output).base_values, fitted.value.base_values)


def test_gravity_only_is_fitted_and_said(reading, fitted, logs, monkeypatch, tmp_path, command) -> None:
    given, said = [], []
    monkeypatch.setattr("armlab.identify.fit_gravity", lambda tables, *_, **__: given.append(tables) or fitted)
    page = lambda *parts: said.append(parts[4]) or HtmlReport("a", "b")  # noqa: E731
    monkeypatch.setattr("armlab.cli.identify.report.page", page)
    words = ["identify", "yumi_left", "run.mcap", "--gravity-only", "-o", tmp_path / "model.toml"]
    assert "m c_x" in command([*words, "--report", tmp_path / "id.html"]).out
    assert given == [[logs["run.mcap"]]]
    assert "gravity and friction only" in said[0]


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (["yumi_left", "short.mcap"], 1, "at least 5 s"),
        (["yumi_left"], 2, "at least one log"),
        (["irb2400", "run.mcap"], 2, "the robot that was logged"),
        (["yumi_left", "run.mcap", "run.mcap"], 1, "Expected distinct logs"),
        (["yumi_left", "run.mcap", "--test", "run.mcap"], 1, "Expected distinct logs"),  # not held-out data
    ],
)
def test_refusals_are_one_sentence_and_leave_no_file(
    reading, tmp_path, command, words: list[str], code: int, sentence: str
) -> None:
    output = tmp_path / "model.toml"
    said = command(["identify", *words, "-o", output, "--report", tmp_path / "id.html"], code).err
    assert sentence in said
    assert "Traceback" not in said
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def trial(fitted: Fit[TorqueModel], excited: Table, truth) -> ModelTrial:
    return try_out(fitted.value, truth.robot, excited, unseen=False)


def test_numbers_are_those_of_the_model(fitted: Fit[TorqueModel], trial: ModelTrial, excited: Table) -> None:
    found = numbers(fitted, trial)
    assert [joint["joint"] for joint in found["joints"]] == [1, 2, 3, 4, 5, 6, 7]
    third = found["joints"][2]
    assert third["viscous"] == fitted.value.friction.viscous[2]
    assert third["sigma_motion"] ** 2 == pytest.approx(fitted.value.covariance.alpha2 * fitted.value.covariance.Cinf[2])
    assert np.isnan(third["share_test"])
    assert len(trial.estimate) == len(trial.log) == len(excited)
    assert not trial.estimate["wrench_true"].any()
    assert trial.share.shape == (7,)
    assert np.all(trial.share < 0.1)
    assert np.all(trial.force_rms < 1.5)
    assert 0.9 < trial.coverage < 1.0


def worse(fit: Fit[TorqueModel], **quality: np.ndarray) -> Fit[TorqueModel]:
    return replace(fit, value=replace(fit.value, quality=replace(fit.value.quality, **quality)))


def bent(fit: Fit[TorqueModel]) -> Fit[TorqueModel]:
    """Return the fit with negative friction of joint 2, inflated covariances, and a narrow training range."""
    model = fit.value
    friction = replace(model.friction, viscous=np.where(np.arange(7) == 1, -0.1, model.friction.viscous))
    parts = {"covariance": replace(model.covariance, alpha2=16.0), "momentum": replace(model.momentum, alpha2_kf=25.0)}
    training = replace(model.training, q_max=model.training.q_min + 0.2)
    return replace(fit, value=replace(model, friction=friction, training=training, **parts))


@pytest.mark.parametrize(
    ("part", "sentence", "change", "share", "coverage"),
    [
        ("good", "Held-out residual", lambda fit: fit, 0, None),
        ("good", "condition", lambda fit: fit, 0, None),
        ("good", "Without contact", lambda fit: fit, 0, None),
        ("bad", "up to 40 %", lambda fit: worse(fit, rms_cv=0.4 * fit.value.quality.torque_sd), 0, None),
        (
            "bad",
            "much larger residual on held-out data",
            lambda fit: worse(fit, rms_cv=3 * fit.value.quality.rms),
            0,
            None,
        ),
        ("bad", "joint 3: 70 %", lambda fit: worse(fit, coverage=np.where(np.arange(7) == 2, 0.7, 0.95)), 0, None),
        ("good", "consistent with the held-out blocks", lambda fit: fit, 1, None),
        ("bad", "worse in the test log", lambda fit: fit, 4, None),
        ("bad", "50 % within 2 sigma", lambda fit: fit, 0, 0.5),
        ("bad", "scaled by 4.0", bent, 0, None),
        ("bad", "momentum methods' covariance was scaled by 5.0", bent, 0, None),
        ("bad", "joint 2: negative friction", bent, 0, None),
        ("ahead", "moved over less than 25 %", bent, 0, None),
    ],
)
def test_what_is_good_and_what_is_bad_is_said(
    fitted, trial: ModelTrial, excited: Table, truth, part: str, sentence: str, change, share: float, coverage
) -> None:
    """`share`: relative residual of a test log, divided by that of held-out blocks."""
    known = fitted.value.quality.rms_cv / fitted.value.quality.torque_sd
    seen = replace(trial, unseen=True, share=share * known) if share else trial
    seen = seen if coverage is None else replace(seen, coverage=coverage)
    verdict = judge(change(fitted), truth.robot, [excited], seen)
    assert any(sentence in said for said in getattr(verdict, part))
    assert verdict.ahead


@pytest.fixture(scope="module")
def tables(truth) -> dict[str, Table]:
    motion = identify.design_excitation(truth.robot, seconds=12, speed=0.4, acceleration=8.0, seed=3)

    def log(mass: float, seed: int) -> Table:
        links = truth.links.copy()
        pi = inertia.from_body(mass, [0.03, 0.0, 0.052], np.zeros((3, 3)))
        links[-1] += inertia.transform(truth.robot.links[-1], pi)
        return replace(truth, links=links).log(motion, seed=seed)

    return {"full.mcap": log(0.5, 1), "empty.mcap": log(0.0, 2), "crumb.mcap": log(0.005, 3)}


@pytest.fixture
def words(monkeypatch, tables: dict[str, Table], model, tmp_path: Path) -> list[str]:
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: tables[path.name])
    saved = models.save(model, tmp_path / "model.toml")
    return ["payload", "yumi_left", "full.mcap", "--model", str(saved)]


@pytest.mark.slow  # 5 s beside other work
def test_a_load_is_weighed_saved_and_reported(words: list[str], tmp_path: Path, command) -> None:
    files = [tmp_path / name for name in ("load.toml", "load.html", "load.png")]
    options = [word for pair in zip(("-o", "--report", "--figure"), map(str, files)) for word in pair]
    said = command([*words, "--without", "empty.mcap", *options]).out
    assert "centre z" in said
    assert "good: The load is" in said
    load = models.load(files[0], kind="payload")
    assert load.mass == pytest.approx(0.5, rel=0.03)
    np.testing.assert_allclose(load.centre, [0.03, 0.0, 0.052], atol=5e-3)
    page = files[1].read_text(encoding="utf-8")
    assert "m c_z" in page
    assert "data:image/png" in page
    assert files[2].exists()


def test_json_and_mode(words: list[str], command) -> None:
    found = json.loads(command([*words, "--json", "--mode", "dynamic", "--gain", "0.01"]).out)
    assert found["mass"] == pytest.approx(0.5, rel=0.03)
    assert [entry["name"] for entry in found["parameters"]][4:] == ["I_xx", "I_xy", "I_yy", "I_xz", "I_yz", "I_zz"]
    assert found["parameters"][0]["sd"] < 0.01


def test_without_a_load_none_is_to_be_added_and_none_is_saved_unless_asked_for(words, tmp_path, command) -> None:
    load = tmp_path / "load.toml"
    words = [*words[:2], "empty.mcap", *words[3:], "-o", load]
    assert f"not saved because the result is poor: {load}" in command(words, DOUBTFUL).err
    assert not load.exists()
    said = command([*words, "--force"]).out
    assert load.exists()
    assert "is not distinguishable from no load" in said
    assert "unchanged" in said
    assert "added_to" not in said


def test_torque_that_is_not_explained_is_not_called_good(words: list[str], tables, monkeypatch, command) -> None:
    log = tables["full.mcap"]
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: log.with_column("tau", -log["tau"]))
    verdict = json.loads(command([*words, "--json"]).out)["verdict"]
    assert not any("explain" in said for said in verdict["good"])
    assert any("% of the torque SD unexplained" in said for said in verdict["bad"])


def test_of_an_arm_that_rests_in_part_the_joints_that_move_are_judged(
    words: list[str], truth, monkeypatch, command
) -> None:
    motion = identify.design_excitation(truth.robot, seconds=12, speed=0.4, acceleration=8.0, seed=3)
    rests = np.arange(7) < 3

    def wrist(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q, qd, qdd = motion.sample(t)
        return np.where(rests, truth.robot.q_home, q), np.where(rests, 0.0, qd), np.where(rests, 0.0, qdd)

    log = truth.log(identify.Trajectory(motion.seconds, wrist), seed=1)
    monkeypatch.setattr("armlab.log.reading.read", lambda path, **_: log)
    said = command(words).out
    assert "excluded because at rest: axis_1, axis_2, axis_7" in said
    assert "Arm and load together" in said


@pytest.mark.slow
def test_a_log_of_rtde_becomes_a_model_in_one_line(excited, truth, fitted, tmp_path, command) -> None:
    arm, n = truth.robot, truth.robot.n
    constants, qdd = np.linspace(3.0, 1.0, n), np.gradient(excited["qd"], excited.t, axis=0)
    moment = arm.chain.rnea(excited["q"], excited["qd"], qdd, arm.gravity, fitted.value.link_parameters)
    parts = {"actual_q": excited["q"], "actual_qd": excited["qd"], "actual_current": excited["tau"] / constants}
    parts |= {"target_current": moment / constants, "target_moment": moment}
    header = ["timestamp", *(f"{name}_{k}" for name in parts for k in range(n))]
    values = np.column_stack([1.7e9 + excited.t, *parts.values()])
    values[100, 3] = np.nan
    path = tmp_path / "ur.csv"
    np.savetxt(path, values, header=" ".join(header), comments="", fmt="%.17g")
    words = ["identify", truth.robot.name, path, "--columns", "ur", "-o", tmp_path / "model.toml"]
    _, err = command(words)
    assert "N m/A, identified from target_moment" in err
    assert "1 of" in err
    assert "have missing values and are skipped" in err
    model = models.load(tmp_path / "model.toml")
    sd = np.sqrt(np.diag(model.base_cov))
    assert np.all(np.abs(model.base_values - fitted.value.base_values) < 3 * sd + 1e-9)
