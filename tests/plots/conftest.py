"""Figures are drawn off-screen and closed after each test; the synthetic arm has only three joints, to save time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes

from armlab import identify, robots
from armlab.estimation import Fit
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.friction import Friction

Spans = Callable[[Axes], list[tuple[float, float]]]


@pytest.fixture(autouse=True)
def _closed_figures() -> Iterator[None]:
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    yield
    plt.close("all")


@pytest.fixture
def spans() -> Spans:
    def found(ax: Axes) -> list[tuple[float, float]]:
        paths = [path for part in ax.collections if part.get_gid() == "shade" for path in part.get_paths()]
        return [(float(path.vertices[:, 0].min()), float(path.vertices[:, 0].max())) for path in paths]

    return found


@pytest.fixture(scope="session")
def truth(truth: Any) -> Any:
    limits = {"q_min": [-2.0, -1.5, -2.0], "q_max": [2.0, 1.5, 2.0], "qd_max": [2.0] * 3, "qdd_max": [10.0] * 3}
    robot = robots.from_dh("three", [np.pi / 2, 0, np.pi / 2], [0, 0.4, 0.1], [0.3, 0, 0.3], tau_max=[40] * 3, **limits)
    friction = Friction(**{field.name: getattr(truth.friction, field.name)[:3] for field in fields(Friction)})
    parts = {name: getattr(truth, name)[:3] for name in ("links", "rotor", "noise")}
    return replace(truth, robot=robot, friction=friction, **parts)


@pytest.fixture(scope="session")
def excited(truth: Any) -> Table:
    return truth.log(identify.design_excitation(truth.robot, seconds=12, seed=1), seed=1)


@pytest.fixture(scope="session")
def fitted(truth: Any, excited: Table) -> Fit[TorqueModel]:
    return identify.fit_dynamics(excited, truth.robot)


@pytest.fixture(scope="session")
def model(fitted: Fit[TorqueModel]) -> TorqueModel:
    return fitted.value
