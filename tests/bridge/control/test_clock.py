"""Robot time."""

from __future__ import annotations

from typing import Any

import pytest

from armlab.bridge.control.session import NOMINAL_PERIOD, Period, RobotClock
from armlab.wire.egm import EgmCodec


def packet(packets: Any, **fields: Any) -> Any:
    return EgmCodec(packets.robot).decode(packets(**fields))


def test_dt_is_feedback_time(packets: Any) -> None:
    clock = RobotClock()
    assert clock.step(packet(packets, robot_ns=10**18), 0) is None
    assert clock.step(packet(packets, robot_ns=10**18 + 4_032_000), 4_100_000) == pytest.approx(0.004032)
    assert clock.step(packet(packets, robot_ns=10**18 + 3 * 4_032_000), 12_000_000) == pytest.approx(0.008064)


@pytest.mark.parametrize("robot_ns", [10**18 - 1, 10**18, 10**18 + 1_100_000_000, None])
def test_a_clock_that_was_set_gives_way_to_tm(packets: Any, robot_ns: int | None) -> None:
    clock = RobotClock()
    clock.step(packet(packets, robot_ns=10**18, tm_ms=100), 0)
    assert clock.step(packet(packets, robot_ns=robot_ns, tm_ms=108), 8_000_000) == pytest.approx(0.008)


def test_tm_wraps_after_seven_weeks(packets: Any) -> None:
    clock = RobotClock()
    clock.step(packet(packets, robot_ns=None, tm_ms=2**32 - 2), 0)
    assert clock.step(packet(packets, robot_ns=None, tm_ms=2), 4_000_000) == pytest.approx(0.004)


def test_arrival_is_the_last_resort(packets: Any) -> None:
    clock = RobotClock()
    clock.step(packet(packets, robot_ns=None, tm_ms=None), 1_000)
    assert clock.step(packet(packets, robot_ns=None, tm_ms=None), 5_001_000) == pytest.approx(0.005)
    assert clock.step(packet(packets, robot_ns=None, tm_ms=None), 5_001_000) > 0.0


def test_a_tm_too_coarse_for_the_cycle_is_left_alone(packets: Any) -> None:
    """At 0.5 ms two packets share one tm: counted too, its steps would make the robot's time run faster."""
    clock = RobotClock()
    steps = [clock.step(packet(packets, robot_ns=None, tm_ms=k // 2), 500_000 * k) for k in range(2000)]
    assert sum(step for step in steps if step is not None) == pytest.approx(0.5e-3 * 1999, rel=1e-3)


def test_the_period_is_the_robots_not_the_gaps() -> None:
    period = Period()
    assert period.seconds == NOMINAL_PERIOD
    for sample in [0.001, 0.001, 0.02, 0.001, 0.001]:
        period.add(sample)
    assert period.seconds == 0.001
    for _ in range(20):
        period.add(0.001)
    period.add(5.0)
    period.add(0.002)
    assert period.seconds == 0.001
    for _ in range(500):
        period.add(0.0011)
    assert period.seconds == pytest.approx(0.0011, rel=1e-3)


def test_a_clock_in_milliseconds_gives_the_mean() -> None:
    period = Period()
    for k in range(4000):
        period.add(1e-3 * (int(4.032 * (k + 1)) - int(4.032 * k)))
    assert period.seconds == pytest.approx(0.004032, rel=0.02)


def test_a_gap_at_the_beginning_of_a_session_does_not_lengthen_the_step() -> None:
    period = Period()
    for sample in (0.9, 0.9, 0.9, 0.004):
        period.add(sample)
        assert period.seconds <= 1.5 * NOMINAL_PERIOD


def test_a_slower_sample_rate_is_believed_after_nine_samples() -> None:
    period = Period()
    for _ in range(9):
        period.add(0.024)
    assert period.seconds == 0.024


def test_a_cycle_that_changes_is_relearnt_after_five_packets() -> None:
    period = Period()
    assert not any(period.add(0.024) for _ in range(30))
    changes = [period.add(0.004) for _ in range(30)]
    assert (changes.index(True), sum(changes)) == (4, 1)
    assert period.seconds == pytest.approx(0.004)


def steps(
    packets: Any, claimed_ms: list[float], arrived_ms: list[float], **options: Any
) -> tuple[list[float], list[str]]:
    """Return what is believed of the steps of a clock [ms], and what it says."""
    told: list[str] = []
    clock = RobotClock(on_event=lambda text, warn=False, each=False: told.append(text), **options)
    robot_ns, arrival_ns, found = 10**18, 10**12, []
    clock.step(packet(packets, robot_ns=robot_ns), arrival_ns)
    for claimed, arrived in zip(claimed_ms, arrived_ms, strict=True):
        robot_ns, arrival_ns = robot_ns + int(1e6 * claimed), arrival_ns + int(1e6 * arrived)
        step = clock.step(packet(packets, robot_ns=robot_ns), arrival_ns)
        assert step is not None
        found.append(1e3 * clock.believed)
    return found, told


def test_a_clock_that_runs_ahead_of_arrivals_is_not_believed(packets: Any) -> None:
    found, told = steps(packets, [24.0] * 50, [4.0] * 50)
    assert sum(found) <= 4.0 * 50 + 1.5
    assert max(found) <= 5.0
    assert len(told) == 1
    assert "24.0 ms between packets that arrived 4.0 ms apart" in told[0]


def test_packets_that_come_late_and_in_bunches_keep_the_robots_time(packets: Any) -> None:
    found, told = steps(packets, [4.0] * 40, ([40.0] + [0.1] * 9) * 4)
    assert found == pytest.approx([4.0] * 40)
    assert not told


@pytest.mark.parametrize("stall_ms", [150.0, 300.0, 450.0])
def test_a_network_that_stood_delivers_what_waited(packets: Any, stall_ms: float) -> None:
    waits = int(stall_ms / 4.0)
    found, told = steps(packets, [4.0] * 400, [4.0] * 100 + [stall_ms] + [0.05] * (waits - 1) + [4.0] * (300 - waits))
    assert found == pytest.approx([4.0] * 400)
    assert not told


def test_a_slow_clock_is_told(packets: Any) -> None:
    found, told = steps(packets, [1.0] * 8000, [4.0] * 8000)
    assert found == pytest.approx([1.0] * 8000)
    assert len(told) == 1
    assert "runs behind ours" in told[0]


def test_bursts_and_steps_that_are_not_believed_are_no_cycles() -> None:
    period = Period()
    for sample in [0.004] * 20 + [1e-6] * 100:
        assert not period.add(sample)
    assert period.seconds == pytest.approx(0.004)


def test_in_lockstep_arrivals_keep_no_time(packets: Any) -> None:
    found, told = steps(packets, [24.0] * 50, [0.1] * 50, checks_arrival=False)
    assert found == pytest.approx([24.0] * 50)
    assert not told


def test_a_clock_that_is_set_or_stands_still_is_told_once(packets: Any) -> None:
    for jumps, words in (([0.0] * 5, "stands still"), ([-5000.0, 4.0, -5000.0], "was set by -5.000 s")):
        found, told = steps(packets, jumps, [4.0] * len(jumps))
        assert min(found) > 0.0
        assert max(found) <= 4.0 + 1e-6
        assert len(told) == 1
        assert words in told[0]
