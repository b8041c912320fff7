"""The regression of a load: exact without noise; two logs of one motion are brought together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import identify
from armlab.errors import ShapeError
from armlab.identify.payload import LoadRecord, moving_joints
from armlab.robots import inertia

PI = inertia.from_body(0.5, [0.03, -0.01, 0.06], np.diag([1e-3, 2e-3, 1.5e-3]))


@pytest.fixture(scope="module")
def motion(truth):
    return identify.design_excitation(truth.robot, seconds=12, speed=0.4, seed=3)


@pytest.fixture(scope="module")
def loaded(truth):
    links = truth.links.copy()
    links[-1] += inertia.transform(truth.robot.links[-1], PI)
    return replace(truth, links=links)


def test_the_load_explains_the_difference(truth, model, loaded, motion) -> None:
    """Without noise the difference of the logs is the load, to the step from one sample to the next."""
    record = LoadRecord.of(loaded.log(motion, noise=0.0), model, truth.robot, truth.log(motion, noise=0.0))
    assert record.A.shape == (*record.y.shape, 10)
    np.testing.assert_allclose(model.gains * record.y, record.A @ PI, atol=2e-3)
    assert record.against.shape == (7, 10, len(model.base_names))
    scale = np.abs(LoadRecord.of(loaded.log(motion, noise=0.0), model, truth.robot).against).max()
    assert np.abs(record.against).max() < 1e-6 * scale
    assert len(record.sources) == 2
    block = record.blocks(1.0)
    assert block[0] == 0
    assert np.all(np.isin(np.diff(block), [0, 1]))


@pytest.mark.parametrize("late", [300, -300])
def test_a_log_that_began_at_another_time(truth, model, loaded, motion, late: int) -> None:
    one, two = loaded.log(motion, noise=0.0), truth.log(motion, noise=0.0)
    if late > 0:
        two = two.rows(slice(late, None))
    else:
        one = one.rows(slice(-late, None))
    record = LoadRecord.of(one, model, truth.robot, two)
    np.testing.assert_allclose(record.y[20:-20], (record.A @ PI)[20:-20], atol=0.02)


def test_another_motion_is_refused(truth, model, loaded, motion) -> None:
    other = identify.design_excitation(truth.robot, seconds=12, speed=0.4, seed=4)
    with pytest.raises(ShapeError, match="same motion"):
        LoadRecord.of(loaded.log(motion), model, truth.robot, truth.log(other))
    thin = truth.log(motion).rows(slice(None, None, 2))
    with pytest.raises(ShapeError, match="one rate"):
        LoadRecord.of(loaded.log(motion), model, truth.robot, thin)


def test_degrees_are_refused_by_the_limits_of_the_arm(truth, model, loaded, motion) -> None:
    """The model alone knows no limits."""
    log = truth.log(motion)
    degrees = log.with_column("q", np.rad2deg(log["q"])).with_column("qd", np.rad2deg(log["qd"]))
    for pair in ((degrees, None), (loaded.log(motion), degrees)):
        with pytest.raises(ShapeError, match=r"axis_1 \(\S+, limit 2\.941: degrees"):
            LoadRecord.of(pair[0], model, truth.robot, pair[1])


def test_joints_that_move(truth, motion) -> None:
    log = truth.log(motion)
    held = log.with_column("q", np.where(np.arange(7) < 3, 0.1, log["q"]))
    assert moving_joints([held], truth.robot).tolist() == [3, 4, 5, 6]
    assert moving_joints([held, log], truth.robot).tolist() == list(range(7))
    assert moving_joints([log.with_column("q", 0.0 * log["q"])], truth.robot).tolist() == list(range(7))


def test_the_log_with_the_load_is_not_the_one_without(truth, model, loaded, motion) -> None:
    log = loaded.log(motion)
    with pytest.raises(ShapeError, match="rows of log 1 again as log 2"):
        LoadRecord.of(log, model, truth.robot, log)
