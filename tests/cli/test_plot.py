"""armlab plot: a command for every figure that can be drawn from files."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import calibrate, identify, kinematics, log, plots, robots, sim
from armlab.cli import main
from armlab.cli.plot import plot
from armlab.cli.plot.options import FigureFile, LogPart, poses_in
from armlab.errors import ConfigError, LogError
from armlab.estimation import Fit
from armlab.lie import se3
from armlab.log import Column, Table
from armlab.models import TorqueModel
from armlab.motion import TwoDofDmp, fit_dmp, fit_periodic_dmp, fit_pose_dmp, fit_promp
from armlab.plots.arm import stick

OF_ANOTHER_COMMAND = {"pose_dmp", "periodic_dmp", "promp"}  # `dmp` draws every kind of primitive


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    yield
    plt.close("all")


def test_every_figure_has_its_command(command) -> None:
    commands = {name for name in plot if not name.startswith("-")}
    assert commands == set(plots.__all__) - OF_ANOTHER_COMMAND


@pytest.mark.parametrize(
    ("source", "output", "path"), [("run.mcap", None, "run_a.png"), ("ur5e", "mine.svg", "mine.svg")]
)
def test_the_file_stands_beside_its_source_and_the_ending_gives_the_format(
    source: str, output: str | None, path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    file = FigureFile(None if output is None else Path(output))
    assert file.save(file.path(source, "a"), plt.figure(figsize=(2, 2)).add_subplot()) == 0
    assert capsys.readouterr().out == f"{path}\n"
    assert Path(path).read_bytes().lstrip()[:5] in (b"\x89PNG\r", b"<?xml")
    assert [one.name for one in tmp_path.iterdir()] == [path]
    with pytest.raises(ConfigError, match="--force"):
        file.path(source, "a")


def test_part_of_a_log(tmp_path: Path) -> None:
    path = log.write(Table(np.arange(10.0), {"q": np.zeros((10, 2))}), tmp_path / "run.csv")
    assert len(LogPart().read(path)) == 10
    assert LogPart(2.0, 5.0).read(path).t.tolist() == [2.0, 3.0, 4.0]
    assert len(LogPart(end=5.0).read(path)) == 5
    with pytest.raises(LogError, match=r"from 20 to inf s, got no rows: the log ends at 9\.000 s"):
        LogPart(20.0).read(path)
    nothing = log.write(Table(np.zeros(0), {"q": np.zeros((0, 2))}), tmp_path / "none.csv")
    with pytest.raises(LogError, match=r"Expected rows in .*none\.csv, got an empty log"):
        LogPart().read(nothing)


def test_one_arm_of_a_recording_of_both(tmp_path: Path) -> None:
    pieces = [
        log.write(Table(np.arange(3.0), {"q": np.full((3, 7), value)}), tmp_path / f"{name}.mcap", robots.load(name))
        for value, name in ((1.0, "yumi_left"), (2.0, "yumi_right"))
    ]
    both = log.merge(pieces, tmp_path / "both.mcap")
    assert LogPart(arm="yumi_right").read(both)["q"][0, 0] == 2.0
    with pytest.raises(LogError, match=r"--arm on the command line.* which holds yumi_left, yumi_right"):
        LogPart().read(both)


def test_poses_are_those_of_the_log_or_of_a_robot() -> None:
    q = np.zeros((3, 6))
    T = np.tile(se3.from_rp(np.eye(3), [1.0, 2.0, 3.0]), (3, 1, 1))
    table = Table(np.arange(3.0), {"q": q, "T_frame_tool": T})
    assert np.array_equal(poses_in(table, Path("run.mcap"), None, None), T)
    arm = robots.load("irb2400")
    assert np.array_equal(poses_in(table, Path("run.mcap"), None, "irb2400"), kinematics.forward(arm, q))
    with pytest.raises(LogError, match=r"Add --robot NAME"):
        poses_in(table.select("q"), Path("run.mcap"), None, None)


def test_joints_of_a_bag_are_those_of_the_robot(ur5e_bag: Path) -> None:
    np.testing.assert_array_equal(LogPart(end=0.5).read(ur5e_bag, "ur5e")["q"], [np.arange(6.0)])


N = 50
T = np.linspace(0.0, 1.0, N)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    rng = np.random.default_rng(1)
    stamps = {name: np.arange(N) * 4_000_000 + k for name, k in (("receive_ns", 0), ("send_ns", 90_000))}
    values = {
        "q": rng.normal(size=(N, 6)),
        "tau": rng.normal(size=(N, 6)),
        "T_base_tool": se3.exp(0.1 * rng.normal(size=(N, 6))),
        "wrench_hat": rng.normal(size=(N, 6)),
        "wrench_hat_cov": np.tile(np.eye(6), (N, 1, 1)),
        "observability": rng.uniform(size=(N, 6)),
    }
    return log.write(Table(T, values | stamps, {"T_base_tool": Column(kind="pose")}), tmp_path / "run.csv")


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    found: dict[str, Any] = {}
    monkeypatch.setattr("armlab.cli.plot.options.save_figure", lambda figure, path: found.update({path.name: figure}))
    return found


def lines(ax: plt.Axes) -> np.ndarray:
    return np.stack([line.get_ydata() for line in ax.lines], axis=1)


def test_columns_of_a_part(run: Path, drawn: dict[str, Any]) -> None:
    assert main(["plot", "table", str(run), "tau", "--start", "0.5"]) == 0
    table = log.read(run)
    assert np.array_equal(lines(drawn["run_table.png"]), table["tau"][table.t >= 0.5])
    assert main(["plot", "table", str(run), "q", "--split"]) == 0
    assert len(drawn["run_table.png"].axes) == 6


def test_poses_over_time_and_in_space(run: Path, drawn: dict[str, Any]) -> None:
    assert main(["plot", "poses", str(run)]) == 0
    p = log.read(run)["T_base_tool"][:, :3, 3]
    assert np.array_equal(lines(drawn["run_poses.png"].axes[0]), p)
    assert main(["plot", "scene", str(run), "--robot", "irb2400", "--frames", "0.1"]) == 0
    assert main(["plot", "scene", str(run)]) == 0
    (path,) = [line for line in drawn["run_scene.png"].lines if line.get_gid() == "path"]
    assert np.array_equal(np.stack(path.get_data_3d(), axis=1), p)


def test_points_planes_and_frames_of_a_tracker(tmp_path: Path, drawn: dict[str, Any]) -> None:
    from scipy.io import savemat

    cloud, plane, pose = tmp_path / "cloud.txt", tmp_path / "plane.txt", tmp_path / "T_RB_T.mat"
    cloud.write_text("".join(f"{k} {10 * k} {20 * k} 5 0 0 0\n" for k in range(1, 4)))
    plane.write_text("1 0 0 10\n0 1 0 20\n0 0 1 30\n0 0 0 1\n")
    savemat(pose, {"T": se3.from_rp(np.eye(3), [100.0, 0.0, 0.0])})
    words = ["--cloud", str(cloud), "--plane", str(plane), "--pose", str(pose)]
    assert main(["plot", "scene", *words]) == 0
    ax = drawn["cloud_scene.png"]
    assert {part.get_gid() for part in ax.collections} >= {"points", "plane"}
    assert "T_RB_T" in [text.get_text() for text in ax.texts]


def test_answers_of_the_loop_and_estimated_forces(run: Path, drawn: dict[str, Any], tmp_path: Path) -> None:
    table = log.read(run)
    for name in ("latency", "wrench", "observability"):
        assert main(["plot", name, str(run)]) == 0
    assert f"{N} ticks" in drawn["run_latency.png"].get_title(loc="left")
    assert np.array_equal(drawn["run_wrench.png"].axes[0].lines[0].get_ydata(), table["wrench_hat"][:, 0])
    weak = drawn["run_observability.png"].axes[0].lines[0]
    assert np.array_equal(weak.get_ydata(), table["observability"][:, 0])
    other = log.write(table, tmp_path / "other.csv")
    assert main(["plot", "wrenches", str(run), str(other)]) == 0
    assert [ax.get_title(loc="left") for ax in drawn["run_wrenches.png"].axes[:2]] == ["run", "other"]


@pytest.fixture(scope="module")
def files(fitted: Fit[TorqueModel], excited: Table, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    folder = tmp_path_factory.mktemp("files")
    return str(fitted.save(folder / "model.toml")), str(log.write(excited.between(0.0, 8.0), folder / "run.csv"))


@pytest.mark.slow
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


@pytest.mark.parametrize("name", ["torque_fit", "residual_speed", "spectrum", "friction_map", "coverage"])
def test_a_log_is_read_as_that_of_the_robot_of_the_model(
    name: str, files: tuple[str, str], fitted: Fit[TorqueModel], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A bag lists its joints in driver order; see `LogPart.read`."""
    asked = []

    def told(part: LogPart, path: Path, robot: str | None = None, model: object = None) -> Table:
        asked.append(robot)
        raise LogError("Expected no more.")

    monkeypatch.setattr(LogPart, "read", told)
    model, run = files
    arm = str(tmp_path / "arm.toml")  # like a robot that is not in the library
    robots.save(robots.load(fitted.value.robot_name), arm)
    words = [run, "--model", model] if name == "coverage" else [model, run]
    words += ["--joint", "2"] if name == "friction_map" else []
    for more, wanted in ([], fitted.value.robot_name), (["--robot", arm], arm):
        assert main(["plot", name, *words, *more]) == 1
        assert asked.pop() == wanted


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


