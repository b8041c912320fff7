"""What all calibrations have in common: rows that were measured, files that are joined, noise in words."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from armlab import models, robots, sim
from armlab.cli import main
from armlab.cli.calibrate.report import Wanted
from armlab.cli.calibrate.samples import Samples, measured_rows, noise_of, run_fit, tool_poses
from armlab.errors import ConfigError, LogError
from armlab.kinematics import forward


def samples(**values: np.ndarray) -> Samples:
    return Samples(Path("some.mat"), values, "some.mat sha256 0")


def test_several_files_are_fitted_together_and_named(tmp_path: Path, capsys) -> None:
    seen = sim.cell(5).hand_eye(N=40)
    parts = [(slice(0, 25), "one.mat"), (slice(25, 40), "two.mat")]
    for rows, name in [*parts, (slice(0, 40), "all.mat")]:
        savemat(tmp_path / name, {"T_base_tool": seen.A[rows], "T_cam_marker": seen.B[rows]})
    out = tmp_path / "camera.toml"
    files = [str(tmp_path / name) for _, name in parts]
    page = tmp_path / "camera.html"
    assert main(["calibrate", "hand-eye", *files, "--json", "-o", str(out), "--report", str(page)]) == 0
    joined = json.loads(capsys.readouterr().out)
    assert [source.split()[0] for source in joined["sources"]] == ["one.mat", "two.mat"]
    assert all(source in out.read_text(encoding="utf-8") for source in joined["sources"])
    assert "two.mat sha256" in page.read_text(encoding="utf-8")
    assert main(["calibrate", "hand-eye", str(tmp_path / "all.mat"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["parameters"] == joined["parameters"]
    assert models.load(out, "hand_eye").setup == "eye_to_hand"


def test_files_that_measured_something_else_are_refused(tmp_path: Path) -> None:
    for k, width in enumerate((3, 6)):
        savemat(tmp_path / f"{k}.mat", {"y": np.arange(4.0 * width).reshape(4, width)})
    files = [tmp_path / f"{k}.mat" for k in range(2)]
    with pytest.raises(LogError, match=r"\(4, 3\) in 0\.mat, \(4, 6\) in 1\.mat"):
        run_fit("job", files, lambda read: (read.vectors("y"),), lambda y: y, Wanted())
    with pytest.raises(ConfigError, match=r"0\.mat again"):
        run_fit("job", [files[0], files[0]], lambda read: (read.vectors("y"),), lambda y: y, Wanted())
    with pytest.raises(ConfigError, match="got none"):
        run_fit("job", [], lambda read: (read.vectors("y"),), lambda y: y, Wanted())


def test_rows_that_were_measured(capsys) -> None:
    q, a, b = np.arange(8.0).reshape(4, 2), np.array([1.0, np.nan, np.nan, 4.0]), np.array([np.nan, 2.0, np.nan, 4.0])
    got = measured_rows(samples(), (q,), (a, b))
    np.testing.assert_array_equal(got[0], q[[0, 1, 3]])
    np.testing.assert_array_equal(got[-1], [0, 1, 3])
    assert "1 of 4 rows of some.mat have no measurement" in capsys.readouterr().err
    assert len(measured_rows(samples(), (q, a))[0]) == 2
    assert len(measured_rows(samples(), (q,), (a, b), every=True)[0]) == 4
    with pytest.raises(LogError, match=r"as many samples of each kind in some\.mat, got 4, 3"):
        measured_rows(samples(), (q, a[:3]))


def test_noise_and_poses_of_the_tool() -> None:
    assert (noise_of(None), noise_of([0.1]), noise_of([0.1, 0.2])) == (None, 0.1, (0.1, 0.2))
    q = np.random.default_rng(0).uniform(-1, 1, (5, 6))
    T = forward(robots.load("irb2400"), q)
    np.testing.assert_array_equal(tool_poses(samples(q=q), "irb2400"), T)
    np.testing.assert_array_equal(tool_poses(samples(T_base_tool=T), None), T)
    with pytest.raises(LogError, match="Expected T_base_tool"):
        tool_poses(samples(q=q), None)
    with pytest.raises(LogError, match="These seem to be degrees"):
        tool_poses(samples(q=np.rad2deg(q)), "irb2400")


def test_copies_of_a_sample_count_once_and_held_values_are_told(capsys) -> None:
    seen = sim.cell(5).hand_eye(N=6)
    twice = np.repeat(np.arange(6), 2)
    A, B, rows = measured_rows(samples(), (seen.A[twice], seen.B[twice]))
    np.testing.assert_array_equal(A, seen.A)
    np.testing.assert_array_equal(B, seen.B)
    np.testing.assert_array_equal(rows, np.arange(0, 12, 2))
    assert "6 of 12 rows of some.mat are copies of others" in capsys.readouterr().err
    measured_rows(samples(), (seen.A, seen.B[[0, 0, 2, 3, 3, 5]]))
    assert "2 rows of some.mat repeat the measurement of the row before" in capsys.readouterr().err
    measured_rows(samples(), (seen.A, seen.B))
    assert capsys.readouterr().err == ""


def test_parts_of_a_measurement_are_refused_by_their_row() -> None:
    seen = sim.cell(5).hand_eye(N=6)
    B = seen.B.copy()
    B[1], B[4, 0, 3] = np.nan, np.nan
    with pytest.raises(LogError, match=r"missing in 1 of 6 rows, first in row 4"):
        measured_rows(samples(), (seen.A, B))
