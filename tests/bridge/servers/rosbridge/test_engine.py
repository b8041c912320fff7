"""rosbridge without sockets: messages from and to a client in either dialect, requests to the loop, and queues."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.bridge.servers.messages import CommandRequest, Leave, SetRequest, Stop, read_request
from armlab.bridge.servers.ros.topics import header, store
from armlab.bridge.servers.rosbridge.engine import Engine, Outbox, Subscription
from armlab.bridge.servers.rosbridge.protocol import (
    LARGEST,
    SET_PARAM,
    Dialect,
    Rosapi,
    id_of,
    parameter_name,
    publish,
    read_type,
)
from armlab.errors import CommandRefused

from .conftest import Bench

POSITION = "/yumi_left/joint_group_position_controller/command"
STATES = "/yumi_left/joint_states"
SEVEN = [0.1 * k for k in range(7)]


def test_a_subscriber_gets_rows_in_its_dialect(bench: Bench) -> None:
    new, old, plain = (bench.client(f"c{k}") for k in range(3))
    bench.say(new, op="subscribe", topic=STATES, type="sensor_msgs/msg/JointState")
    bench.say(old, op="subscribe", topic=STATES, type="sensor_msgs/JointState", id="s", unknown=3)
    bench.say(plain, op="subscribe", topic=STATES[1:])
    bench.row()
    bench.row()
    (first, _), (_, second), (third, _) = bench.heard(new), bench.heard(old), bench.heard(plain)
    assert (first["op"], first["topic"]) == ("publish", STATES)
    assert first["msg"]["header"] == {"stamp": {"sec": 5, "nanosec": 250}, "frame_id": ""}
    assert second["msg"]["header"] == {"seq": 2, "stamp": {"secs": 5, "nsecs": 250}, "frame_id": ""}
    assert first["msg"]["position"] == bench.loop.robot.q_home.tolist()
    assert first["msg"]["effort"] == [], "missing values are never zeros"
    assert third == first | {"topic": STATES[1:]}


def test_names_without_a_leading_slash_are_resolved_and_echoed_as_asked(bench: Bench) -> None:
    client = bench.client()
    for topic in (STATES, STATES[1:]):
        bench.say(client, op="subscribe", topic=topic)
    bench.row()
    assert [one["topic"] for one in bench.heard(client)] == [STATES, STATES[1:]]
    bench.say(client, op="unsubscribe", topic=STATES[1:])
    bench.row()
    assert [one["topic"] for one in bench.heard(client)] == [STATES]
    bench.say(client, op="subscribe", topic="yumi_left/parameters")
    assert [one["topic"] for one in bench.heard(client)] == ["yumi_left/parameters"]
    bench.say(client, op="subscribe", topic=f"/{STATES}")
    assert "Expected the name of a topic" in bench.heard(client)[0]["msg"], "two leading slashes are not accepted"


def test_what_nobody_says_comes_from_the_configuration(bench: Bench) -> None:
    engine = Engine(bench.loop, dialect="ros1")
    client = engine.join("me")
    engine.take(client, '{"op":"subscribe","topic":"/yumi_left/joint_states"}', 0)
    bench.engine = engine
    bench.row()
    assert bench.heard(client)[0]["msg"]["header"]["seq"] == 1
    assert "secs" in bench.ask(client, "/rosapi/get_time")["time"]


def test_a_topic_that_nobody_wants_any_more_costs_nothing(bench: Bench) -> None:
    client = bench.client()
    for id_ in ("a", "b"):
        bench.say(client, op="subscribe", topic=STATES, id=id_)
    bench.say(client, op="unsubscribe", topic=STATES, id="a")
    bench.row()
    assert len(bench.heard(client)) == 1
    bench.say(client, op="unsubscribe", topic=STATES)
    bench.say(client, op="unsubscribe", topic=STATES)
    bench.row()
    assert bench.heard(client) == []
    assert client.subscriptions == {}


@pytest.mark.parametrize(
    ("operation", "words"),
    [
        ({"op": "subscribe", "topic": "/yumi_left/joint_state"}, "Did you mean '/yumi_left/joint_states'"),
        ({"op": "subscribe", "topic": STATES, "type": "sensor_msgs/Imu"}, "Expected sensor_msgs/JointState for"),
        ({"op": "subscribe", "topic": STATES, "type": "JointState"}, "Expected a type such as"),
        ({"op": "subscribe", "topic": STATES, "compression": "png"}, "no compression"),
        ({"op": "subscribe", "topic": STATES, "fragment_size": 100}, "not fragmented"),
        ({"op": "subscribe", "topic": STATES, "throttle_rate": -1}, "throttle_rate"),
        ({"op": "subscribe"}, "missing required field `topic`"),
        ({"op": "fragment", "data": "", "num": 0, "total": 1}, "fragments are not supported"),
        ({"op": "png", "data": ""}, "PNG"),
        ({"op": "advertise_service", "service": "/a"}, "one of the operations advertise, call_service"),
        ({"op": "advertise", "topic": "/mine", "type": "std_msgs/String"}, "command topic of this cell"),
        ({"op": "publish", "topic": STATES, "msg": {}}, "command topic of this cell"),
        ({"op": "publish", "topic": POSITION, "msg": {"data": SEVEN[:6]}}, "Expected 7 numbers .* got 6"),
        ({"op": "publish", "topic": POSITION, "msg": [1]}, "msg"),
        ({"op": "publish", "topic": "/yumi_left/set_parameter", "msg": {"data": "gain"}}, "Expected JSON"),
        ({"op": "service_response", "service": "/a", "result": True}, "no service_response"),
        ({"op": "set_level", "level": "loud"}, "level"),
    ],
)
def test_what_cannot_be_done_comes_back_as_a_status(bench: Bench, operation: dict[str, Any], words: str) -> None:
    client = bench.client()
    bench.say(client, **operation, id="mine")
    (status,) = bench.heard(client)
    assert (status["op"], status["id"], status["level"]) == ("status", "mine", "error")
    assert re.search(words, status["msg"]), status["msg"]
    assert bench.loop.asked == []
    assert re.search(words, bench.loop.reports[0])
    bench.row()
    assert bench.heard(client) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 20000, "a rosbridge v2 operation in JSON"),
        (b"{}", "a text message"),
        ("\ud800", "valid Unicode text"),
        ("9" * LARGEST + "9", f"a message of at most {LARGEST} characters"),
    ],
    ids=range(4),
)
def test_what_is_no_operation_comes_back_as_a_status(bench: Bench, text: str | bytes, words: str) -> None:
    client = bench.client()
    bench.say(client, text)
    assert bench.heard(client)[0]["msg"].startswith(f"Expected {words}")


def test_commands_carry_the_identity_of_the_connection(bench: Bench) -> None:
    client = bench.client("127.0.0.1:4711")
    bench.say(client, op="advertise", topic=POSITION, type="std_msgs/Float64MultiArray")
    bench.say(client, op="publish", topic=POSITION, msg={"data": SEVEN, "layout": {}})
    bench.say(client, op="unadvertise", topic=POSITION)
    bench.say(client, op="publish", topic="/yumi/joint_group_velocity_controller/commands", msg={"data": [0.0] * 14})
    bench.say(client, op="publish", topic="/yumi_left/set_parameter", msg={"data": '{"gain": 1.0}'})
    bench.say(client, op="publish", topic="/yumi_left/stop", msg={})
    bench.say(client, op="status", level="error", msg="of the client")
    bench.engine.leave(client)
    assert bench.heard(client) == []
    me = "127.0.0.1:4711"
    zeros = [0.0] * 7
    assert bench.loop.asked == [
        CommandRequest(me, "yumi_left", q=SEVEN, first=0),
        CommandRequest(me, "yumi_left", qd=zeros, first=0),
        CommandRequest(me, "yumi_right", qd=zeros, first=7),
        SetRequest(me, {"gain": 1.0}),
        Stop(me),
        Leave(me),
    ]


def test_a_missing_field_is_its_default_and_a_warning_for_who_wants_warnings(bench: Bench) -> None:
    client = bench.client()
    bench.say(client, op="set_level", level="warning")
    for _ in range(3):
        bench.say(client, op="publish", topic=POSITION, msg={"data": SEVEN})
    (status,) = bench.heard(client)
    assert status["level"] == "warning"
    assert "layout" in status["msg"]
    assert len(bench.loop.asked) == 3
    bench.say(client, op="publish", topic=POSITION, msg={})
    assert "Expected 7 numbers" in bench.heard(client)[0]["msg"]
    bench.say(client, op="set_level", level="none")
    bench.say(client, "no operation")
    assert bench.heard(client) == []


def test_without_a_token_everybody_reads_and_stops(bench: Bench) -> None:
    client = bench.client(may_ask=False)
    for name, content in ((POSITION, SEVEN), ("/yumi_left/set_parameter", '{"gain": 1.0}')):
        bench.say(client, op="publish", topic=name, msg={"data": content})
        assert "Expected a token" in bench.heard(client)[0]["msg"]
    assert "Expected a token" in bench.ask(client, "/rosapi/set_param", args={"name": "gain", "value": "1.0"})
    bench.say(client, op="publish", topic="/yumi_left/stop")
    assert bench.loop.asked == [Stop(client.name)]
    bench.say(client, op="subscribe", topic=STATES)
    bench.row()
    assert len(bench.heard(client)) == 1


def test_what_the_loop_refuses_goes_to_who_asked(bench: Bench) -> None:
    one, other = bench.client("one"), bench.client("other")
    refused = {"kind": "answer", "client": "one", "text": "yumi_left is commanded by labcomm.", "refused": []}
    bench.engine.text(refused, bench.now)
    bench.engine.text({**refused, "client": "gone"}, bench.now)
    assert bench.heard(one) == [{"op": "status", "level": "error", "msg": refused["text"]}]
    bench.engine.text({**refused, "text": "Done."}, bench.now)
    assert bench.heard(one) == [], "level info"
    assert bench.heard(other) == []


def test_parameters_are_echoed(bench: Bench) -> None:
    client = bench.client()
    bench.say(client, op="subscribe", topic="/yumi_left/parameters")
    bench.loop.declared.set("gain", 1.0)
    bench.loop.declared.apply()
    bench.engine.text(bench.loop.tell(), bench.now)
    first, second = (json.loads(one["msg"]["data"]) for one in bench.heard(client))
    assert (first, second) == ({"gain": 0.5, "note": "a"}, {"gain": 1.0, "note": "a"})


def test_a_setting_is_answered_when_the_loop_has_decided(bench: Bench) -> None:
    client = bench.client("me")
    call = {"op": "call_service", "service": "/rosapi/set_param", "id": "7"}
    bench.say(client, **call, args={"name": "gain", "value": "1.0"})
    assert bench.heard(client) == []
    assert bench.loop.asked == [SetRequest("me", {"gain": 1.0})]
    bench.loop.declared.set("gain", 1.0, "rosbridge me")
    bench.loop.declared.apply()
    bench.engine.text(bench.loop.tell(), bench.now)
    bench.engine.text(bench.loop.tell(), bench.now)
    done = {"op": "service_response", "id": "7", "service": "/rosapi/set_param", "values": {}, "result": True}
    assert bench.heard(client) == [done]
    bench.say(client, **call, args=["gain", "2.0"])
    refused = {"kind": "answer", "client": "me", "text": "Expected less.", "refused": ["gain"]}
    bench.engine.text({**refused, "refused": ["note"]}, bench.now)
    bench.engine.text(refused, bench.now)
    status, answer = bench.heard(client)
    assert status["op"] == "status"
    assert answer == {**done, "values": "Expected less.", "result": False}


def test_settings_of_one_parameter_are_answered_each_by_its_own_outcome(bench: Bench) -> None:
    client = bench.client("me")
    for id_, value in enumerate(("1.0", "99", "0.5")):
        bench.say(client, op="call_service", service="/rosapi/set_param", id=id_, args=["gain", value])

    def in_force(value: float) -> None:
        bench.loop.declared.set("gain", value, "rosbridge me")
        bench.loop.declared.apply()
        bench.engine.text(bench.loop.tell(), bench.now)

    assert bench.loop.asked == [SetRequest("me", {"gain": 1.0})]
    in_force(1.0)
    bench.engine.text({"kind": "answer", "client": "me", "text": "Expected less.", "refused": ["gain"]}, bench.now)
    in_force(0.5)
    assert bench.loop.asked == [SetRequest("me", {"gain": value}) for value in (1.0, 99, 0.5)]
    assert [(one["id"], one["result"]) for one in bench.heard(client)] == [(0, True), (1, False), (2, True)]


def test_a_setting_that_cannot_be_asked_for_is_answered_once(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    client = bench.client("me")

    def refuse(request: Any) -> bool:
        raise CommandRefused("Expected another text.")

    monkeypatch.setattr(bench.loop, "ask", refuse)
    bench.say(client, op="call_service", service="/rosapi/set_param", id=1, args=["note", '"x"'])
    bench.engine.tick(bench.now + 2 * 10**9)
    assert [(one["id"], one["values"]) for one in bench.heard(client)] == [(1, "Expected another text.")]


def test_a_setting_that_the_loop_does_not_answer(bench: Bench) -> None:
    client = bench.client("me")
    for _ in range(65):
        bench.say(client, op="call_service", service="/rosapi/set_param", args=["gain", "1.0"])
    assert "at most 64 pending requests to set parameters" in bench.heard(client)[0]["values"]
    bench.loop.declared.set("gain", 0.75, "local 1")
    bench.loop.declared.apply()
    bench.engine.text(bench.loop.tell(), bench.now)
    bench.engine.tick(bench.now + 10**9)
    assert bench.heard(client) == []
    bench.engine.tick(bench.now + 2 * 10**9)
    answers = bench.heard(client)
    assert len(answers) == 64
    assert not answers[0]["result"]
    assert "0.75, set by local 1" in answers[0]["values"]


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=8) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=6,
)

_OPS = ["subscribe", "unsubscribe", "advertise", "unadvertise", "publish", "call_service", "service_response", "png"]

_OPS += ["set_level", "status", "fragment"]

_NAMES = [STATES, POSITION, "/yumi_left/parameters", "/yumi_left/set_parameter", "/yumi_left/stop"]
FUZZED = Bench()

_VALUES = {
    "op": st.sampled_from(_OPS),
    "topic": st.sampled_from(_NAMES),
    "service": st.sampled_from(FUZZED.engine._rosapi.services),
    "type": st.sampled_from(["std_msgs/String", "sensor_msgs/msg/JointState"]),
    "msg": st.dictionaries(st.sampled_from(["data", "layout", "x"]), _JSON | st.just(SEVEN), max_size=3),
    "args": st.dictionaries(
        st.sampled_from(["name", "value", "type", "topic"]), _JSON | st.sampled_from(["gain", "1"])
    ),
    "id": _JSON,
    "level": st.sampled_from(["info", "warning", "error", "none"]),
    "throttle_rate": st.integers(-1, 100),
    "queue_length": st.integers(-1, 100),
}

_OPERATION = st.fixed_dictionaries({}, optional={name: value | _JSON for name, value in _VALUES.items()})


@settings(max_examples=40, deadline=None)
@given(said=st.lists(_OPERATION | _JSON | st.text() | st.binary(), max_size=8))
def test_whatever_a_client_says_is_done_or_answered(said: list[Any]) -> None:
    bench = FUZZED
    bench.loop.asked.clear()
    client = bench.client()
    for one in said:
        bench.say(client, one if isinstance(one, str | bytes) else json.dumps(one))
        bench.row(wrench=np.full(6, math.nan))
    bench.engine.text(bench.loop.tell(), bench.now)
    bench.engine.tick(bench.now + 2 * 10**9)
    assert {one["op"] for one in bench.heard(client)} <= {"publish", "status", "service_response"}
    bench.engine.leave(client)
    for request in bench.loop.asked:
        read_request(msgspec.json.encode(request))
    assert bench.loop.asked[-1] == Leave(client.name)


def test_ids_that_are_none() -> None:
    assert id_of('{"id": 3, "op": "unsubscribe"}') == 3
    assert id_of('{"id": [1], "op": 3}') is None
    assert id_of(json.dumps({"id": "x" * 1000})) == "x" * 256
    assert id_of(b"\xff") is None


def test_topics_and_types_in_both_dialects(bench: Bench) -> None:
    client = bench.client()
    new = bench.ask(client, "/rosapi/topics")
    old = bench.ask(client, "/rosapi/topics", type="rosapi/Topics")
    assert new["topics"] == old["topics"]
    types, names = dict(zip(new["topics"], new["types"])), dict(zip(old["topics"], old["types"]))
    assert (types[STATES], names[STATES]) == ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")
    assert types["/yumi_left/stop"] == "std_msgs/msg/Empty"
    assert bench.ask(client, "/rosapi/topic_type", args={"topic": STATES})["type"] == types[STATES]
    assert bench.ask(client, "/rosapi/topic_type", args={"topic": "/none"})["type"] == ""
    for text in ("sensor_msgs/JointState", "sensor_msgs/msg/JointState"):
        assert STATES in bench.ask(client, "/rosapi/topics_for_type", args=[text])["topics"]


def test_services_nodes_and_time(bench: Bench) -> None:
    client = bench.client()
    services = bench.ask(client, "/rosapi/services")["services"]
    assert services == list(Rosapi("yumi", {}, dict).services)
    assert {SET_PARAM, "/rosapi/get_param_names"} <= set(services)
    for service in services:
        name = bench.ask(client, "/rosapi/service_type", args={"service": service})["type"]
        assert name.startswith("rosapi_msgs/srv/")
    old = bench.ask(client, "/rosapi/service_type", type="rosapi/ServiceType", args={"service": "/rosapi/get_time"})
    assert old["type"] == "rosapi/GetTime"
    assert bench.ask(client, "/rosapi/nodes") == {"nodes": ["/yumi"]}
    assert bench.ask(client, "/rosapi/get_time")["time"]["sec"] > 1.7e9
    assert bench.ask(client, "/rosapi/get_time", type="rosapi/GetTime")["time"]["secs"] > 1.7e9
    assert "Did you mean '/rosapi/topics'" in bench.ask(client, "/rosapi/topicz")
    assert "Expected 'topic' to be a string" in bench.ask(client, "/rosapi/topic_type")


def test_message_details_name_all_types_inside(bench: Bench) -> None:
    client = bench.client()
    asked = {"type": "sensor_msgs/msg/JointState"}
    states, header, time = bench.ask(client, "/rosapi/message_details", args=asked)["typedefs"]
    assert (header["type"], time["type"]) == ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    assert states["fieldnames"] == ["header", "name", "position", "velocity", "effort"]
    assert states["fieldtypes"] == ["std_msgs/msg/Header", "string", "float64", "float64", "float64"]
    assert states["fieldarraylen"] == [-1, 0, 0, 0, 0]
    states, header = bench.ask(client, "/rosapi/message_details", args=["sensor_msgs/JointState"])["typedefs"]
    assert states["fieldtypes"][0] == header["type"] == "std_msgs/Header"
    assert header["fieldtypes"] == ["uint32", "time", "string"]
    diagnostics = bench.ask(client, "/rosapi/message_details", args=["diagnostic_msgs/DiagnosticStatus"])["typedefs"]
    assert diagnostics[0]["constnames"] == ["OK", "WARN", "ERROR", "STALE"]
    assert diagnostics[1]["type"] == "diagnostic_msgs/KeyValue"
    assert bench.ask(client, "/rosapi/message_details", args=["std_msgs/Empty"])["typedefs"][0]["fieldnames"] == []
    assert "See /rosapi/topics" in bench.ask(client, "/rosapi/message_details", args=["a/B"])


def test_parameters(bench: Bench) -> None:
    client = bench.client()
    assert bench.ask(client, "/rosapi/get_param_names") == {"names": ["gain", "note"]}
    for name in ("gain", "/gain", "/yumi:gain"):
        assert json.loads(bench.ask(client, "/rosapi/get_param", args={"name": name})["value"]) == 0.5
    assert bench.ask(client, "/rosapi/get_param", args={"name": "none", "default": "3"}) == {"value": "3"}
    assert "Did you mean 'gain'" in bench.ask(client, "/rosapi/get_param", args={"name": "gian"})
    assert parameter_name({"name": "/yumi:gain"}, {"gain": 1}) == "gain"
    assert bench.ask(client, "/rosapi/has_param", args=["gain"]) == {"exists": True}
    assert bench.ask(client, "/rosapi/has_param", args=[3]) == {"exists": False}
    assert "declared parameters" in bench.ask(client, "/rosapi/delete_param", args=["gain"])
    assert "as JSON text" in bench.ask(client, "/rosapi/set_param", args=["gain", "{"])
    assert "gain" in bench.ask(client, "/rosapi/set_param", args=["none", "1"])


TYPES = store().types


def encoded(topic: str, message: Any, dialect: Dialect, seq: int) -> bytes:
    return publish(topic, message, message.__msgtype__, dialect, seq)


@pytest.mark.parametrize(
    "text", ["", "JointState", "a/b/c", "a/msg/", "/a", "a/srv/B", "a/" + "b" * 300, "1/A", "a/B\n"]
)
def test_what_is_no_type_is_refused(text: str) -> None:
    with pytest.raises(CommandRefused, match="such as sensor_msgs/JointState"):
        read_type(text)


def test_golden_joint_state_in_both_dialects() -> None:
    numbers = np.array([0.5, np.nan, np.inf])
    message = TYPES["sensor_msgs/msg/JointState"](
        header(5_000_000_250, "base"), ["a"], numbers, numbers[:0], numbers[:1]
    )
    assert encoded("/yumi/joint_states", message, "ros2", 7) == (
        b'{"op":"publish","topic":"/yumi/joint_states","msg":{"header":{"stamp":{"sec":5,"nanosec":250},'
        b'"frame_id":"base"},"name":["a"],"position":[0.5,null,null],"velocity":[],"effort":[0.5]}}'
    )
    assert encoded("/yumi/joint_states", message, "ros1", 7) == (
        b'{"op":"publish","topic":"/yumi/joint_states","msg":{"header":{"seq":7,"stamp":{"secs":5,"nsecs":250},'
        b'"frame_id":"base"},"name":["a"],"position":[0.5,null,null],"velocity":[],"effort":[0.5]}}'
    )


def test_messages_in_messages() -> None:
    pair = TYPES["diagnostic_msgs/msg/KeyValue"]("rate", "250")
    status = TYPES["diagnostic_msgs/msg/DiagnosticStatus"](
        level=1, name="n", message="m", hardware_id="h", values=[pair]
    )
    message = TYPES["diagnostic_msgs/msg/DiagnosticArray"](header(1), [status])
    found = json.loads(encoded("/d", message, "ros2", 1))["msg"]["status"]
    assert found == [
        {"level": 1, "name": "n", "message": "m", "hardware_id": "h", "values": [{"key": "rate", "value": "250"}]}
    ]


MS = 1_000_000


def made(throttle_ms: float, queue_length: int) -> tuple[Subscription, Outbox]:
    outbox = Outbox()
    subscription = Subscription("/a", outbox, "ros2")
    subscription.add("", throttle_ms, queue_length)
    return subscription, outbox


def played(subscription: Subscription, outbox: Outbox, count: int) -> list[tuple[int, int]]:
    found = []
    for k in range(count):
        if subscription.is_due(4 * k * MS):
            subscription.offer(b"%d" % k, 4 * k * MS)
        found += [(4 * k, int(one)) for one in outbox.take(1000)]
    return found


@pytest.mark.parametrize(
    ("throttle_ms", "queue_length", "sent", "dropped"),
    [
        (10.0, 0, [(0, 0), (12, 3), (24, 6), (36, 9)], 0),  # the newest
        (12.0, 2, [(0, 0), (12, 1), (24, 4), (36, 7)], 4),  # 2, 3, 5 and 6; 8 and 9 wait
    ],
)
def test_throttled_topics(throttle_ms: float, queue_length: int, sent: list[tuple[int, int]], dropped: int) -> None:
    subscription, outbox = made(throttle_ms, queue_length)
    assert played(subscription, outbox, 10) == sent
    assert outbox.dropped == dropped


def test_of_several_ids_the_most_eager_counts() -> None:
    subscription, outbox = made(1000.0, 0)
    subscription.add("fast", 0.0, 0)
    assert len(played(subscription, outbox, 5)) == 5
    assert not subscription.remove("fast")
    assert not subscription.remove("unknown")
    assert [number for _, number in played(subscription, outbox, 500)] == [4, 254]
    assert subscription.remove(None)


def test_what_waits_for_a_slow_client_is_bounded_in_number_time_and_bytes() -> None:
    subscription, queue = made(0.0, 2)
    for k in range(5):
        subscription.offer(b"%d" % k, 0)
        queue.put(b"b%d" % k, 0, "/b")
    assert queue.take(1000) == [b"b0", b"b1", b"b2", b"3", b"b3", b"4", b"b4"]
    old, large = Outbox(), Outbox()
    for k in range(500):
        old.put(b"%d" % k, 4 * k * MS)
        large.put(bytes(2**16), 0)
    assert (queue.dropped, old.dropped, large.dropped) == (3, 249, 436)
    assert old.take(4) == [b"249", b"250"], "a second of them"
    assert old.take(2**20) == [b"%d" % k for k in range(251, 500)]
    assert len(large.take(2**30)) == 64, "four megabytes"


def test_a_client_is_stuck_when_it_takes_nothing_for_ten_seconds() -> None:
    box = Outbox()
    assert not box.is_stuck(10**15)
    for k in range(2501):
        box.put(b"", 4 * k * MS)
        assert not box.is_stuck(4 * k * MS)
    box.put(b"", 10_004 * MS)
    assert box.is_stuck(10_004 * MS)
    box.take(1)
    assert not box.is_stuck(10_004 * MS)