@pytest.mark.slow
def test_wrong_files_get_a_sentence(files: tuple[str, str], drawn: dict[str, Any], tmp_path: Path, command) -> None:
    model, run = files
    for words, (code, sentence) in {
        ("torque_fit", run, model): (2, "TOML"),
        ("torque_fit", model, str(tmp_path / "none.mcap")): (1, "none.mcap"),
        ("friction_map", model, "--joint", "9"): (2, "from 1 to 7"),
        ("spectrum", model, run, "--joints", "a"): (2, "separated by commas"),
        ("torque_fit", model, run, "--robot", "ur5e"): (2, "ur5e"),
        ("calibration", model): (2, "torque model"),
    }.items():
        assert sentence in command(["plot", *words], code).err
    assert main(["plot", "friction_map", model]) == 2
    assert not drawn


T_MOTION = np.linspace(0.0, 1.0, 101)
Q = np.stack([np.sin(T_MOTION), T_MOTION**2], axis=1)
POSES = np.tile(np.eye(4), (101, 1, 1))
POSES[:, :2, 3] = Q


@cache
def motions() -> dict[str, Any]:
    joints = fit_dmp(T_MOTION, Q, n_basis=8).value
    return {
        "dmp": joints,
        "two_dof": TwoDofDmp(joints),
        "pose": fit_pose_dmp(T_MOTION, POSES, n_basis=8).value,
        "periodic": fit_periodic_dmp(T_MOTION, Q, period=1.0, n_basis=8).value,
        "promp": fit_promp(T_MOTION, np.array([Q, 1.2 * Q]), n_basis=8).value,
    }


