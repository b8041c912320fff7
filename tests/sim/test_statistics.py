"""Counters and quantiles of the simulated controller."""

from __future__ import annotations

import json

import numpy as np
import pytest

from armlab.sim.controller.statistics import ControllerEvent, Statistics


def test_round_trips_leave_out_the_first_second() -> None:
    statistics = Statistics()
    statistics.trip(0.024, uptime=0.5)
    statistics.trip(0.024, uptime=0.999)
    for microseconds in range(1, 101):
        statistics.trip(microseconds * 1e-6, uptime=2.0)
    trips = statistics.as_dict()["round_trip_us"]
    assert trips["p50"] == pytest.approx(50.5)
    assert trips["max"] == pytest.approx(100.0)


def test_everything_is_plain_json() -> None:
    statistics = Statistics()
    statistics.counts["packets"] += 3
    statistics.drops["unparsable"] += 1
    statistics.queue[1] += 2
    statistics.age[1] += 2
    statistics.late(1e-4, uptime=2.0)
    statistics.events.append(ControllerEvent(0.5, "yumi_left", 41822, "No data"))
    data = json.loads(json.dumps(statistics.as_dict()))
    assert data["counts"] == {"packets": 3}
    assert data["drops"] == {"unparsable": 1}
    assert data["queue_depth"] == {"1": 2}
    assert data["reference_age"] == {"1": 2, "last": 0}
    assert data["wake_up_late_us"]["p50"] == pytest.approx(100.0)
    assert data["round_trip_us"] == {}
    assert data["events"] == [{"t": 0.5, "task": "yumi_left", "number": 41822, "text": "No data"}]


def test_an_event_is_one_line() -> None:
    assert str(ControllerEvent(1.25, "yumi_left", 41822, "No data")) == "1.250 s yumi_left 41822 No data"
    assert str(ControllerEvent(1.25, "yumi_left", 0, "dropped")) == "1.250 s yumi_left - dropped"


def test_line_names_what_was_dropped() -> None:
    statistics = Statistics()
    statistics.drops["no header"] += 2
    assert "dropped: 2 no header" in statistics.line()
    assert "round trip" not in statistics.line()


def test_missed_and_lateness_leave_out_the_first_second() -> None:
    statistics = Statistics()
    for uptime in (0.5, 1.5, 2.5):
        statistics.miss(uptime)
        statistics.late(1e-3 * uptime, uptime)
    data = statistics.as_dict()
    assert data["counts"]["missed"] == 2
    assert data["wake_up_late_us"]["max"] == pytest.approx(2500.0)


def test_text_has_a_line_per_kind() -> None:
    statistics = Statistics()
    statistics.mtypes[3] += 2
    statistics.queue[1] += 2
    lines = statistics.text().splitlines()
    assert any(line.split() == ["mtypes", "3:", "2"] for line in lines)
    assert any("round trip us" in line and "nothing" in line for line in lines)


def test_what_was_heard_beside_the_joints() -> None:
    statistics = Statistics()
    statistics.heard(None, None, None)
    statistics.heard(np.array([7.0, 8.5]), True, None)
    statistics.heard(None, None, np.array([0.5]))
    data = statistics.as_dict()
    assert data["rapid"] == {"1": 7.0, "2": 8.5, "digital": 1.0}
    assert data["external_axes"] == {"1": 0.5}
    assert data["counts"] == {"RAPID data": 1, "RAPID digital": 1, "external axes": 1}


def test_work_and_overruns_leave_out_the_first_second() -> None:
    statistics = Statistics()
    statistics.worked(0.5, 3, 0.5)
    statistics.worked(0.001, 0, 1.5)
    statistics.worked(0.005, 1, 2.5)
    data = statistics.as_dict()
    assert data["counts"] == {"overruns": 1}
    assert data["work_us"]["max"] == pytest.approx(5000.0)
