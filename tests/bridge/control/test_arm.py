"""One arm of a loop, fed manually."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from armlab.bridge.control.arm import Latency, QueueTrimming
from armlab.bridge.control.state_machine import Mode
from armlab.state import Command, State
from armlab.wire.egm import Beside, EgmCodec
from armlab.wire.egm.robot_side import RobotSideCodec, SensorMessage

from .conftest import CONTROLLER, MS, Make, drift

PERIOD_NS = 4_000_000


def test_percentiles_are_numpys_to_a_bin() -> None:
    times = np.random.default_rng(1).lognormal(11.0, 1.0, 20_000).astype(int)
    latency = Latency()
    for nanoseconds in times.tolist():
        latency.add(nanoseconds)
    summary = latency.summary()
    for name, percent in (("p50", 50.0), ("p90", 90.0), ("p99", 99.0), ("p99.9", 99.9)):
        assert summary[name] == pytest.approx(np.percentile(times, percent, method="inverted_cdf") / 1e3, abs=1.0)
    assert summary["max"] == pytest.approx(times.max() / 1e3)
    assert latency.count == len(times)
    assert math.isnan(Latency().percentile(50.0))
    latency = Latency()
    for nanoseconds in (10**10, -5):
        latency.add(nanoseconds)
    assert latency.percentile(100.0) == 1e7, "the last bin contains all longer times"
    assert latency.percentile(50.0) <= 1.0
    latency.add(19_998_500)
    assert latency.percentile(60.0) == 19_999.0, "the longest time with its own bin"
    latency = Latency()
    latency.add(500)
    assert latency.longest == 0.5


def test_the_histogram_has_every_time_once() -> None:
    latency = Latency()
    for microseconds in (0, 1, 2, 3, 4, 1000, 1024, 10**7):
        latency.add(microseconds * 1000)
    told = latency.histogram()
    counts = dict(zip(told["below_us"], told["count"], strict=True))
    assert {limit: count for limit, count in counts.items() if count} == {2: 2, 4: 2, 8: 1, 1024: 1, 2048: 1, 32768: 1}
    assert list(counts) == [2**k for k in range(1, 16)]


PERIOD = 0.004032


def controller(trimming: QueueTrimming, extra: dict[int, int], cycles: int) -> tuple[list[int], int]:
    """Return the ages of applied references and the number of cycles without one; the reply arrives last in a cycle."""
    queue: deque[int] = deque()
    ages, starved, left = [], 0, 0
    for k in range(cycles):
        depth = left
        if queue:
            ages.append(k - queue.popleft())
        else:
            starved += k > 0
        left = len(queue)
        if not trimming.leaves_out(depth, PERIOD):
            queue.append(k)
        queue.extend([k] * extra.get(k, 0))
    return ages, starved


@pytest.mark.parametrize("many", [0, 1, 5, 20, 63])
def test_surplus_messages_cost_no_lag_in_the_end(many: int) -> None:
    told: list[str] = []
    trimming = QueueTrimming(lambda text, warn=False, each=False: told.append(text))
    ages, starved = controller(trimming, {20: many}, 200)
    assert max(ages) == 1 + many
    assert set(ages[-60:]) == {1}
    assert not told
    assert trimming.left_out == many
    assert starved == 0


@pytest.mark.parametrize(
    ("depths", "skips"),
    [
        # Two cycles are not enough, and an unknown depth never acts.
        ([1, 1, 0, 2, 2, 0, -1, -1, -1, -1, -1, 3, 1, 2, 2], [False] * 13 + [True, False]),
        # A shorter queue, as in a new session, cancels further skips; then the depth becomes unknown.
        ([9, 9, 9, 8, 2, 1, 0, 9, 9, 9, -1], [False] * 2 + [True] * 4 + [False] * 3 + [True, False]),
        # Whatever the robot reports, it gets replies.
        ([2**32 - 1] * 38, ([False] * 2 + [True] * 16) * 2 + [False] * 2),
    ],
)
def test_which_replies_are_skipped(depths: list[int], skips: list[bool]) -> None:
    trimming = QueueTrimming()
    assert [trimming.leaves_out(depth, PERIOD) for depth in depths] == skips
    assert trimming.left_out == sum(skips)


def test_a_queue_that_is_not_emptied_within_a_second_is_one_event() -> None:
    told: list[tuple[str, bool]] = []
    trimming = QueueTrimming(lambda text, warn=False, each=False: told.append((text, warn)))
    for depth in [44] * 200 + [0] + [44] * 247:
        trimming.leaves_out(depth, PERIOD)
    assert not told, "200 and 247 cycles are less than 1 s"
    for depth in [45] * 1000:
        trimming.leaves_out(depth, PERIOD)
    [(text, warn)] = told
    assert warn
    assert "44 messages have waited" in text
    assert "each reference acts 177 ms late" in text
    trimming.leaves_out(0, PERIOD)
    for _ in range(249):
        trimming.leaves_out(1, PERIOD)
    assert "1 message has waited" in told[1][0], "after the queue was empty, a new backlog is reported"


WALL_NS = 1_700_000_000_000_000_000


def test_a_row_says_all_of_its_packet(one: Make) -> None:
    def controller(state: State) -> Command:
        hands.clock.now += MS // 2
        return Command(qd=np.full(7, 5.0))

    hands = one(controller)
    arm = hands.arms[0]
    assert not arm.was_late
    hands.cycle(mci=2)
    hands.put()
    came = hands.clock.now
    hands.clock.now += MS
    hands.loop.cycle()
    state, command, tick = hands.rows[1]
    assert command is not None
    reply, came = hands.reply(), WALL_NS + came
    assert (tick.number, tick.seq_sent, tick.late, tick.drops) == (1, 1, False, 0)
    assert (tick.stamp_ns, tick.receive_ns, tick.send_ns) == (came, came, came + MS * 3 // 2)
    assert (tick.step_ns, tick.wake_ns, state.t_receive) == (MS // 2, MS, came)
    np.testing.assert_allclose(tick.q_sent, reply.q)
    np.testing.assert_allclose(tick.qd_sent, reply.qd)
    assert tick.clamped.all()
    assert tick.tau_sent is None
    assert (reply.seqno, reply.tm_ms) == (1, 10_004)
    assert (arm.replies, arm.latency.count, arm.latency.longest) == (2, 2, 1500.0)
    assert arm.stamp_ns == WALL_NS + hands.clock.now


def test_a_row_says_what_was_sent_beside_the_joints(one: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    hands = one(extension=True)
    machine = hands.arms[0].machine
    answer, beside = machine.answer, Beside(q_ext=np.array([0.25]))
    monkeypatch.setattr(machine, "answer", lambda *given: answer(*given)._replace(tau=np.ones(7), beside=beside))
    hands.cycle()
    tick = hands.rows[0][2]
    np.testing.assert_array_equal(tick.tau_sent, np.ones(7))
    assert (tick.q_ext_sent.tolist(), tick.rapid_data_sent) == ([0.25], None)


def test_a_row_of_a_packet_that_was_overtaken_says_that_nothing_was_sent(one: Make) -> None:
    hands = one()
    for _ in range(3):
        hands.put(mci=2)
    hands.loop.cycle()
    (first, command, tick), _, (_, _, newest) = hands.rows
    assert (first.seq, command, tick.number, tick.seq_sent, tick.send_ns) == (0, None, 0, -1, -1)
    assert (tick.step_ns, tick.late, tick.q_sent, tick.clamped) == (0, False, None, None)
    assert (newest.number, newest.seq_sent, newest.step_ns, hands.arms[0].overtaken) == (2, 0, 0, 2)
    hands.cycle()
    assert [row[2].number for row in hands.rows] == [0, 1, 2, 3]
    assert hands.arms[0].overtaken == 2


def test_rows_stay_in_the_order_of_arrival(one: Make) -> None:
    def controller(state: State) -> Command:
        if state.seq == 2:
            hands.put()
            hands.put()
            hands.clock.now -= 10 * MS  # they arrived while the loop was running, so wake_ns is 0
        return drift(state)

    hands = one(controller)
    for _ in range(3):
        hands.put()
    hands.loop.cycle()
    assert [row[0].seq for row in hands.rows] == [0, 1, 2, 3, 4]
    assert [row[2].seq_sent for row in hands.rows] == [-1, -1, -1, -1, 0]
    assert hands.rows[-1][2].wake_ns == 0


@pytest.mark.parametrize(("waited", "late"), [(3 * MS, False), (3 * MS + 1, True)])
def test_a_reply_is_late_after_three_quarters_of_the_period(one: Make, waited: int, late: bool) -> None:
    hands = one()
    hands.put(mci=2)
    hands.clock.now += waited
    hands.loop.cycle()
    arm = hands.arms[0]
    assert (hands.rows[0][2].late, arm.was_late, arm.late) == (late, late, int(late))
    assert hands.rows[0][2].send_ns == WALL_NS + hands.clock.now
    hands.cycle(mci=2)
    assert (hands.rows[1][2].late, arm.was_late, arm.late) == (False, False, int(late))


def test_no_reply_is_late_in_lockstep_and_time_is_the_robots(one: Make) -> None:
    hands = one(clock="robot")
    arm = hands.arms[0]
    assert arm.stamp_ns == 0
    hands.put(mci=2, robot_ns=123_000_000_000)
    hands.clock.now += 10**9
    hands.loop.cycle()
    assert not hands.rows[0][2].late
    assert (arm.stamp_ns, hands.rows[0][2].stamp_ns) == (123_000_000_000, 123_000_000_000)
    assert hands.rows[0][2].receive_ns == WALL_NS + hands.clock.now - 10**9
    hands.cycle(mci=2, robot_ns=None)
    assert (arm.stamp_ns, hands.rows[1][2].stamp_ns) == (WALL_NS + hands.clock.now, WALL_NS + hands.clock.now)


def test_details_are_those_of_the_packet(one: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    hands = one()
    hands.put()
    data = hands.ports[0].waiting[0].data
    hands.loop.cycle()
    assert repr(hands.rows[0][0].details()) == repr(EgmCodec(hands.robots[0].robot).details(data))
    for details in (lambda data: data, None):  # optional in a user's codec
        monkeypatch.setattr(hands.arms[0], "_details", details)
        hands.put()
        data = hands.ports[0].waiting[0].data
        hands.loop.cycle()
        assert hands.rows[-1][0].details() == (data if details else None)


def test_a_flood_does_not_hold_the_loop_up_and_none_of_it_is_lost(one: Make) -> None:
    hands = one()
    for _ in range(1200):
        hands.put(after=0, mci=2)
    hands.loop.cycle()
    assert len(hands.ports[0].waiting) == 200
    hands.loop.cycle()
    assert [row[0].seq for row in hands.rows] == list(range(1200))
    hands.ports[0].waiting += [hands.garbage()] * 100
    hands.loop.cycle()
    assert len(hands.ports[0].waiting) == 36
    hands.put()
    hands.loop.cycle()
    assert len(hands.rows) == 1201
    assert hands.rows[-1][2].drops == 100
    hands.put()
    hands.ports[0].waiting += [hands.garbage()] * 64
    hands.loop.cycle()
    assert len(hands.ports[0].sent) == 4, "a packet gets its reply even in a flood"


@pytest.mark.parametrize(("resume", "mode"), [(True, Mode.HOLDING), (False, Mode.ENDED)])
def test_a_robot_that_begins_anew_ends_a_run_that_does_not_resume(one: Make, resume: bool, mode: Mode) -> None:
    hands = one(lambda state: Command(), resume=resume)
    for _ in range(3):
        hands.cycle()
    machine = hands.arms[0].machine
    assert machine.mode is Mode.HOLDING
    hands.robots[0].seq = 0
    hands.cycle()
    assert machine.mode is mode
    assert machine.reason == ("" if resume else hands.arms[0].session.reason)


@pytest.mark.parametrize("clock", ["wall", "robot"])
def test_ten_sessions_that_end_at_once_end_the_run(one: Make, clock: str) -> None:
    hands = one(clock=clock)
    for count in range(11):
        assert hands.loop.reason == "", count
        hands.robots[0].seq = 0
        hands.cycle()
        hands.cycle()
        hands.loop._have_ended()
    assert hands.loop.reason == "sessions ended immediately"


def test_silence_counts_from_the_newest_packet(one: Make) -> None:
    hands = one(patience=1.0)
    arm = hands.arms[0]
    hands.clock.now += 10**9
    arm.supervisor.check_silence(arm.arrived_ns)
    assert arm.machine.mode is Mode.WAITING
    hands.cycle()
    hands.clock.now += 10**9
    arm.supervisor.check_silence(arm.arrived_ns)
    assert arm.machine.mode is not Mode.ENDED
    hands.clock.now += 1000
    arm.supervisor.check_silence(arm.arrived_ns)
    assert hands.loop.failure is not None


@pytest.mark.parametrize("clock", ["wall", "robot"])
def test_a_session_outlasts_half_a_second_of_silence_only_in_lockstep(one: Make, clock: str) -> None:
    hands = one(clock=clock)
    hands.cycle()
    arm = hands.arms[0]
    for after, active in ((499 * MS, True), (2 * MS, clock == "robot")):
        hands.clock.now += after
        arm.supervisor.check_silence(arm.arrived_ns)
        assert arm.session.active == active


@pytest.mark.parametrize(("clock", "left_out"), [("wall", 1), ("robot", 0)])
def test_a_reply_is_left_out_for_a_message_that_stays_in_the_queue(one: Make, clock: str, left_out: int) -> None:
    hands = one(extension=True, clock=clock)
    for _ in range(10):
        hands.cycle()
    for _ in range(3):
        hands.cycle(queue_depth=1)
    arm = hands.arms[0]
    assert arm.trimming.left_out == left_out
    assert len(hands.ports[0].sent) == 13 - left_out
    _, command, tick = hands.rows[-1]
    assert command is not None
    assert (tick.send_ns == -1) == (tick.seq_sent == -1) == (tick.q_sent is None) == bool(left_out)
    hands.cycle()
    reply = hands.reply()
    assert reply.seqno == 13 - left_out
    steps = np.diff([row[2].q_sent for row in hands.rows[5:] if row[2].q_sent is not None], axis=0)
    np.testing.assert_allclose(steps, 0.0004, atol=1e-12)


def test_the_time_of_a_packet_is_echoed(one: Make) -> None:
    hands = one()
    assert [hands.cycle(tm_ms=tm).tm_ms for tm in (7, None)] == [7, 0]


def test_a_packet_that_gets_no_reply_has_a_row(one: Make) -> None:
    hands = one(answer_stream=False)
    hands.cycle(mci=2)
    tick = hands.rows[0][2]
    assert (hands.reply(), tick.seq_sent, tick.send_ns, tick.q_sent) == (None, -1, -1, None)


@pytest.mark.parametrize("step", ["keep", "publish"])
def test_a_row_is_recorded_once_despite_an_error(one: Make, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    """A row that was not stored is stored next; a later error, in the file or a feed, causes no duplicate row."""
    hands = one()
    recording = hands.arms[0].recording
    publish = recording.publish
    with monkeypatch.context() as patch:
        patch.setattr(recording, step, lambda *row: (step == "publish" and publish(*row), 1 / 0))
        with pytest.raises(ZeroDivisionError):
            hands.cycle()
    hands.cycle()
    assert [(row[0].seq, row[2].number) for row in hands.rows] == [(0, 0), (1, 1)]
    assert list(hands.table()["tick"]) == [0, 1]


def test_a_reply_that_went_out_is_not_taken_back(one: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    hands = one()
    for _ in range(5):
        hands.cycle()
    for part, name in ((hands.arms[0].latency, "add"), (hands.arms[0].session, "replied")):
        with monkeypatch.context() as patch:
            patch.setattr(part, name, lambda _: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                hands.cycle()
    for _ in range(3):
        hands.cycle()
    sent = [RobotSideCodec(hands.robots[0].robot).decode_sensor(data) for data in hands.ports[0].sent]
    assert len(sent) == 10
    steps = np.diff([one.q for one in sent if isinstance(one, SensorMessage)], axis=0)
    np.testing.assert_allclose(steps, 0.0004, atol=1e-12)
    assert [row[2].seq_sent for row in hands.rows] == [0, 1, 2, 3, 4, 5, 6, 7, 8]  # no number if `replied` fails


def test_a_reply_that_the_system_refuses_is_told_as_a_warning(one: Make) -> None:
    hands = one()
    hands.ports[0].works = False
    hands.cycle()
    host, port = CONTROLLER
    assert [text.partition(",")[0] for text in hands.warned] == [f"A reply to {host}:{port} was not sent"]
    assert (hands.arms[0].replies, hands.arms[0].latency.count) == (0, 0)
    assert (hands.rows[0][2].seq_sent, hands.rows[0][2].send_ns) == (-1, -1)


def test_a_prediction_counts_the_packets_that_were_missed(one: Make) -> None:
    hands = one()
    hands.cycle()
    hands.robots[0].seq += 2
    hands.robots[0].cycle += 2
    hands.cycle(after=3 * hands.step)
    assert hands.arms[0].prediction.next_ns == hands.clock.now + hands.step
    hands.cycle(after=hands.step + MS)  # 1 ms late, of which 2 % counts
    assert hands.arms[0].prediction.next_ns == hands.clock.now - 0.98 * MS + hands.step


def test_a_command_serves_for_exactly_its_time(one: Make) -> None:
    hands = one()
    hands.cycle()
    arm = hands.arms[0]
    sample = replace(arm.newest, dt=0.25)
    assert arm.kept_command(sample, 1.0) is None
    qd = np.zeros(7)
    arm.set_command(Command(qd=qd))
    qd[2] = 1.0  # later changes by the controller are not commanded
    served = [arm.kept_command(sample, 0.5) for _ in range(3)]
    assert [one is not None for one in served] == [True, True, False]
    assert not served[0].qd.any()  # type: ignore[union-attr]
    arm.set_command(None)
    assert arm.kept_command(sample, 0.5) is None
