"""Values from other programs: kinds of sources; parameters, their types, bounds and rights."""

from __future__ import annotations

import json
import math
import select
import socket
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge import CallableSource, Reading, Source, UdpSource
from armlab.bridge.inputs.parameters import Change, Parameter, Parameters
from armlab.bridge.inputs.sources import TICK_COLUMNS, ReplaySource, ThreadSource, TimerSource, check_source
from armlab.errors import CommandRefused, ConfigError, LinkError, ModelMismatchError, ShapeError, UnknownName
from armlab.log import Column, Table
from armlab.models import ForceSensor

FIELDS = {"p": Column((3,), unit="m"), "grip": Column(unit="N")}


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"name": "a.b"}, ConfigError, "without dots"),
        ({"fields": {}}, ConfigError, "with fields"),
        ({"fields": {"f": Column((10**27,))}}, ConfigError, "at most 1024 numbers"),
        ({"fields": {"f": Column((-1,))}}, ConfigError, r"got shape \(-1,\) of 'f' in the source"),
        ({"fields": {"age": Column(unit="s")}}, ConfigError, "other than the log's own columns, got age"),
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
    ("fields", "calibration"), [(RAW, "force.toml"), (FIELDS, SENSOR), ({**RAW, "wrench": Column((6,))}, SENSOR)]
)
def test_wrong_calibrations(fields: dict[str, Column], calibration: Any) -> None:
    with pytest.raises(ConfigError, match="ForceSensor as the calibration of the source 'force'"):
        Source("force", fields, 0.004, calibration=calibration)


def test_a_calibration_belongs_to_an_arm_of_the_run() -> None:
    arms = [robots.load("yumi_left"), robots.load("yumi_right")]
    check_source(Source("tracker", FIELDS, 0.03), arms)
    own = replace(SENSOR, robot_name="yumi_left", robot_hash=arms[0].hash)
    source = Source("force", RAW, 0.004, calibration=own)
    assert source.robot == "yumi_left"
    check_source(source, arms)
    check_source(Source("force", RAW, 0.004, calibration=SENSOR), arms[:1])
    with pytest.raises(ConfigError, match=r"robot= of the force sensor 'force' to be one of yumi_left, yumi_right"):
        check_source(Source("force", RAW, 0.004, calibration=SENSOR), arms)
    with pytest.raises(
        ModelMismatchError, match="'force' to belong to a robot of this run, got a calibration of 'yumi_left'"
    ):
        check_source(source, arms[1:])
    with pytest.raises(ModelMismatchError):
        check_source(Source("force", RAW, 0.004, calibration=own, robot="yumi_right"), arms)


def test_values() -> None:
    source = Source("tracker", FIELDS, 0.03)
    assert source.max_age == pytest.approx(0.09)
    assert Source("force", FIELDS, 0.001).max_age == 0.02
    values = source.values({"p": [1, 2, 3]})
    np.testing.assert_array_equal(values["p"], [1.0, 2.0, 3.0])
    assert np.isnan(values["grip"])
    assert not values["p"].flags.writeable
    for wrong, error, words in (
        ({"q": 1.0}, UnknownName, "field of the source 'tracker'"),
        ({"p": [1.0]}, ConfigError, r"p of shape \(3,\) from the source 'tracker', got \(1,\)"),
        ({"grip": "high"}, ConfigError, "numbers in grip"),
    ):
        with pytest.raises(error, match=words):
            source.values(wrong)
    assert set(TICK_COLUMNS) == {"age", "gaps", "seq", "source_time", "delay"}


def test_a_function_in_a_thread() -> None:
    calls = threading.Semaphore(0)
    given: list[Any] = []

    def function() -> Any:
        calls.release()
        return given.pop(0) if given else {"grip": 3.0}

    source = CallableSource("hand", FIELDS, function, 0.001)
    assert isinstance(source, ThreadSource)
    assert source.newest() is None
    for _ in range(2):  # it starts again
        given[:] = [{"grip": 1.0}, None, {"grip": "high"}, {"grip": 2.0}]
        source.problem = ""
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
        time.sleep(0.01)
        assert source.newest() is reading, "its thread has ended"
        while calls.acquire(blocking=False):
            pass
    with pytest.raises(NotImplementedError):
        ThreadSource("none", FIELDS, 0.001).work()


