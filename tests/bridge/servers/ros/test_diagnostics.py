"""Diagnostics: what is wrong is a warning, what is not known is said to be."""

from __future__ import annotations

import math

from armlab.bridge.servers.ros.mapping import diagnostics

COUNTS = {"rate": 250.04, "p50": 80.0, "p99": 120.0, "longest": 400.0, "missed": 0, "late": 0, "drops": 0}
COUNTS |= {"session": 2, "clamps": {"position": [0, 3], "velocity": [1, 0]}}


def test_all_is_well() -> None:
    (status,) = diagnostics("irb120", 5, COUNTS, "").status
    values = {one.key: one.value for one in status.values}
    assert (status.level, status.hardware_id) == (0, "irb120")
    assert values["rate [1/s]"] == "250.0"
    assert values["clamped samples"] == "4"
    assert values["commander"] == "nobody"


def test_an_arm_that_is_silent_is_an_error() -> None:
    for silent, level, words in ((0.9, 0, "every packet answered"), (3.21, 2, "no packet for 3.2 s")):
        (status,) = diagnostics("irb120", 5, COUNTS, "", silent=silent).status
        assert (status.level, status.message) == (level, words)
    values = {one.key: one.value for one in status.values}
    assert (values["link"], values["rate [1/s]"]) == ("no packet for 3.2 s", "0.0")
    (status,) = diagnostics("irb120", 5, COUNTS, "", silent=math.inf).status
    assert (status.level, status.message) == (2, "no packet yet")


def test_faults_are_a_warning_and_unknowns_are_said() -> None:
    faulty = {**COUNTS, "missed": 3, "drops": 1, "rate": math.nan}
    (status,) = diagnostics("irb120", 5, faulty, "labcomm 127.0.0.1:4").status
    values = {one.key: one.value for one in status.values}
    assert status.level == 1
    assert status.message == "3 packets missed, 1 packets refused"
    assert values["rate [1/s]"] == "unknown"
    assert values["commander"] == "labcomm 127.0.0.1:4"
