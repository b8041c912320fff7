"""Kinds of sources."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge import CallableSource, Reading, Source, TimerSource
from armlab.bridge.inputs.sources import TICK_COLUMNS, ThreadSource, whole
from armlab.errors import ConfigError, ModelMismatchError, ShapeError, UnknownName
from armlab.log import Column
from armlab.models import ForceSensor

FIELDS = {"p": Column((3,), unit="m"), "grip": Column(unit="N")}


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"name": "a.b"}, ConfigError, "without dots"),
        ({"fields": {}}, ConfigError, "with fields"),
        ({"fields": {"f": Column((10**27,))}}, ConfigError, "at most 1024 numbers"),
        ({"fields": {"f": Column((-1,))}}, ConfigError, r"the shape \(-1,\) of 'f' in the source"),
        (
            {"fields": {"age": Column(unit="s")}},
            ConfigError,
            "other names than those of the log's own columns, got age",
        ),
        ({"fields": {"p": Column((3,))}}, ShapeError, "unit"),
        ({"period": 0.0}, ConfigError, "above 0 s, got 0.0"),
        ({"max_age": float("nan")}, ConfigError, "max_age"),
        ({"role": "leading"}, UnknownName, "role of a source"),
    ],
)
def test_wrong_sources(options: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        Source(**{"name": "tracker", "fields": FIELDS, "period": 0.03, **options})


RAW = {"wrench_raw": Column((6,))}
SENSOR = ForceSensor(np.eye(3), 1.0, np.zeros(3), np.zeros(6))


@pytest.mark.parametrize(
    ("fields", "calibration"),
    [
        (RAW, "force.toml"),
        (FIELDS, SENSOR),
        ({**RAW, "wrench": Column((6,))}, SENSOR),
    ],
)
def test_wrong_calibrations(fields: dict[str, Column], calibration: Any) -> None:
    with pytest.raises(ConfigError, match="ForceSensor as the calibration of the source 'force'"):
        Source("force", fields, 0.004, calibration=calibration)


def test_a_calibration_belongs_to_an_arm_of_the_run() -> None:
    arms = [robots.load("yumi_left"), robots.load("yumi_right")]
    Source("tracker", FIELDS, 0.03).check(arms)
    own = replace(SENSOR, robot_name="yumi_left", robot_hash=arms[0].hash)
    source = Source("force", RAW, 0.004, calibration=own)
    assert source.robot == "yumi_left"
    source.check(arms)
    Source("force", RAW, 0.004, calibration=SENSOR).check(arms[:1])
    with pytest.raises(ConfigError, match=r"robot= of the force sensor 'force', one of yumi_left, yumi_right"):
        Source("force", RAW, 0.004, calibration=SENSOR).check(arms)
    with pytest.raises(ModelMismatchError, match="'force' to be of a robot of this run, got one of 'yumi_left'"):
        source.check(arms[1:])
    with pytest.raises(ModelMismatchError):
        Source("force", RAW, 0.004, calibration=own, robot="yumi_right").check(arms)


def test_values() -> None:
    source = Source("tracker", FIELDS, 0.03)
    assert source.max_age == pytest.approx(0.09)
    assert Source("force", FIELDS, 0.001).max_age == 0.02
    values = source.values({"p": [1, 2, 3]})
    np.testing.assert_array_equal(values["p"], [1.0, 2.0, 3.0])
    assert np.isnan(values["grip"])
    assert not values["p"].flags.writeable
    for given, error, words in (
        ({"q": 1.0}, UnknownName, "field of the source 'tracker'"),
        ({"p": [1.0]}, ConfigError, r"p of shape \(3,\) from the source 'tracker', got \(1,\)"),
        ({"grip": "high"}, ConfigError, "numbers in grip"),
    ):
        with pytest.raises(error, match=words):
            source.values(given)
    assert set(TICK_COLUMNS) == {"age", "gaps", "seq", "source_time", "delay"}


def test_a_function_in_a_thread() -> None:
    calls = threading.Semaphore(0)
    given: list[Any] = [{"grip": 1.0}, None, {"grip": "high"}, {"grip": 2.0}]

    def function() -> Any:
        calls.release()
        return given.pop(0) if given else {"grip": 3.0}

    source = CallableSource("hand", FIELDS, function, 0.001)
    assert source.newest() is None
    source.start()
    for _ in range(6):
        assert calls.acquire(timeout=5.0)
    source.close()
    reading = source.newest()
    assert isinstance(reading, Reading)
    assert reading.values["grip"] == 3.0
    assert reading.receive_ns <= time.monotonic_ns()
    assert reading.seq >= 2
    assert "numbers in grip" in source.problem


def test_timer() -> None:
    timer = TimerSource("clock", 0.001)
    timer.start()
    first = timer.newest()
    assert first is not None
    time.sleep(0.003)
    second = timer.newest()
    assert second is not None
    assert second.seq - first.seq >= 2
    assert second.receive_ns - first.receive_ns == (second.seq - first.seq) * 1_000_000
    assert second.values["count"] == second.seq


def test_a_source_with_a_thread_of_its_own_ends_it_and_starts_again() -> None:
    class Counting(ThreadSource):
        def work(self) -> None:
            seq = 0
            while not self._over.wait(0.001):
                self._newest, seq = Reading(self.values({"grip": seq}), 0, time.monotonic_ns(), seq), seq + 1

    source = Counting("count", FIELDS, 0.001)
    assert source.newest() is None
    for _ in range(2):
        before = source.newest()
        source.start()
        end = time.monotonic() + 5.0
        while source.newest() is before and time.monotonic() < end:
            time.sleep(0.001)
        source.close()
        assert source.newest() is not before
        kept = source.newest()
        time.sleep(0.01)
        assert source.newest() is kept
    with pytest.raises(NotImplementedError):
        ThreadSource("none", FIELDS, 0.001).work()


@pytest.mark.parametrize(
    ("number", "unit", "wanted"),
    [
        (5, 1, 5), (1.75, 1000, 1750), (True, 1, 1), (np.uint8(200), 1000, 200_000), (np.float32(2.5), 1000, 2500),
        (-(2**64) + 1, 1, -(2**64) + 1), (np.uint64(2**64 - 1), 1, 2**64 - 1), (2**53 + 1, 1000, 1000 * (2**53 + 1)),
    ],
)  # fmt: skip
def test_whole_numbers(number: Any, unit: int, wanted: int) -> None:
    assert whole(number, unit) == wanted
    assert type(whole(number, unit)) is int


@pytest.mark.parametrize("number", [np.nan, np.inf, 2**64, 2**60, 1e300, 10**400, "5", None, [5], 1j, np.zeros(1)])
def test_what_is_no_whole_number(number: Any) -> None:
    with pytest.raises(ValueError, match="at most 64 bits, got"):
        whole(number, 1000)