def test_timer() -> None:
    timer = TimerSource("clock", 0.001)
    timer.start()
    first = timer.newest()
    time.sleep(0.003)
    second = timer.newest()
    assert second.seq - first.seq >= 2
    assert second.receive_ns - first.receive_ns == (second.seq - first.seq) * 1_000_000
    assert second.values["count"] == second.seq


MS = 1_000_000


def recording() -> Table:
    """Return five ticks 4 ms apart; tracker readings arrived before the second and before the fifth tick."""
    nan = np.nan
    numbers = {
        "age": [nan, 0.001, 0.005, 0.009, 0.002],
        "gaps": [nan, 0.0, 0.0, 0.0, 3.0],
        "seq": [nan, 7.0, 7.0, 7.0, 11.0],
        "source_time": [nan, 0.5, 0.5, 0.5, nan],
        "delay": [nan, 0.0, 0.0, 0.0, nan],
        "p": [nan, 1.0, 1.0, 1.0, 2.0],
    }
    values: dict[str, np.ndarray] = {f"tracker.{name}": np.array(column) for name, column in numbers.items()}
    columns = {name: Column(unit="1") for name in values} | {"tracker.p": Column(unit="m")}
    values["receive_ns"] = 10**18 + 4 * MS * np.arange(5)
    return Table(0.004 * np.arange(5), values, columns)


def test_readings_come_when_they_came() -> None:
    source = ReplaySource("tracker", recording(), 1 / 30)
    assert (source.fields["p"].unit, [*source.fields]) == ("m", ["p"])
    start, got = 10**12, []
    for tick in range(7):
        source.now_ns = start + 4 * MS * tick
        got.append(source.newest())
    assert got[0] is None
    read = [(one.values["p"], one.seq, one.gaps, one.source_ns) for one in got[1:5]]
    assert read == [(1.0, 7, 0, 500 * MS)] * 3 + [(2.0, 11, 3, 0)]
    assert {one.receive_ns for one in got[1:4]} == {start + 3 * MS}
    assert got[4] is got[6]


UDP_FIELDS = {"wrench": Column((6,))}
LAYOUT = {"seq": "<u4", "stamp_ns": "<i8", "wrench": "<f8"}
PACK = struct.Struct("<Iq6d")


class Sender:
    def __init__(self, source: UdpSource) -> None:
        self.source = source
        source.start()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def __call__(self, *data: bytes) -> None:
        for one in data:
            self.socket.sendto(one, (self.source.host, self.source.port))

    def close(self) -> None:
        self.source.close()
        self.socket.close()


@pytest.fixture
def force() -> Iterator[Sender]:
    sender = Sender(UdpSource("force", UDP_FIELDS, 0.001, 0, LAYOUT))
    yield sender
    sender.close()


def test_the_newest_counts_and_gaps_are_counted(force: Sender) -> None:
    assert force.source.newest() is None
    force(PACK.pack(2, 20, *np.zeros(6)))
    force.source.newest()
    force(*(PACK.pack(seq, 10 * seq, *np.arange(6.0) + seq) for seq in (3, 4, 7)))
    reading = force.source.newest()
    assert (reading.seq, reading.source_ns, reading.gaps) == (7, 70, 2)
    assert 0 <= time.monotonic_ns() - reading.receive_ns < 10**9, "arrival time on the local clock"
    np.testing.assert_array_equal(reading.values["wrench"], np.arange(6.0) + 7)
    assert force.source.newest() is reading
    force(PACK.pack(0, 5, *np.zeros(6)))
    restarted = force.source.newest()
    assert (restarted.seq, restarted.gaps) == (0, 2)


@pytest.mark.parametrize("number", ["1" + "0" * 400, "1e400", "NaN", "18446744073709551616", '"1"', "null", "[1]"])
def test_numbers_beyond_64_bits_are_dropped(number: str) -> None:
    """Each of these numbers once ended a run: the log stores numbers as floats, and stamps are mapped."""
    sender = Sender(UdpSource("force", {"p": Column(unit="m")}, 0.001, 0))
    for name in ("seq", "stamp_ns"):
        sender(b'{"p": 1.0, "%s": %s}' % (name.encode(), number.encode()))
        assert sender.source.newest() is None
    assert sender.source.drops == 2
    sender(b'{"p": 2.0, "seq": -18446744073709551615}')
    sender.source.newest()
    sender(b'{"p": 2.0, "seq": 18446744073709551615}')
    reading = sender.source.newest()
    assert reading.gaps == 2**53
    sender.close()


