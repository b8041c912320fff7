"""Where the servers of a cell listen, and what is refused."""

from __future__ import annotations

import pytest

from armlab.bridge.cell import parse_cell
from armlab.bridge.listening import listening
from armlab.errors import ConfigError, UnknownName

FILE = """
commands = ["local"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[servers.labcomm]
"""


def test_listening() -> None:
    cell = parse_cell(FILE)
    assert listening([], cell) == {"labcomm": "127.0.0.1"}
    assert listening(["labcomm=0.0.0.0"], cell) == {"labcomm": "0.0.0.0"}
    assert listening(["labcomm=lo"], cell) == {"labcomm": "127.0.0.1"}
    with pytest.raises(UnknownName, match="enabled server"):
        listening(["ros=0.0.0.0"], cell)
    with pytest.raises(ConfigError, match="IPv4 address or one of the interfaces"):
        listening(["labcomm=nowhere"], cell)
    commanding = parse_cell(FILE.replace('["local"]', '["labcomm"]'))
    assert listening(["labcomm=127.0.0.2"], commanding) == {"labcomm": "127.0.0.2"}
    with pytest.raises(ConfigError, match="no place for a secret and no encryption"):
        listening(["labcomm=0.0.0.0"], commanding)
