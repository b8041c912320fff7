"""The newest reading of every source at each tick: ages, gaps, staleness, clocks."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from armlab import bridge, kinematics, robots
from armlab.bridge import Held, Reading, Source
from armlab.bridge.inputs.fusion import ClockMap, Fusion
from armlab.bridge.inputs.sources import ReplaySource, TimerSource
from armlab.errors import ConfigError
from armlab.log import Column
from armlab.models import ForceSensor
from armlab.robots import Robot
from armlab.state import Command, State

MS = 1_000_000
P = {"p": Column(unit="m")}


class Scripted(Source):
    """Readings at given times; the result of `newest` depends only on the time of the tick."""

    def __init__(self, name: str, times_ns: np.ndarray, clock_ns: int = 0, lost: tuple[int, ...] = (), **options: Any):
        super().__init__(name, P, **options)
        kept = [seq for seq in range(len(times_ns)) if seq not in lost]
        self.arrivals = times_ns[kept]
        self.readings = []
        for row, seq in enumerate(kept):
            receive = int(times_ns[seq])
            values = self.values({"p": float(seq)})
            self.readings.append(Reading(values, receive - clock_ns, receive, seq, seq - row))

    def newest(self) -> Reading | None:
        row = int(np.searchsorted(self.arrivals, self.now_ns, side="right")) - 1
        return self.readings[row] if row >= 0 else None


def scripts(seconds: float) -> list[Scripted]:
    """Return a force sensor at 1 kHz, and a tracker at 30 Hz with jitter, lost frames and a gap of 2 s."""
    rng = np.random.default_rng(3)
    force = np.arange(0, int(1e9 * seconds), MS) + rng.integers(0, MS // 20, int(1e3 * seconds))
    frames = np.arange(0, int(1e9 * seconds), 33_333_333)
    stall = (frames > 3e9) & (frames < 5e9)
    track = (frames + rng.integers(0, 12 * MS, len(frames)))[~stall]
    return [
        Scripted("force", force, clock_ns=10**15, period=0.001, role="required"),
        Scripted("tracker", track, lost=(5, 6, 40), period=1 / 30),
    ]


def test_ages_of_the_specified_cell() -> None:
    """For two arms at 4.032 and 4.000 ms, ages, freshness, gaps and staleness match the truth to within 0.2 ms."""
    made, fusion = scripts(8.0), [Fusion(scripts(8.0)) for _ in range(2)]
    for one, period in zip(fusion, (4_032_000, 4_000_000), strict=True):
        last: dict[str, int] = {}
        for now in range(100 * MS, int(7.9e9), period):
            held = one.tick(now)
            for source in made:
                got = held[source.name]
                row = int(np.searchsorted(source.arrivals, now, side="right")) - 1
                truth = 1e-9 * (now - source.arrivals[row])
                assert abs(got.age - truth) < 0.2e-3
                assert got.fresh == (last.get(source.name) != row)
                assert got.stale == (truth > source.max_age)
                assert np.isnan(got["p"]) == got.stale
                assert got.kept["p"] == source.readings[row].values["p"]
                assert got.gaps == source.readings[row].gaps
                last[source.name] = row
            assert one.missing == ""
            assert abs(held["force"].mapped_ns - held["force"].receive_ns) < 0.2 * MS


def test_stale_sources_are_told_and_a_required_one_is_missing() -> None:
    told: list[str] = []
    source = Scripted("force", np.array([0, MS, 100 * MS, 101 * MS]), period=0.001, role="required")
    fusion = Fusion([source], lambda text, warn=False: told.append(text))
    never = Fusion([Scripted("late", np.array([10 * MS]), period=0.001, role="required")])
    held = never.tick(0)["late"]
    assert isinstance(held, Held)
    assert (held.age, held.fresh, held.stale, held.receive_ns) == (float("inf"), False, True, 0)
    assert np.isnan(held["p"])
    assert never.missing == "late"
    missing = []
    for now in (2 * MS, 20 * MS, 22 * MS, 60 * MS, 101 * MS):
        fusion.tick(now)
        missing.append(fusion.missing)
    assert missing == ["", "", "force", "force", ""]
    assert told == ["The source force is stale: its last reading is 0.021 s old.", "The source force is fresh again."]


def test_a_source_that_breaks_its_promises_grows_old() -> None:
    told: list[str] = []

    class Broken(Source):
        def newest(self) -> Any:
            k = self.now_ns // MS
            if k == 0:
                return Reading(self.values({"p": 1.0}), 0, self.now_ns, 0)
            if k < 50:
                raise OSError("unplugged")
            return Reading({"p": np.zeros(3)}, 0, self.now_ns, k) if k < 60 else "nothing"

    fusion = Fusion([Broken("s", P, 0.001)], lambda text, warn=False: told.append(text))
    ages = [fusion.tick(k * MS)["s"].age for k in range(70)]
    np.testing.assert_allclose(ages, 1e-3 * np.arange(70))
    assert [text.partition(":")[0] for text in told if "problem" in text] == ["The source s has a problem"] * 3
    assert any("OSError: unplugged" in text for text in told)


@pytest.mark.parametrize(
    "wrong",
    [
        {"seq": None}, {"seq": 10**400}, {"seq": float("nan")}, {"source_ns": float("inf")}, {"source_ns": 10**400},
        {"source_ns": "1"}, {"source_ns": [1]}, {"receive_ns": None}, {"receive_ns": float("nan")}, {"gaps": "x"},
        {"values": {"p": "far"}}, {"values": {"p": np.array(1j)}}, {"values": {"p": None}}, {"values": None},
    ],
    ids=repr,
)  # fmt: skip
def test_a_reading_that_is_none_does_not_stop_the_loop(wrong: dict[str, Any]) -> None:
    told: list[str] = []

    class Odd(Source):
        def newest(self) -> Reading:
            k = self.now_ns // MS
            good = Reading(self.values({"p": 1.0}), self.now_ns, self.now_ns, k)
            return good if k != 1 else good._replace(**wrong)

    fusion = Fusion([Odd("s", P, 0.001)], lambda text, warn=False: told.append(text))
    for k in range(3):
        held = fusion.tick(k * MS)
        fusion.record(held, k * MS)
        assert held["s"]["p"] == 1.0
        assert held["s"].age == (1e-3 if k == 1 else 0.0)
    assert [text.partition(":")[0] for text in told] == ["The source s has a problem"]


def test_a_reading_stamped_in_the_future_is_stale() -> None:
    """With a wall clock instead of the monotonic clock, a reading would stay fresh even after its source died."""
    told: list[str] = []

    class Ahead(Source):
        def newest(self) -> Reading:
            return Reading(self.values({"p": 1.0}), 0, 10**18, 0)

    fusion = Fusion([Ahead("s", P, 0.001, role="required")], lambda text, warn=False: told.append(text))
    held = fusion.tick(10**12)["s"]
    assert held.stale
    assert np.isnan(held["p"])
    assert fusion.missing == "s"
    assert any("time.monotonic_ns()" in text for text in told)


def test_a_restart_of_the_numbers_maps_the_clock_anew() -> None:
    told: list[str] = []

    class Restarting(Source):
        def newest(self) -> Reading:
            k = self.now_ns // MS
            seq, clock = (k, 5) if k < 50 else (k - 50, 20 * MS)
            return Reading(self.values({"p": 0.0}), 10**9 + self.now_ns - clock, self.now_ns, seq)

    fusion = Fusion([Restarting("s", P, 0.001)], lambda text, warn=False: told.append(text))
    for k in range(60):
        held = fusion.tick(k * MS)["s"]
        assert abs(held.mapped_ns - k * MS) <= 5
    assert told == ["The source s restarted: sequence number 0 after 49."]


def test_wrong_sets_of_sources() -> None:
    one, two = TimerSource("a", 0.01), TimerSource("b", 0.01)
    for sources, words in (([one, one], "different names"), ([one, two], "at most one"), ([object()], "got object")):
        with pytest.raises(ConfigError, match=words):
            Fusion(sources)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="role pacing"):
        next(Fusion([TimerSource("a", 0.01, role="optional")]).ticks(0.1))
    timer = TimerSource("clock", 0.002)  # a pacing source gives rows without a robot
    timer.start()
    counts = [int(held["clock"]["count"]) for held in Fusion([timer]).ticks(0.1)]
    assert counts == sorted(set(counts))
    assert 5 <= len(counts) <= 51


OFFSET = 10**15


@pytest.mark.parametrize(
    ("drift", "least", "mean", "count", "skipped", "bound"),
    [(0.0, 1.0, 2.0, 3000, 100, 0.3), (1e-4, 0.0, 1.0, 10_000, 3000, 0.2), (-1e-4, 0.0, 1.0, 10_000, 3000, 0.2)],
)
def test_the_least_delay_is_the_offset_and_a_drift_is_followed(
    drift: float, least: float, mean: float, count: int, skipped: int, bound: float
) -> None:
    """All stamps but the first are mapped to within the minimum delay; 100 ppm is 1 ms in the window of 10 s."""
    rng = np.random.default_rng(1 if drift == 0.0 else 2)
    clock, errors = ClockMap(), []
    for k in range(count):
        ours = 4 * MS * k
        delay = int(least * MS + rng.exponential(mean * MS))
        errors.append(clock.add(round(ours * (1.0 + drift)), ours + OFFSET + delay) - (ours + OFFSET))
    assert clock.resets == 0
    assert np.abs(np.array(errors[skipped:]) - least * MS).max() < bound * MS


@pytest.mark.parametrize("step", [-60 * MS, 60 * MS, 10**12])
def test_a_clock_that_was_set_is_mapped_anew(step: int) -> None:
    clock = ClockMap()
    for k in range(100):
        late = 80 * MS if k in (50, 51, 52) else 0
        assert clock.add(4 * MS * k, 4 * MS * k + OFFSET + late) == 4 * MS * k + OFFSET, "a late packet is not a step"
    assert clock.resets == 0
    for k in range(100, 120):
        mapped = clock.add(4 * MS * k + step, 4 * MS * k + OFFSET)
    assert clock.resets == 1
    assert mapped == 4 * MS * 119 + OFFSET


def test_in_a_run_and_replayed(play: Any) -> None:
    seen: list[State] = []

    def controller(state: State) -> Command:
        seen.append(state)
        return Command(state.q_start)

    class Wrench(Source):
        """Source with a new wrench every 3 ms."""

        def newest(self) -> Reading:
            k = (self.now_ns - begun) // (3 * MS)
            stamp = begun + 3 * MS * k
            return Reading(self.values({"wrench": np.full(6, 1.0 * k)}), stamp - begun + 1, stamp, k)

    begun = time.monotonic_ns()
    source = Wrench("force", {"wrench": Column((6,))}, 0.003)
    table = play(lambda peer: peer.rest(), controller, seconds=0.3, sources=[source]).table
    assert all(state.sources["force"].age < 0.02 for state in seen)
    rows = [table["seq"].tolist().index(state.seq) for state in seen]
    np.testing.assert_array_equal(table["force.wrench"][rows], [state.wrench for state in seen])
    np.testing.assert_array_equal(table["force.wrench"], np.repeat(table["force.seq"][:, None], 6, axis=1))
    assert table.units["force.age"] == "s"
    fusion, start = Fusion([ReplaySource("force", table, 0.003)]), 10**12
    for row, receive_ns in enumerate(table["receive_ns"] - table["receive_ns"][0]):
        now = start + int(receive_ns)
        again = fusion.record(fusion.tick(now), now)
        for name in (one for one in table.names if one.startswith("force.")):
            np.testing.assert_allclose(again[name], table[name][row], rtol=1e-12, atol=2e-9, err_msg=name)


def test_a_raw_sensor_gives_the_push_alone(robot: Robot) -> None:
    """Raw sensor with 0.8 kg: `State.wrench` is the push in every wrist orientation; NaN when the sensor is silent."""
    m, c, push = 0.8, np.array([0.01, -0.02, 0.06]), np.array([2.0, -1.0, 3.0, 0.1, 0.2, -0.3])
    bias, p = np.array([5.0, -4.0, 3.0, 0.3, 0.2, 0.1]), np.array([0.0, 0.0, -0.04])
    R_tool_sensor = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    sensor = ForceSensor(R_tool_sensor, m, c, bias, position=p, robot_name=robot.name, robot_hash=robot.hash)
    q = robot.q_home

    class Raw(Source):
        def newest(self) -> Reading:
            R = (kinematics.forward(robot, q)[:3, :3] @ R_tool_sensor).T
            felt = m * R @ [0.0, 0.0, -9.80665]
            moment = push[3:] - np.cross(R.T @ R_tool_sensor.T @ p, push[:3])  # at the sensor, not at the tool
            raw = np.r_[R @ push[:3] + felt, R @ moment + np.cross(c, felt)] + bias
            return Reading(self.values({"wrench_raw": raw}), 0, min(self.now_ns, 300 * MS), self.now_ns)

    source = Raw("force", {"wrench_raw": Column((6,))}, 0.004, calibration=sensor)
    assert source.robot == robot.name
    fusion = Fusion([source])
    assert fusion.columns["force.wrench_raw"].unit == "N, N m"
    for k in range(50):
        q = robot.q_home + 0.02 * k * np.eye(7)[4]
        np.testing.assert_allclose(fusion.fields(4 * MS * k, robot, q)["wrench"], push, atol=1e-12)
    assert np.isnan(fusion.fields(400 * MS, robot, q)["wrench"]).all()
    assert "wrench" not in fusion.fields(0, robots.load("yumi_left"), q)


def test_a_required_source_that_is_stale_holds_the_arm(play: Any) -> None:
    alive = [True]

    class Sensor(Source):
        kept: Reading | None = None

        def newest(self) -> Reading | None:
            if alive[0]:
                self.kept = Reading(self.values({"p": 1.0}), 0, self.now_ns, self.now_ns)
            return self.kept

    calls: list[float] = []

    def controller(state: State) -> Command:
        calls.append(state.t)
        return Command(qd=np.full(7, 0.1))

    def script(peer: Any) -> None:
        peer.cycles(20)
        assert peer.replies[-1].qd.min() > 0.05
        alive[0] = False
        time.sleep(0.03)
        held = peer.cycles(30)
        called = len(calls)
        assert not held[-1].qd.any()
        alive[0] = True
        peer.cycles(20)
        assert len(calls) > called
        peer.rest()

    run = play(script, controller, sources=[Sensor("sensor", P, 0.004, role="required")], seconds=0.3)
    assert any("The source sensor is stale" in text for _, text in run.events)


def test_sources_are_started_and_closed(play: Any, robot: Robot) -> None:
    done: list[str] = []

    class Sensor(Source):
        def start(self) -> None:
            done.append(f"start {self.name}")
            if self.name == "bad":
                raise ConfigError("Expected a sensor, got none.")

        def close(self) -> None:
            done.append(f"close {self.name}")

        def newest(self) -> None:
            return None

    good, bad = Sensor("good", P, 0.01), Sensor("bad", P, 0.01)
    with bridge.connect("egm://127.0.0.1:0", robot) as link, pytest.raises(ConfigError, match="a sensor"):
        link.run(None, sources=[good, bad])
    assert done == ["start good", "start bad", "close bad", "close good"]
