"""armlab plot: a command for every figure that files can give."""

from __future__ import annotations

from armlab import plots
from armlab.cli.plot import plot

OF_ANOTHER_COMMAND = {"pose_dmp", "periodic_dmp", "promp"}  # `dmp` draws every kind of primitive
NO_FIGURES = {"png", "show"}


def test_every_figure_has_its_command() -> None:
    commands = {name for name in plot if not name.startswith("-")}
    assert commands == set(plots.__all__) - OF_ANOTHER_COMMAND - NO_FIGURES
