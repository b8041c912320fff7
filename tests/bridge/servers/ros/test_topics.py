"""Messages for and from ROS programs: messages made from rows, their types, and requests made from commands."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from armlab import kinematics, robots
from armlab.bridge.servers.messages import CommandRequest, SetRequest, Stop
from armlab.bridge.servers.ros.server import Commands
from armlab.bridge.servers.ros.topics import Topics, content, diagnostics, domain_number, store, type_name
from armlab.bridge.servers.row import RowSchema, RowWriter
from armlab.errors import CommandRefused, ConfigError, LinkError
from armlab.log import Tick
from armlab.state import Command, State

from ..conftest import nested

NAMES = ("yumi_left", "yumi_right")
ARMS = {name: robots.load(name) for name in NAMES}
SCHEMA = RowSchema.of(list(ARMS.values()))
WRENCH = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
COV = np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])
WALL, MONO, SECOND = 1_700_000_000_123_456_789, 5_000_000_000, 1_000_000_000
NOTHING = np.full(7, np.nan)


def state(name: str = "yumi_left", **fields: Any) -> State:
    given = {"q": np.array(ARMS[name].q_home), "qd": NOTHING, "tau": NOTHING, **fields}
    return State(t=1.0, dt=0.004, robot=name, **given)


def row(state: State, command: Command | None = None, wall_ns: int = WALL, **tick: Any) -> bytes:
    return RowWriter(SCHEMA).row(state, command, Tick(7, 7, wall_ns, 1_000, 2_000, 3, **tick), MONO)


def messages(state: State, command: Command | None = None, **tick: Any) -> dict[str, Any]:
    topics = Topics(ARMS, SCHEMA)
    made = topics.of_row(row(state, command, **tick), topics.published)
    return {topic.name.removeprefix("/yumi_left/"): message for topic, message in made}


def test_what_the_row_lacks_is_empty_or_has_no_topic() -> None:
    endless = np.array([np.inf, -np.inf, *np.ones(5)])
    found = messages(state(tau=endless))
    joints = found["joint_states"]
    assert joints.position.tolist() == ARMS["yumi_left"].q_home.tolist()
    assert len(joints.velocity) == 0, "never zeros"
    assert joints.effort.tolist() == endless.tolist()
    assert joints.name == [f"yumi_robl_joint_{k}" for k in range(1, 8)]
    assert (joints.header.stamp.sec, joints.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    absent = ("joint_states_ref", "joint_states_sent", "wrench", "wrench_hat", "wrench_hat_covariance")
    assert not set(absent) & found.keys()
    assert not any(name.startswith("/yumi_right") and "diagnostics" not in name for name in found)
    assert not {"joint_states", "tcp_pose"} & messages(state(q=NOTHING)).keys()


def test_asked_and_sent_joints_have_topics_of_their_own() -> None:
    q = np.arange(7.0)
    found = messages(state(), Command(q, qd=2.0 * q), q_sent=q + 0.5)
    assert found["joint_states_ref"].position.tolist() == q.tolist()
    assert found["joint_states_ref"].velocity.tolist() == (2.0 * q).tolist()
    assert found["joint_states_sent"].position.tolist() == (q + 0.5).tolist()


def test_wrenches_are_in_tool_axes_and_do_the_same_work() -> None:
    found = messages(state(), Command(record={"wrench_hat": WRENCH, "wrench_hat_cov": COV}))
    R = kinematics.forward(ARMS["yumi_left"], ARMS["yumi_left"].q_home)[:3, :3]
    hat = found["wrench_hat"]
    force = [getattr(hat.wrench.force, axis) for axis in "xyz"]
    moment = [getattr(hat.wrench.torque, axis) for axis in "xyz"]
    np.testing.assert_allclose(R @ force, WRENCH[:3], atol=1e-14)
    np.testing.assert_allclose(R @ moment, WRENCH[3:], atol=1e-14)
    assert hat.header.frame_id == "yumi_left_tool"
    cov = found["wrench_hat_covariance"].data.reshape(6, 6)
    numbers = np.array(force + moment)
    assert numbers @ np.linalg.solve(cov, numbers) == pytest.approx(WRENCH @ np.linalg.solve(COV, WRENCH))
    np.testing.assert_allclose(R @ cov[:3, :3] @ R.T, COV[:3, :3], atol=1e-13)


def test_the_alias_is_the_sensor_and_without_one_the_estimate() -> None:
    alias, command = "force_torque_sensor_broadcaster/wrench", Command(record={"wrench_hat": WRENCH})
    only_hat, both = messages(state(), command), messages(state(wrench=2.0 * WRENCH), command)
    assert only_hat[alias].wrench == only_hat["wrench_hat"].wrench
    assert both[alias].wrench == both["wrench"].wrench != only_hat[alias].wrench


def test_the_pose_is_that_of_the_tool_in_the_base() -> None:
    pose = messages(state())["tcp_pose"]
    T = kinematics.forward(ARMS["yumi_left"], ARMS["yumi_left"].q_home)
    p, r = pose.pose.position, pose.pose.orientation
    np.testing.assert_allclose([p.x, p.y, p.z], T[:3, 3], atol=1e-15)
    np.testing.assert_allclose(Rotation.from_quat([r.x, r.y, r.z, r.w]).as_matrix(), T[:3, :3], atol=1e-12)
    assert pose.header.frame_id == "yumi_left_base"


def test_states_of_egm_count_from_one() -> None:
    fields = {"motors": 1, "mci": 3, "rapid": 2, "converged": True, "utilization": 12.5}
    (channel,) = messages(state(**fields))["egm_states"].egm_channels
    told = (channel.motor_state, channel.egm_client_state, channel.rapid_execution_state)
    assert told == (2, 4, 3)  # MOTORS_ON, EGM_RUNNING, RAPID_RUNNING
    assert (channel.egm_convergence_met, channel.utilization_rate, channel.name) == (True, 12.5, "yumi_left")


def test_only_what_is_read_is_made() -> None:
    topics, data = Topics(ARMS, SCHEMA), row(state(wrench=WRENCH))
    for wanted in (["/yumi_left/tcp_pose", "/nobody/joint_states"], ["/yumi_left/egm_states"], []):
        assert [topic.name for topic, _ in topics.of_row(data, wanted)] == wanted[:1]
    assert list(topics.of_row(data, ["/yumi_right/joint_states"])) == [], "the row belongs to the other arm"
    with pytest.raises(LinkError, match="with a stated size of"):
        list(topics.of_row(data + bytes(8), []))


_SEVEN = st.lists(st.floats(width=64), min_size=7, max_size=7).map(np.array) | st.just(NOTHING)
_SIX = st.lists(st.floats(-1e6, 1e6) | st.just(np.nan), min_size=6, max_size=6).map(np.array)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@settings(max_examples=30)
@given(st.tuples(*[_SEVEN] * 5), _SIX, _SIX, st.integers(0, 2**31 * 10**9 - 1), st.sampled_from(NAMES))
def test_whatever_the_numbers_are_messages_survive_both_wires(
    drawn: tuple[np.ndarray, ...], wrench: np.ndarray, hat: np.ndarray, wall_ns: int, name: str
) -> None:
    qd, tau, q_ref, q_sent, tau_sent = drawn
    command = Command(q_ref, record={"wrench_hat": hat, "wrench_hat_cov": COV})
    data = row(state(name, qd=qd, tau=tau, wrench=wrench), command, wall_ns, q_sent=q_sent, tau_sent=tau_sent)
    topics = Topics(ARMS, SCHEMA)
    for topic, message in topics.of_row(data, topics.published):
        raw = bytes(store().serialize_cdr(message, topic.type))
        again = store().deserialize_cdr(raw, topic.type)
        assert bytes(store().serialize_cdr(again, topic.type)) == raw
        assert bytes(store().ros1_to_cdr(store().cdr_to_ros1(raw, topic.type), topic.type)) == raw
        if topic.name == f"/{name}/joint_states":
            assert again.header.stamp.sec * SECOND + again.header.stamp.nanosec == wall_ns
            for got, expected in ((again.velocity, qd), (again.effort, tau)):
                np.testing.assert_array_equal(got, [] if np.isnan(expected).any() else expected)


COUNTS = {"rate": 250.04, "p50": 80.0, "p99": 120.0, "longest": 400.0, "missed": 0, "late": 0, "drops": 0}
COUNTS |= {"session": 2, "clamps": {"position": [0, 3], "velocity": [1, 0]}}


@pytest.mark.parametrize(
    ("changed", "silent", "level", "message", "shown"),
    [
        ({}, 0.9, 0, "every packet answered", {"rate [1/s]": "250.0", "clamped samples": "4", "commander": "nobody"}),
        ({}, 3.21, 2, "no packet for 3.2 s", {"link": "no packet for 3.2 s", "rate [1/s]": "0.0"}),
        ({}, math.inf, 2, "no packet yet", {}),
        ({"missed": 3, "rate": math.nan}, 0.0, 1, "3 packets missed", {"rate [1/s]": "unknown"}),
    ],
)
def test_diagnostics(changed: dict[str, Any], silent: float, level: int, message: str, shown: dict[str, str]) -> None:
    (status,) = diagnostics("irb120", 5, {**COUNTS, **changed}, "", silent=silent).status
    assert (status.level, status.message, status.hardware_id) == (level, message, "irb120")
    assert shown.items() <= {one.key: one.value for one in status.values}.items()


def test_diagnostics_come_once_a_second_for_every_arm() -> None:
    topics, writer, found = Topics(ARMS, SCHEMA), RowWriter(SCHEMA), []
    for k in range(501):
        tick = Tick(k, k, WALL, 1_000, 2_000, 3, late=k == 400)
        data = writer.row(state(), None, tick, MONO + 4_000_000 * k, "rosbridge 127.0.0.1:5")
        found += topics.of_row(data, {"/yumi_left/diagnostics", "/yumi_right/diagnostics"})
    assert len(found) == 6  # two arms at 0, 1 and 2 s
    (status,) = next(message for topic, message in reversed(found) if topic.name == "/yumi_left/diagnostics").status
    values = {one.key: one.value for one in status.values}
    assert status.level == 1
    assert "1 late replies" in status.message
    assert (values["rate [1/s]"], values["commander"]) == ("250.0", "rosbridge 127.0.0.1:5")


def test_an_arm_that_falls_silent_is_an_error_with_rows_of_the_other_and_with_none() -> None:
    topics, writer, wanted = Topics(ARMS, SCHEMA), RowWriter(SCHEMA), {f"/{name}/diagnostics" for name in NAMES}
    well = (0, "every packet answered")

    def statuses(found: Any) -> dict[str, tuple[int, str]]:
        return {topic.name: (one.status[0].level, one.status[0].message) for topic, one in found}

    def told(name: str, mono_ns: int) -> dict[str, tuple[int, str]]:
        tick = Tick(7, 7, WALL, 1_000, 2_000, 3)
        return statuses(topics.of_row(writer.row(state(name), None, tick, mono_ns, "me"), wanted))

    assert not list(topics.of_silence(0, wanted)), "the first call reports nothing"
    assert set(statuses(topics.of_silence(2 * SECOND, wanted)).values()) == {(2, "no packet yet")}
    assert told("yumi_right", MONO)["/yumi_right/diagnostics"] == well
    told("yumi_left", MONO + 1)
    assert set(told("yumi_left", MONO + SECOND).values()) == {well}
    found = told("yumi_left", MONO + 3 * SECOND)
    assert found == {"/yumi_left/diagnostics": well, "/yumi_right/diagnostics": (2, "no packet for 3.0 s")}
    assert not list(topics.of_silence(7 * SECOND, wanted)), "a row has arrived since the previous call"
    assert not list(topics.of_silence(7 * SECOND + 10, wanted)), "it is not due"
    found = statuses(topics.of_silence(9 * SECOND, wanted))
    assert found["/yumi_left/diagnostics"] == (2, "no packet for 2.0 s")
    assert found["/yumi_right/diagnostics"] == (2, "no packet for 5.0 s")
    assert set(told("yumi_left", MONO + 6 * SECOND)) == wanted, "rows again"


HASHES = {
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "geometry_msgs/msg/WrenchStamped": "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
    "std_msgs/msg/Float64MultiArray": "1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f",
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}
COMMANDS = Commands("yumi", {name: ARMS[name] for name in ("yumi_right", "yumi_left")})


@pytest.mark.parametrize("distribution", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
def test_types_have_the_hashes_of_ros_2_in_every_distribution(distribution: Stores) -> None:
    assert {name: store().hash_rihs01(name) for name in HASHES} == {n: f"RIHS01_{h}" for n, h in HASHES.items()}
    spoken = {one.type for one in Topics(ARMS, SCHEMA).published.values()} | set(COMMANDS.types.values())
    theirs = get_typestore(distribution)
    assert spoken - set(theirs.fielddefs) == {"abb_egm_msgs/msg/EGMState"}
    for name in spoken & set(theirs.fielddefs):
        assert store().hash_rihs01(name) == theirs.hash_rihs01(name), name
    assert type_name("sensor_msgs/msg/JointState") == "sensor_msgs::msg::dds_::JointState_"


def test_the_domain_is_that_of_the_cell_else_of_the_environment() -> None:
    assert domain_number(7, {"ROS_DOMAIN_ID": "9"}) == 7
    assert domain_number(0, {"ROS_DOMAIN_ID": "9"}) == 0
    assert domain_number(None, {"ROS_DOMAIN_ID": "9"}) == 9
    assert domain_number(None, {}) == domain_number(None, {"ROS_DOMAIN_ID": ""}) == 0
    for wrong in ("233", "-1", "one", "1.0"):
        with pytest.raises(ConfigError, match="from 0 to 232"):
            domain_number(None, {"ROS_DOMAIN_ID": wrong})


def test_what_a_command_says() -> None:
    types = store().types
    array = types["std_msgs/msg/Float64MultiArray"](types["std_msgs/msg/MultiArrayLayout"]([], 0), np.arange(3.0))
    text = types["std_msgs/msg/String"]('{"gain": 2.0}')
    found = [content(one.__msgtype__, bytes(store().serialize_cdr(one, one.__msgtype__))) for one in (array, text)]
    assert (found[0].tolist(), found[1]) == ([0.0, 1.0, 2.0], '{"gain": 2.0}')
    assert content("std_msgs/msg/Empty", b"\0\1\0\0\0\0\0\0") is None
    with pytest.raises(CommandRefused, match="at most 131072 bytes"):
        content("std_msgs/msg/String", b"\0" * (2**17 + 1))


@settings(max_examples=40)
@given(name=st.sampled_from(sorted(set(COMMANDS.types.values()))), data=st.binary(max_size=80))
def test_bytes_that_are_no_message_are_refused(name: str, data: bytes) -> None:
    for raw in (data, b"\0\1\0\0" + data, b"\0\0\0\0" + data):
        with contextlib.suppress(CommandRefused):
            found = content(name, raw)
            assert found is None or isinstance(found, str | np.ndarray)


POSITION = "/yumi_left/joint_group_position_controller/command"
SEVEN = [0.1 * k for k in range(7)]


@pytest.mark.parametrize(("kind", "field"), [("position", "q"), ("velocity", "qd"), ("effort", "tau")])
@pytest.mark.parametrize("spelling", ["command", "commands"])
def test_a_command_of_either_spelling_is_for_one_arm(kind: str, field: str, spelling: str) -> None:
    topic = f"/yumi_left/joint_group_{kind}_controller/{spelling}"
    for given_ in (SEVEN, tuple(SEVEN), np.array(SEVEN)):
        assert COMMANDS.requests(topic, given_, "me") == [CommandRequest("me", "yumi_left", first=0, **{field: SEVEN})]


def test_fourteen_numbers_settings_and_stops() -> None:
    both = COMMANDS.requests("/yumi/joint_group_velocity_controller/commands", [*range(14)], "me")
    left, right = ([*range(k, k + 7)] for k in (0, 7))
    expected = (
        CommandRequest("me", "yumi_left", qd=left, first=0),
        CommandRequest("me", "yumi_right", qd=right, first=7),
    )
    assert both == list(expected)
    assert not any(name.startswith("/cell/") for name in Commands("cell", {"irb120": robots.load("irb120")}).types)
    (setting,) = COMMANDS.requests("/yumi_left/set_parameter", '{"gain": 2.0, "gentle": true}', "me")
    assert setting == SetRequest("me", {"gain": 2.0, "gentle": True})
    assert COMMANDS.requests("/yumi_right/stop", None, "me") == [Stop("me")]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (SEVEN[:6], "Expected 7 numbers .* got 6"),
        ([*SEVEN[:6], math.nan], r"finite numbers .* got nan for yumi_robl_joint_7 \(number 7 of the message\)"),
        ([*SEVEN[:6], None], "finite numbers"),
        *[(one, "Expected 7 numbers") for one in ([*SEVEN[:6], "a"], [*SEVEN[:6], 10**400], None, 0.5, ["0"] * 7)],
        *[(one, "Expected 7 numbers") for one in ("0000000", np.ones((7, 1)), nested(900))],
        ([True] * 7, "Expected 7 numbers .* got .True"),
        (np.ones(7, bool), "Expected 7 numbers .* got .True"),
        ({str(k): 0 for k in range(7)}, "Expected 7 numbers .* got ."),
    ],
)
def test_one_bad_number_refuses_the_whole(given: Any, words: str) -> None:
    with pytest.raises(CommandRefused, match=words):
        COMMANDS.requests(POSITION, given, "me")


@pytest.mark.parametrize("given", ["", "gain", "[1]", "{}", None, 3, "[" * 3000, "x" * 70000])
def test_settings_that_are_none_are_refused(given: Any) -> None:
    with pytest.raises(CommandRefused, match="on /yumi_left/set_parameter"):
        COMMANDS.requests("/yumi_left/set_parameter", given, "me")


_JSON = st.recursive(st.none() | st.booleans() | st.floats() | st.text(), lambda inner: st.lists(inner), max_leaves=5)


@settings(max_examples=40)
@given(topic=st.sampled_from(sorted(COMMANDS.types)), given=_JSON)
def test_any_content_is_taken_or_refused_by_a_sentence(topic: str, given: Any) -> None:
    refused = ""
    try:
        found = COMMANDS.requests(topic, given, "me")
    except CommandRefused as error:
        found, refused = [], str(error)
    assert found or topic in refused
