"""armlab plot table, poses, scene, latency, wrench, wrenches, observability: what is in the log is drawn."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import log
from armlab.cli import main
from armlab.cli.plot import logs as plot_logs
from armlab.lie import se3
from armlab.log import Column, Table

N = 50
T = np.linspace(0.0, 1.0, N)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A log with what these figures need."""
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
def drawn(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """What would have been written, by the name of the file."""
    found: dict[str, Any] = {}
    monkeypatch.setattr("armlab.cli.support.output.save_figure", lambda figure, path: found.update({path.name: figure}))
    yield found
    plt.close("all")


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


def test_answers_of_the_loop(run: Path, drawn: dict[str, Any]) -> None:
    assert main(["plot", "latency", str(run)]) == 0
    assert f"{N} ticks" in drawn["run_latency.png"].get_title(loc="left")


def test_estimated_forces(run: Path, drawn: dict[str, Any], tmp_path: Path, capsys) -> None:
    table = log.read(run)
    for name in ("wrench", "observability"):
        assert main(["plot", name, str(run)]) == 0
    assert np.array_equal(drawn["run_wrench.png"].axes[0].lines[0].get_ydata(), table["wrench_hat"][:, 0])
    weak = drawn["run_observability.png"].axes[0].lines[0]
    assert np.array_equal(weak.get_ydata(), table["observability"][:, 0])
    other = log.write(table, tmp_path / "other.csv")
    assert main(["plot", "wrenches", str(run), str(other)]) == 0
    assert [ax.get_title(loc="left") for ax in drawn["run_wrenches.png"].axes[:2]] == ["run", "other"]
    bare = log.write(table.select("q"), tmp_path / "bare.csv")
    for words, (code, sentence) in {
        ("wrench", str(bare)): (1, "armlab estimate ROBOT LOG"),
        ("observability", str(bare)): (1, "column observability"),
        ("wrenches",): (2, "one per arm, got none"),
        ("wrenches", str(run), str(run)): (2, "different names"),
        ("scene",): (2, "--cloud"),
        ("poses", str(bare)): (1, "--robot NAME"),
        ("latency", str(bare)): (1, "receive_ns"),
        ("table", str(bare), "tau"): (2, "Known: q"),
        ("table", str(tmp_path / "none.mcap")): (1, "none.mcap"),
    }.items():
        assert main(["plot", *words]) == code
        assert sentence in capsys.readouterr().err
    assert all(getattr(plot_logs, name).__doc__ for name in plot_logs.__all__)