def test_json() -> None:
    sender = Sender(UdpSource("force", UDP_FIELDS, 0.001, 0))
    sender(json.dumps({"wrench": [1, 2, 3, 4, 5, 6]}).encode())
    first = sender.source.newest()
    sender(json.dumps({"wrench": [0] * 6, "seq": 5, "stamp_ns": 12}).encode(), b'{"torque": 1}', b"[1]", b"{")
    second = sender.source.newest()
    assert (first.seq, first.source_ns, second.seq, second.source_ns) == (0, 0, 5, 12)
    assert sender.source.drops == 3
    assert "invalid datagram" in sender.source.problem
    sender.close()


@settings(max_examples=50)
@given(data=st.binary(max_size=200))
def test_any_datagram_is_a_reading_or_a_drop(data: bytes) -> None:
    for layout in (LAYOUT, "json"):
        source = UdpSource("force", UDP_FIELDS, 0.001, 0, layout)  # type: ignore[arg-type]
        source._take(data, 1, 1)
        assert (source.newest() is None) == (source.drops == 1)


def test_what_came_before_the_start_is_not_there_and_a_port_in_use_is_refused(force: Sender) -> None:
    force(PACK.pack(0, 0, *np.zeros(6)))
    force.source.close()
    force.source.start()
    assert not select.select([force.source._port], [], [], 0.0)[0]
    with pytest.raises(LinkError, match="in use"):
        UdpSource("other", UDP_FIELDS, 0.001, force.source.port).start()


@pytest.mark.parametrize(
    "layout", [{"seq": "<u4"}, {"wrench": "<f8", "torque": "<f8"}, {"wrench": "U3"}, {"wrench": "no type"}]
)
def test_wrong_layouts(layout: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="layout"):
        UdpSource("force", UDP_FIELDS, 0.001, 0, layout)


def cell() -> Parameters:
    return Parameters(
        [
            Parameter("gain", 2.0, unit="N/m", minimum=0.0, maximum=10.0, text="Stiffness."),
            Parameter("count", 3, "int", minimum=0, maximum=5),
            Parameter("gentle", True, "bool", rights="anyone"),
            Parameter("label", "a", "text"),
            Parameter("force", [0.0, 0.0, 1.0], "float[3]", minimum=-5.0, maximum=5.0),
            Parameter("mass", 1.0, live=False),
        ]
    )


def test_values_come_into_force_between_ticks_in_the_order_of_their_setters() -> None:
    params, force = cell(), np.ones(3)
    assert params.last("gain") is None
    params.set("gain", 1, "one")
    params.set_together({"gain": 4.0, "count": 5}, "two")
    params.set("force", force)
    force[0] = 4.0
    assert params.gain == 2.0
    changes = params.apply()
    assert changes[:3] == (Change(1, "gain", 1.0, "one"), Change(2, "gain", 4.0, "two"), Change(3, "count", 5, "two"))
    assert changes[0].sentence == "Parameter gain = 1.0, set by one (setting 1)."
    assert changes[3].who == "controller"
    assert isinstance(changes[0].value, float)
    assert params.apply() == ()
    assert params.gain == params.values()["gain"] == 4.0
    np.testing.assert_array_equal(params.force, np.ones(3))
    assert not params.force.flags.writeable
    assert params.last("gain") == changes[1]
    assert params.last("gentle") is None
    with pytest.raises(UnknownName, match="parameter"):
        params.last("nothing")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("gain", math.nan, "finite number for the parameter gain \\[N/m\\], got nan"),
        ("gain", 11, "from 0 to 10"),
        ("gain", "3", "finite number"),
        ("gain", True, "finite number"),
        ("gain", 10**400, "from 0 to 10"),
        pytest.param("gain", -(10**5000), "The value is unchanged", id="unprintable"),
        ("count", 10**400, "The value is unchanged"),
        ("force", [10**400, 1.0, 1.0], "The value is unchanged"),
        ("count", 2.5, "whole number"),
        ("count", 6, "from 0 to 5"),
        ("gentle", 1, "true or false"),
        ("label", 1, "Expected text of at most 1000 characters"),
        ("label", "x" * 1001, "at most 1000"),
        ("force", [1.0, 2.0], "3 finite numbers"),
        ("force", [1.0, 2.0, math.inf], "3 finite numbers"),
        ("force", [1.0, 2.0, 6.0], "from -5 to 5"),
        ("force", [[1.0], [2.0, 3.0]], "3 finite numbers"),
        ("force", "abc", "3 finite numbers"),
        ("force", [True, False, True], "3 finite numbers"),
        ("force", 1.0, "3 finite numbers"),
    ],
)
def test_refused_values(name: str, value: Any, words: str) -> None:
    params = cell()
    with pytest.raises(CommandRefused, match=words):
        params.set_together({"gentle": False, name: value})
    assert params.apply() == ()
    assert params.gentle is True


