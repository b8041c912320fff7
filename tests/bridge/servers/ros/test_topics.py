"""What ROS programs read: which topics a row becomes, in whose axes, and what is absent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from armlab.bridge.servers.ros.message_template import cdr
from hypothesis import given
from hypothesis import strategies as st

from armlab import kinematics, robots
from armlab.bridge.servers.ros.topics import Encoded, Topic, Topics, store
from armlab.bridge.servers.row import RowSchema, RowWriter
from armlab.errors import LinkError
from armlab.log import Tick
from armlab.state import Command, State

NAMES = ("yumi_left", "yumi_right")
ARMS = {name: robots.load(name) for name in NAMES}
SCHEMA = RowSchema.of(list(ARMS.values()))
WRENCH = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
COV = np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])
WALL, MONO = 1_700_000_000_123_456_789, 5_000_000_000


def state(name: str = "yumi_left", **fields: Any) -> State:
    q = np.array(ARMS[name].q_home)
    nothing = np.full(7, np.nan)
    given = {"q": q, "qd": nothing, "tau": nothing, **fields}
    return State(t=1.0, dt=0.004, robot=name, **given)


def messages(
    state: State, command: Command | None = None, mono_ns: int = MONO, who: str = "", **tick: Any
) -> dict[str, Any]:
    topics = Topics(ARMS, SCHEMA)
    data = RowWriter(SCHEMA).row(state, command, Tick(7, 7, WALL, 1_000, 2_000, 3, **tick), mono_ns, who)
    return {topic.name: message for topic, message in topics.of_row(data, topics.published)}


def test_what_the_row_lacks_is_empty_or_has_no_topic() -> None:
    found = messages(state())
    joints = found["/yumi_left/joint_states"]
    assert joints.position.tolist() == ARMS["yumi_left"].q_home.tolist()
    assert len(joints.velocity) == len(joints.effort) == 0  # never zeros
    assert joints.name == [f"yumi_robl_joint_{k}" for k in range(1, 8)]
    assert (joints.header.stamp.sec, joints.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    absent = ("joint_states_ref", "joint_states_sent", "wrench", "wrench_hat", "wrench_hat_covariance")
    assert not {f"/yumi_left/{name}" for name in absent} & found.keys()
    assert not any(name.startswith("/yumi_right") and "diagnostics" not in name for name in found)


def test_asked_and_sent_joints_have_topics_of_their_own() -> None:
    q, sent = np.arange(7.0), np.arange(7.0) + 0.5
    found = messages(state(), Command(q, qd=2.0 * q), q_sent=sent)
    assert found["/yumi_left/joint_states_ref"].position.tolist() == q.tolist()
    assert found["/yumi_left/joint_states_ref"].velocity.tolist() == (2.0 * q).tolist()
    assert found["/yumi_left/joint_states_sent"].position.tolist() == sent.tolist()


def test_wrenches_are_in_tool_axes_and_do_the_same_work() -> None:
    command = Command(record={"wrench_hat": WRENCH, "wrench_hat_cov": COV})
    found = messages(state(), command)
    R = kinematics.forward(ARMS["yumi_left"], ARMS["yumi_left"].q_home)[:3, :3]
    hat = found["/yumi_left/wrench_hat"]
    force = [getattr(hat.wrench.force, axis) for axis in "xyz"]
    moment = [getattr(hat.wrench.torque, axis) for axis in "xyz"]
    np.testing.assert_allclose(R @ force, WRENCH[:3], atol=1e-14)
    np.testing.assert_allclose(R @ moment, WRENCH[3:], atol=1e-14)
    assert hat.header.frame_id == "yumi_left_tool"
    cov = found["/yumi_left/wrench_hat_covariance"].data.reshape(6, 6)
    numbers = np.array(force + moment)
    assert numbers @ np.linalg.solve(cov, numbers) == pytest.approx(WRENCH @ np.linalg.solve(COV, WRENCH))
    np.testing.assert_allclose(R @ cov[:3, :3] @ R.T, COV[:3, :3], atol=1e-13)


def test_the_alias_is_the_sensor_and_without_one_the_estimate() -> None:
    alias = "/yumi_left/force_torque_sensor_broadcaster/wrench"
    command = Command(record={"wrench_hat": WRENCH})
    only_hat = messages(state(), command)
    assert only_hat[alias].wrench == only_hat["/yumi_left/wrench_hat"].wrench
    both = messages(state(wrench=2.0 * WRENCH), command)
    assert both[alias].wrench == both["/yumi_left/wrench"].wrench
    assert both[alias].wrench != only_hat[alias].wrench


def test_the_pose_is_that_of_the_tool_in_the_base() -> None:
    pose = messages(state())["/yumi_left/tcp_pose"]
    T = kinematics.forward(ARMS["yumi_left"], ARMS["yumi_left"].q_home)
    p, r = pose.pose.position, pose.pose.orientation
    np.testing.assert_allclose([p.x, p.y, p.z], T[:3, 3], atol=1e-15)
    from scipy.spatial.transform import Rotation

    np.testing.assert_allclose(Rotation.from_quat([r.x, r.y, r.z, r.w]).as_matrix(), T[:3, :3], atol=1e-12)
    assert pose.header.frame_id == "yumi_left_base"


def test_states_of_egm_count_from_one() -> None:
    fields = {"motors": 1, "mci": 3, "rapid": 2, "converged": True, "utilization": 12.5}
    (channel,) = messages(state(**fields))["/yumi_left/egm_states"].egm_channels
    told = (channel.motor_state, channel.egm_client_state, channel.rapid_execution_state)
    assert told == (2, 4, 3)  # MOTORS_ON, EGM_RUNNING, RAPID_RUNNING
    assert channel.egm_convergence_met
    assert channel.utilization_rate == 12.5
    assert channel.name == "yumi_left"


def test_diagnostics_come_once_a_second_for_every_arm() -> None:
    topics, writer = Topics(ARMS, SCHEMA), RowWriter(SCHEMA)
    count, faulty = 0, None
    for k in range(501):
        tick = Tick(k, k, WALL, 1_000, 2_000, 3, late=k == 400)
        data = writer.row(state(), None, tick, MONO + 4_000_000 * k, "rosbridge 127.0.0.1:5")
        for topic, message in topics.of_row(data, {"/yumi_left/diagnostics", "/yumi_right/diagnostics"}):
            count += 1
            if topic.name == "/yumi_left/diagnostics":
                faulty = message
    assert count == 6  # at 0, 1 and 2 s, two arms
    assert faulty is not None
    (status,) = faulty.status
    values = {one.key: one.value for one in status.values}
    assert status.level == 1
    assert "1 late answers" in status.message
    assert values["rate [1/s]"] == "250.0"
    assert values["commander"] == "rosbridge 127.0.0.1:5"


def test_only_what_is_read_is_made_and_everything_has_a_codec() -> None:
    topics = Topics(ARMS, SCHEMA)
    command = Command(np.zeros(7), record={"wrench_hat": WRENCH, "wrench_hat_cov": COV})
    data = RowWriter(SCHEMA).row(state(wrench=WRENCH), command, Tick(1, 1, WALL, 1, 2, 3), MONO)
    wanted = {"/yumi_left/tcp_pose", "/nobody/joint_states"}
    assert [topic.name for topic, _ in topics.of_row(data, wanted)] == ["/yumi_left/tcp_pose"]
    for topic, message in Topics(ARMS, SCHEMA).of_row(data, topics.published):
        raw = store().serialize_cdr(message, topic.type)
        again = store().deserialize_cdr(raw, topic.type)
        assert bytes(store().serialize_cdr(again, topic.type)) == bytes(raw)


def test_parameters_are_told_as_text() -> None:
    topics = Topics(ARMS, SCHEMA)
    assert topics.published["/yumi_right/parameters"] == Topic("/yumi_right/parameters", "std_msgs/msg/String")
    known = {"gain": {"value": 2.0}, "gentle": {"value": True}}
    told = list(topics.of_parameters(known, {"/yumi_right/parameters"}))
    assert [(topic.name, message.data) for topic, message in told] == [
        ("/yumi_right/parameters", '{"gain": 2.0, "gentle": true}')
    ]


NUMBERS = st.lists(st.floats(width=64), min_size=7, max_size=7).map(np.array) | st.none()
WRENCHES = st.lists(st.floats(-1e6, 1e6) | st.just(np.nan), min_size=6, max_size=6).map(np.array) | st.none()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@given(
    st.tuples(*[NUMBERS] * 8),
    st.lists(st.floats(-3.0, 3.0), min_size=7, max_size=7).map(np.array) | st.none(),
    WRENCHES,
    WRENCHES,
    st.integers(0, 2**31 * 10**9 - 1),
    st.sampled_from(NAMES),
)
def test_bytes_are_those_of_the_messages(
    drawn: tuple[np.ndarray | None, ...],
    q: np.ndarray | None,
    wrench: np.ndarray | None,
    hat: np.ndarray | None,
    wall_ns: int,
    name: str,
) -> None:
    nothing = np.full(7, np.nan)
    qd, tau, *asked = [nothing if one is None else one for one in drawn]
    fields = {
        "q": nothing if q is None else q,
        "qd": qd,
        "tau": tau,
        "wrench": np.zeros(0) if wrench is None else wrench,
    }
    given_ = State(t=1.0, dt=0.004, robot=name, **fields)
    record = {} if hat is None else {"wrench_hat": hat, "wrench_hat_cov": COV}
    command = Command(*asked[:3], record=record)
    sent: dict[str, Any] = {"q_sent": asked[3], "qd_sent": asked[4], "tau_sent": asked[5]}
    data = RowWriter(SCHEMA).row(given_, command, Tick(7, 7, wall_ns, 1_000, 2_000, 3, **sent), MONO)
    for encode in (cdr, ros1):
        topics = Topics(ARMS, SCHEMA)
        expected = {topic.name: encode(message, topic.type) for topic, message in topics.of_row(data, topics.published)}
        encoded = {
            topic.name: one for topic, one in Encoded(Topics(ARMS, SCHEMA), encode).of_row(data, topics.published)
        }
        assert encoded == expected


def ros1(message: Any, type_: str) -> bytes:
    return bytes(store().cdr_to_ros1(store().serialize_cdr(message, type_), type_))


def test_bytes_of_what_is_wanted_now_and_of_rows_only() -> None:
    encoded = Encoded(Topics(ARMS, SCHEMA), cdr)
    data = RowWriter(SCHEMA).row(state(wrench=WRENCH), None, Tick(1, 1, WALL, 1, 2, 3), MONO)
    for wanted in (
        ["/yumi_left/tcp_pose", "/nobody/joint_states"],
        ["/yumi_left/egm_states"],
        ["/yumi_left/wrench"],
        [],
    ):
        assert [topic.name for topic, _ in encoded.of_row(data, wanted)] == wanted[:1]
    assert list(encoded.of_row(data, ["/yumi_right/joint_states"])) == []  # the row is of the other arm
    with pytest.raises(LinkError, match="Read whole messages"):
        list(encoded.of_row(data + bytes(8), []))
    ((topic, message),) = encoded.of_parameters({"gain": {"value": 2.0}}, ["/yumi_left/parameters"])
    assert store().deserialize_cdr(message, topic.type).data == '{"gain": 2.0}'


def statuses(found: Any) -> dict[str, tuple[int, str]]:
    return {topic.name: (one.status[0].level, one.status[0].message) for topic, one in found}


def test_an_arm_that_falls_silent_is_an_error_with_rows_of_the_other_and_with_none() -> None:
    topics, writer, wanted = Topics(ARMS, SCHEMA), RowWriter(SCHEMA), {f"/{name}/diagnostics" for name in NAMES}
    second, well = 1_000_000_000, (0, "every packet answered")
    assert not list(topics.of_silence(0, wanted)), "the first call only looks"
    assert set(statuses(topics.of_silence(2 * second, wanted)).values()) == {(2, "no packet yet")}

    def row(name: str, mono_ns: int) -> dict[str, tuple[int, str]]:
        tick = Tick(7, 7, WALL, 1_000, 2_000, 3)
        return statuses(topics.of_row(writer.row(state(name), None, tick, mono_ns, "me"), wanted))

    assert row("yumi_right", MONO)["/yumi_right/diagnostics"] == well
    row("yumi_left", MONO + 1)
    assert set(row("yumi_left", MONO + second).values()) == {well}
    found = row("yumi_left", MONO + 3 * second)
    assert found == {"/yumi_left/diagnostics": well, "/yumi_right/diagnostics": (2, "no packet for 3.0 s")}
    assert not list(topics.of_silence(7 * second, wanted)), "a row came since the call before"
    assert not list(topics.of_silence(7 * second + 10, wanted)), "it is not due"
    found = statuses(topics.of_silence(9 * second, wanted))
    assert found["/yumi_left/diagnostics"] == (2, "no packet for 2.0 s")
    assert found["/yumi_right/diagnostics"] == (2, "no packet for 5.0 s")
    assert set(row("yumi_left", MONO + 6 * second)) == wanted, "rows again"
