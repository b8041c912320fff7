"""A LabComm server as a source: its newest sample, whatever it is called."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab.bridge.servers.labcomm import ArmChannel, LabCommServer, ParameterChannel
from armlab.bridge.servers.labcomm.client import LabCommSource
from armlab.errors import ConfigError
from armlab.log import Column
from armlab.wire.labcomm import Prim, Sample

from .conftest import Started, row, until

Start = Callable[..., Started]
FIELDS = {"pos": Column((7,), "rad"), "trq": Column((7,), "N m")}


def test_the_newest_sample_is_the_reading(start: Start) -> None:
    one = start(ArmChannel("left", 0, order="chain"))
    source = LabCommSource("arm", FIELDS, 0.004, one.server.ports["left"], sample="robot_row")
    assert source.newest() is None
    source.start()
    until(lambda: one.server.counts["left"]["clients"] == 1)
    for tm in (1, 2, 3):
        one.server.row("left", row(tm))
    until(lambda: (source.newest() or [None] * 4)[3] == 2)
    reading: Any = source.newest()
    assert np.array_equal(reading.values["pos"], row(3).q)
    assert np.array_equal(reading.values["trq"], row(3).tau)
    assert (reading.source_ns, reading.gaps) == (3_000_000, 0)
    source.close()


def test_it_connects_again_and_says_what_is_wrong(start: Start) -> None:
    one = start(ArmChannel("left", 0))
    port = one.server.ports["left"]
    source = LabCommSource("arm", FIELDS, 0.004, port)
    source.start()
    until(lambda: one.server.counts["left"]["clients"] == 1)
    one.server.close()
    until(lambda: "closed the connection" in source.problem or "Start it" in source.problem)
    again = LabCommServer([ArmChannel("left", port)])
    until(lambda: again.counts["left"]["clients"] == 1)
    again.row("left", row(4))
    until(source.newest)
    again.close()
    source.close()


@pytest.mark.parametrize("stamp", [float("nan"), float("inf"), 1e300, "2", "2" * 60_000, [1], None])
def test_a_clock_that_is_no_number_is_told(stamp: Any) -> None:
    source = LabCommSource("arm", {"q": Column((2,), "rad")}, 0.004, 1)
    for value in ({"q": [0.0, 1.0], "t_us": stamp}, {"q": [0.0, 1.0], "tm": stamp}):
        source._take(Sample(64, "row", value, Prim("double")))
        assert source.newest() is None
        assert "at most 64 bits" in source.problem
    source._take(Sample(64, "row", {"q": [0.0, 1.0], "tm": 1.5}, Prim("double")))
    reading: Any = source.newest()
    assert reading.source_ns == 1_500_000


def test_numbers_and_other_samples(start: Start) -> None:
    one = start(ParameterChannel({"force": [1.0, 2.0], "other": 3.0}, 0, mode="all"))
    port = one.server.ports["parameters"]
    source = LabCommSource("sensor", {"f": Column((2,), "N")}, 0.01, port, sample="force")
    wrong = LabCommSource("sensor", {"f": Column((3,), "N")}, 0.01, port, sample="force")
    missing = LabCommSource("sensor", FIELDS, 0.01, port, sample="other")
    for each in (source, wrong, missing):
        each.start()
    until(lambda: source.newest() and wrong.problem and missing.problem)
    for each in (source, wrong, missing):
        each.close()
    reading: Any = source.newest()
    assert reading.values["f"].tolist() == [1.0, 2.0]
    assert "shape (3,)" in wrong.problem
    assert "trq" in missing.problem
    with pytest.raises(ConfigError, match="without dots"):
        LabCommSource("a.b", FIELDS, 0.01, port)
