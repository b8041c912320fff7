"""armlab plot torque_fit and what else is drawn of a model and a log."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import calibrate, identify, log, robots, sim
from armlab.cli import main
from armlab.cli.plot import models as plot_models
from armlab.cli.support.figure_options import Part
from armlab.estimation import Fit
from armlab.log import Table
from armlab.models import TorqueModel


@pytest.fixture(scope="module")
def files(fitted: Fit[TorqueModel], excited: Table, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Names of a model file and of a log."""
    folder = tmp_path_factory.mktemp("files")
    return str(fitted.save(folder / "model.toml")), str(log.write(excited.between(0.0, 8.0), folder / "run.csv"))


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """What would have been written, by the name of the file."""
    found: dict[str, Any] = {}
    monkeypatch.setattr("armlab.cli.support.output.save_figure", lambda figure, path: found.update({path.name: figure}))
    yield found
    plt.close("all")


def test_a_model_and_a_log(files: tuple[str, str], drawn: dict[str, Any], fitted: Fit[TorqueModel]) -> None:
    model, run = files
    for name in ("torque_fit", "residual_speed", "autocorrelation", "hypotheses", "friction"):
        assert main(["plot", name, model, run]) == 0
    assert main(["plot", "spectrum", model, run, "--joints", "2"]) == 0
    assert main(["plot", "friction_map", model, run, "--joint", "2"]) == 0
    assert main(["plot", "coverage", run, "--model", model]) == 0
    assert set(drawn) == {
        *(f"run_{name}.png" for name in ("torque_fit", "residual_speed", "autocorrelation", "hypotheses")),
        *("model_friction.png", "run_spectrum.png", "model_friction_map_2.png", "run_coverage.png"),
    }
    predicted = identify.predict(fitted.value, log.read(run))
    model_line = drawn["run_torque_fit.png"].axes[0].lines[1]
    assert np.asarray(model_line.get_ydata()) == pytest.approx(predicted["tau_model"][:, 0], nan_ok=True)
    assert [ax.get_title(loc="left") for ax in drawn["run_spectrum.png"].axes] == ["joint 2"]
    assert drawn["model_friction_map_2.png"].axes[0].get_title(loc="left") == "joint 2"
    assert "joint 7" in [line.get_label() for line in drawn["run_coverage.png"].lines]


def test_a_log_is_read_as_that_of_the_robot_of_the_model(
    files: tuple[str, str],
    drawn: dict[str, Any],
    fitted: Fit[TorqueModel],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """A bag has its joints in the order of their driver; see `Part.read`."""
    asked, read = [], Part.read

    def told(part: Part, path: Path, robot: str | None = None) -> Table:
        asked.append(robot)
        return read(part, path, robot)

    monkeypatch.setattr(Part, "read", told)
    model, run = files
    assert main(["plot", "torque_fit", model, run]) == 0
    assert main(["plot", "residual_speed", model, run]) == 0
    assert main(["plot", "spectrum", model, run, "--joints", "2"]) == 0
    assert main(["plot", "friction_map", model, run, "--joint", "2"]) == 0
    assert main(["plot", "coverage", run, "--model", model]) == 0
    assert asked == [fitted.value.robot_name] * 5
    assert len(drawn) == 5
    file = str(tmp_path / "arm.toml")  # as of a robot that is not in the library
    robots.save(robots.load(fitted.value.robot_name), file)
    assert main(["plot", "torque_fit", model, run, "--robot", file]) == 0
    assert main(["plot", "spectrum", model, run, "--joints", "2", "--robot", file]) == 0
    assert main(["plot", "friction_map", model, run, "--joint", "2", "--robot", file]) == 0
    assert main(["plot", "coverage", run, "--model", model, "--robot", file]) == 0
    assert asked[5:] == [file] * 4


def test_a_model_alone(files: tuple[str, str], drawn: dict[str, Any], fitted: Fit[TorqueModel]) -> None:
    model, _ = files
    for name in ("friction", "velocity_covariance", "excitation"):
        assert main(["plot", name, model]) == 0
    values = drawn["model_excitation.png"].lines[0].get_ydata()
    assert len(values) == len(fitted.excitation.singular_values)
    assert len(drawn["model_velocity_covariance.png"].lines) == 7


def test_a_calibration_without_its_residuals(drawn: dict[str, Any], tmp_path: Path) -> None:
    fit = calibrate.fit_hand_eye(**sim.cell(1).hand_eye().given)
    assert main(["plot", "calibration", str(fit.save(tmp_path / "camera.toml"))]) == 0
    ellipses, told = drawn["camera_calibration.png"].axes
    assert ellipses.lines[0].get_label().startswith("T_tool_marker x and T_tool_marker y")
    assert "condition" in told.get_title(loc="left")


def test_wrong_files_get_a_sentence(files: tuple[str, str], drawn: dict[str, Any], tmp_path: Path, capsys) -> None:
    model, run = files
    for words, (code, sentence) in {
        ("torque_fit", run, model): (2, "TOML"),
        ("torque_fit", model, str(tmp_path / "none.mcap")): (1, "none.mcap"),
        ("friction_map", model, "--joint", "9"): (2, "from 1 to 7"),
        ("spectrum", model, run, "--joints", "a"): (2, "with commas"),
        ("residual_speed", model, run, "--joints", "8"): (2, "from 1 to 7"),
        ("residual_speed", model, run, "--robot", "ur5e"): (2, "ur5e"),
        ("torque_fit", model, run, "--robot", "ur5e"): (2, "ur5e"),
        ("coverage", run): (1, "--model MODEL"),
        ("calibration", model): (2, "torque model"),
    }.items():
        assert main(["plot", *words]) == code
        assert sentence in capsys.readouterr().err
    assert main(["plot", "friction_map", model]) == 2
    assert not drawn
    assert all(getattr(plot_models, name).__doc__ for name in plot_models.__all__)