def test_rights_and_live() -> None:
    params = cell()
    with pytest.raises(CommandRefused, match="commander of an arm to set gain, got web"):
        params.set_together({"gain": 1.0}, "web", commander=False)
    params.set_together({"gentle": False}, "web", commander=False)
    params.set("mass", 2.0)
    params.running = True
    with pytest.raises(CommandRefused, match="before a run"):
        params.set("mass", 3.0)
    params.apply()
    assert (params.gentle, params.mass) == (False, 2.0)


def test_unknown_names_and_a_flood_of_settings() -> None:
    params = cell()
    with pytest.raises(UnknownName, match=r"'gan'.*gain"):
        params.set("gan", 1.0)
    with pytest.raises(AttributeError, match=r"'gan'.*gain"):
        params.gan
    assert not hasattr(params, "__deepcopy__")
    for _ in range(256):
        params.set("gain", 1.0)
    with pytest.raises(CommandRefused, match="at most 256 settings"):
        params.set("gain", 1.0)
    assert len(params.apply()) == 256


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"name": "2x"}, "unused parameter name"),
        ({"name": "set"}, "unused"),
        ({"name": None}, "unused parameter name"),
        ({"type": "double"}, "to be float, int"),
        ({"type": "float[0]"}, "to be float, int"),
        ({"rights": "all"}, "rights"),
        ({"minimum": 1.0, "maximum": 0.0}, "minimum <= maximum"),
        ({"minimum": math.nan}, "minimum <= maximum"),
        ({"default": "a"}, "a valid default"),
        ({"minimum": 3.0}, "from 3 to inf"),
    ],
)
def test_wrong_declarations(fields: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Parameter(**{"name": "x", "default": 1.0, **fields})
    with pytest.raises(ConfigError, match="each parameter once"):
        Parameters([Parameter("a", 1.0), Parameter("a", 2.0)])


anything = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-9, 9),
    st.floats(),
    st.sampled_from(["", "up", 10**400]),
    st.lists(st.floats(), max_size=4),
)


@given(st.dictionaries(st.sampled_from(["gain", "count", "gentle", "label", "force", "x"]), anything, max_size=3))
def test_what_is_in_force_is_always_valid(values: dict[str, Any]) -> None:
    params = cell()
    before = params.values()
    try:
        params.set_together(values)
        accepted = True
    except (CommandRefused, UnknownName):
        accepted = False
    params.apply()
    for name, parameter in params.declared.items():
        parameter._checked(getattr(params, name))
        if not accepted:
            assert np.array_equal(getattr(params, name), before[name])


@pytest.mark.parametrize(
    ("absent", "told"),
    [(["source_time", "delay"], (11, 3, 0)), (["seq"], (0, 3, 0)), (["gaps"], (11, 0, 0))],
)
def test_a_recording_of_another_program_may_lack_columns(absent: list[str], told: tuple[int, int, int]) -> None:
    source = ReplaySource("tracker", recording().without(*(f"tracker.{name}" for name in absent)), 1 / 30)
    source.now_ns = 0
    assert source.newest() is None
    source.now_ns = 16 * MS
    reading = source.newest()
    assert (reading.values["p"], reading.seq, reading.gaps, reading.source_ns) == (2.0, *told)
    with pytest.raises(UnknownName, match=r"source in this recording.*tracker"):
        ReplaySource("force", recording(), 0.001)