@pytest.mark.parametrize("kind", ["dmp", "pose", "periodic", "promp"])
def test_every_kind_is_drawn(kind: str, drawn: dict[str, Any], tmp_path: Path, command) -> None:
    shown = log.write(Table(T_MOTION, {"q": Q, "T_base_tool": POSES}), tmp_path / "taught.csv")
    primitive = motions()[kind].save(tmp_path / "motion.toml")
    assert command(["plot", "dmp", primitive, shown]).out == f"{tmp_path / 'motion_dmp.png'}\n"
    assert len(drawn["motion_dmp.png"].axes) > 1


def test_phase_plane_and_names(tmp_path: Path, command) -> None:
    primitive = motions()["dmp"].save(tmp_path / "motion.toml")
    assert main(["plot", "dmp_phase", str(primitive), "-o", str(tmp_path / "b.svg")]) == 0
    assert (tmp_path / "b.svg").stat().st_size > 1000
    pose = motions()["pose"].save(tmp_path / "pose.toml")
    taught = log.write(Table(T_MOTION, {"q": Q}), tmp_path / "taught.csv")
    assert "pose_dmp" in command(["plot", "dmp_phase", pose], 2).err
    assert "joint-space primitive" in command(["plot", "two_dof", pose, taught], 2).err


def test_a_run_that_waited_is_drawn(tmp_path: Path, drawn: dict[str, Any], command) -> None:
    law = motions()["two_dof"]
    run = law.simulate(T_MOTION)
    columns = {"path": run.yc, "path_qd": run.ycd, "path_qdd": run.ycdd, "path_error": run.e, "qdd_ref": run.ydd_ref}
    values = columns | {"q": run.ya, "qd": run.yad, "phase": run.x, "tau_a": run.tau_a, "frozen": run.frozen * 1.0}
    units = {"path": "rad", "path_error": "rad", "path_qd": "rad/s", "path_qdd": "rad/s^2", "qdd_ref": "rad/s^2"}
    units |= {"phase": "1", "tau_a": "s", "frozen": "1"}
    table = Table(T_MOTION, values, {name: Column(unit=unit) for name, unit in units.items()})
    words = ["plot", "two_dof", law.save(tmp_path / "law.toml"), log.write(table, tmp_path / "run.csv")]
    words += ["--joints", "1,2"]
    command([*words, "--disturbed", "0.2,0.4", "--duration", "1", "--goal", "0.84,1"])
    assert len(drawn["run_two_dof.png"].axes) == 3
    assert "START,END" in command([*words, "--disturbed", "0.2"], 2).err


def test_an_arm_at_home_and_through_a_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drawn) -> None:
    monkeypatch.chdir(tmp_path)
    arm = robots.load("irb2400")
    q = np.linspace(np.zeros(6), np.ones(6), 20)
    q[-1, 2] = np.nan  # the last complete row counts
    run = log.write(Table(np.arange(20.0), {"q": q}), tmp_path / "run.csv")
    assert main(["plot", "robot", "irb2400"]) == 0
    assert main(["plot", "robot", "irb2400", str(run), "--tool-path"]) == 0
    assert main(["plot", "workspace", "irb2400"]) == 0
    assert main(["plot", "manipulability", "irb2400", str(run), "--of", "rotation"]) == 0
    for name, at in (("irb2400_robot.png", arm.q_home), ("run_robot.png", q[-2])):
        (line,) = [line for line in drawn[name].lines if line.get_gid() == "arm"]
        assert np.array_equal(np.stack(line.get_data_3d(), axis=1), stick(arm, at))
    assert any(line.get_gid() == "path" for line in drawn["run_robot.png"].lines)
    assert drawn["irb2400_workspace.png"].axes[0].get_title(loc="left").startswith("irb2400")
    assert "rad/s" in drawn["run_manipulability.png"].get_title()
