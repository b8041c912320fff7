"""Contact force in many logs: the numbers of one estimator per log, whoever computes them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from armlab import contact, fleet, identify, log
from armlab.errors import LogError, ModelMismatchError
from armlab.fleet import Estimated
from armlab.robots import load


@pytest.fixture(scope="module")
def recordings(truth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log that somebody pushes in, one that nobody does, and one without torque."""
    folder = tmp_path_factory.mktemp("recordings")
    motion = identify.design_excitation(truth.robot, seconds=10, f0=0.1, speed=0.3, seed=5)

    def push(t: np.ndarray) -> np.ndarray:
        return np.where(((t > 4.0) & (t < 7.0))[:, None], [0.0, 0.0, -15.0, 0.0, 0.0, 0.0], 0.0)

    log.write(truth.log(motion, seed=6, wrench=push), folder / "pushed.mcap", truth.robot)
    log.write(truth.log(motion, seed=7), folder / "free.mcap", truth.robot)
    log.write(truth.log(motion, seed=8).without("tau"), folder / "no_torque.mcap", truth.robot)
    return folder


def test_each_log_gets_what_one_estimator_says_of_it(truth, model, recordings: Path, tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        done = fleet.estimate(recordings, model, truth.robot, tmp_path, pool)
    assert [Path(name).stem for name in done.skipped] == ["no_torque"]
    assert "none for tau" in next(iter(done.skipped.values()))
    by_name = {Path(name).stem: one for name, one in done.results.items()}
    pushed, free = by_name["pushed"], by_name["free"]
    assert isinstance(pushed, Estimated)
    assert pushed.path == tmp_path / "pushed_estimate.mcap"
    assert pushed.contacts >= 1
    assert 2.0 < pushed.contact_seconds < 4.0
    assert 10.0 < pushed.peak < 25.0
    assert (free.contacts, free.contact_seconds) == (0, 0)
    assert np.isnan(free.peak)
    assert free.left_out == 0
    given = log.read(recordings / "pushed.mcap")
    expected = contact.Estimator(model, truth.robot).run(given)["wrench_hat"]
    np.testing.assert_array_equal(log.read(pushed.path)["wrench_hat"], expected)


def test_bad_input(truth, model, recordings: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelMismatchError):
        fleet.estimate(recordings, model, load("irb120"), tmp_path)
    with pytest.raises(LogError, match="used among 1, got none"):
        fleet.estimate(recordings / "no_torque.mcap", model, truth.robot, tmp_path)
    assert not list(tmp_path.iterdir())
