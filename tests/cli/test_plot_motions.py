"""armlab plot dmp, dmp_phase, two_dof: figures of saved primitives of every kind, and of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import log
from armlab.cli import main
from armlab.cli.plot.robots import dmp, dmp_phase, two_dof
from armlab.log import Column, Table
from armlab.motion import TwoDofDmp, fit_dmp, fit_periodic_dmp, fit_pose_dmp, fit_promp

T = np.linspace(0.0, 1.0, 101)
Q = np.stack([np.sin(T), T**2], axis=1)
POSES = np.tile(np.eye(4), (101, 1, 1))
POSES[:, :2, 3] = Q


def motions() -> dict[str, Any]:
    joints = fit_dmp(T, Q, n_basis=8).value
    return {
        "dmp": joints,
        "two_dof": TwoDofDmp(joints),
        "pose": fit_pose_dmp(T, POSES, n_basis=8).value,
        "periodic": fit_periodic_dmp(T, Q, period=1.0, n_basis=8).value,
        "promp": fit_promp(T, np.array([Q, 1.2 * Q]), n_basis=8).value,
    }


@pytest.mark.parametrize("kind", [kind for kind in motions() if kind != "two_dof"])
def test_every_kind_is_drawn(kind: str, tmp_path: Path, capsys) -> None:
    shown = log.write(Table(T, {"q": Q, "T_base_tool": POSES}), tmp_path / "taught.csv")
    primitive = motions()[kind].save(tmp_path / "motion.toml")
    assert main(["plot", "dmp", str(primitive), str(shown)]) == 0
    assert (tmp_path / "motion_dmp.png").stat().st_size > 1000
    assert capsys.readouterr().out == f"{tmp_path / 'motion_dmp.png'}\n"
    plt.close("all")


def test_phase_plane_and_names(tmp_path: Path, capsys) -> None:
    primitive = motions()["dmp"].save(tmp_path / "motion.toml")
    assert main(["plot", "dmp_phase", str(primitive), "-o", str(tmp_path / "b.svg")]) == 0
    assert (tmp_path / "b.svg").stat().st_size > 1000
    pose = motions()["pose"].save(tmp_path / "pose.toml")
    taught = log.write(Table(T, {"q": Q}), tmp_path / "taught.csv")
    for words, sentence in {
        ("dmp_phase", str(primitive), "-o", str(tmp_path / "b.svg")): "--force",
        ("dmp", str(primitive), "-o", str(tmp_path / "a.txt")): ".png",
        ("dmp", str(tmp_path / "none.toml")): "none.toml",
        ("dmp", str(primitive), str(taught), str(taught)): "one demonstration",
        ("dmp_phase", str(pose)): "pose_dmp",
        ("two_dof", str(pose), str(taught)): "primitive of joints",
        ("two_dof", str(primitive), str(taught)): "--firm",
    }.items():
        assert main(["plot", *words]) == (1 if sentence == "--firm" else 2)  # the log is of another run
        assert sentence in capsys.readouterr().err
    assert all(command.__doc__ for command in (dmp, dmp_phase, two_dof))
    plt.close("all")


def test_a_run_that_waited_is_drawn(tmp_path: Path, capsys) -> None:
    law = motions()["two_dof"]
    run = law.simulate(T)
    columns = {"path": run.yc, "path_qd": run.ycd, "path_qdd": run.ycdd, "path_error": run.e, "qdd_ref": run.ydd_ref}
    units = dict.fromkeys(("path", "path_error"), "rad") | {"path_qd": "rad/s"}
    units |= dict.fromkeys(("path_qdd", "qdd_ref"), "rad/s^2")
    values = columns | {"q": run.ya, "qd": run.yad, "phase": run.x, "tau_a": run.tau_a, "frozen": run.frozen * 1.0}
    described = {name: Column(unit=unit) for name, unit in units.items()}
    described |= {"phase": Column(unit="1"), "tau_a": Column(unit="s"), "frozen": Column(unit="1")}
    recording = log.write(Table(T, values, described), tmp_path / "run.csv")
    primitive = law.save(tmp_path / "law.toml")
    words = ["plot", "two_dof", str(primitive), str(recording), "--joints", "1,2"]
    assert main([*words, "--disturbed", "0.2,0.4", "--duration", "1", "--goal", "0.84,1"]) == 0
    assert (tmp_path / "run_two_dof.png").stat().st_size > 1000
    assert main([*words, "--disturbed", "0.2", "--force"]) == 2
    assert "START,END" in capsys.readouterr().err
    plt.close("all")
