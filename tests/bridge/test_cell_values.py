"""Every value of a cell file, and whether the file says it."""

from __future__ import annotations

import pytest

from armlab.bridge.cell import cell_values
from armlab.errors import ConfigError

TEXT = """
commands = ["local"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[parameters.gain]
default = 2.0
[servers.labcomm]
rows = 9000
[sources.force]
port = 6600
period = 0.004
robot = "yumi_left"
[sources.force.fields.wrench_raw]
shape = [6]
"""


def test_values_said_and_not() -> None:
    found = {place: (value, said) for place, value, said in cell_values(TEXT)}
    assert found["commands"] == (["local"], True)
    assert found["robots[0].name"] == ("yumi_left", True)
    assert found["robots[0].speed"] == (1.0, False)
    assert found["parameters.gain.default"] == (2.0, True)
    assert found["parameters.gain.live"] == (True, False)
    assert found["servers.labcomm.rows"] == (9000, True)
    assert found["servers.labcomm.parameters"] == (7513, False)
    assert found["sources.force.fields.wrench_raw.shape"] == ((6,), True)
    assert found["record"] == (None, False)


def test_a_wrong_cell_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown field"):
        cell_values(TEXT + "\nx = 1", "my.toml")
