"""What RAPID sets has ranges, and ABB's defaults are slow."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ConfigError, UnknownName
from armlab.sim.controller.settings import ControllerSettings


def test_the_period_follows_the_mode_where_none_is_given() -> None:
    assert [ControllerSettings(mode=mode).period for mode in ("joint", "pose", "path")] == [0.004032, 0.004032, 0.024]
    assert ControllerSettings(mode="path", period=0.048).period == 0.048


def test_abb_defaults_are_slow_and_converge() -> None:
    settings = ControllerSettings.abb_defaults()
    assert settings.max_speed == pytest.approx(np.radians(1.0))
    assert settings.window == pytest.approx(np.radians(0.5))
    assert settings.condition_time == 1.0


@pytest.mark.parametrize(
    ("name", "value"),
    [("gain", 21.0), ("filter", 0.0), ("level", 3), ("period", 5e-5), ("gain", float("nan")), ("stream", np.inf)],
)
def test_settings_out_of_range(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=name):
        ControllerSettings(**{name: value})


@pytest.mark.parametrize("name", ["program", "stream_queue", "queue", "mode", "activated"])
def test_unknown_choices_are_refused(name: str) -> None:
    with pytest.raises(UnknownName, match=f"{name} of the simulated controller"):
        ControllerSettings(**{name: "sideways"})  # type: ignore[arg-type]
