"""The services by which a client finds out what there is."""

from __future__ import annotations

import json

from armlab.bridge.servers.rosbridge.rosapi import SET_PARAM, Rosapi, parameter_name

from .conftest import Bench

STATES = "/yumi_left/joint_states"


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
    assert "Expected 'topic' as a text" in bench.ask(client, "/rosapi/topic_type")


def test_message_details_name_all_types_inside(bench: Bench) -> None:
    client = bench.client()
    asked = {"type": "sensor_msgs/msg/JointState"}
    states, header, time = bench.ask(client, "/rosapi/message_details", args=asked)["typedefs"]
    assert (states["type"], header["type"], time["type"]) == (
        "sensor_msgs/msg/JointState",
        "std_msgs/msg/Header",
        "builtin_interfaces/msg/Time",
    )
    assert states["fieldnames"] == ["header", "name", "position", "velocity", "effort"]
    assert states["fieldtypes"] == ["std_msgs/msg/Header", "string", "float64", "float64", "float64"]
    assert states["fieldarraylen"] == [-1, 0, 0, 0, 0]
    states, header = bench.ask(client, "/rosapi/message_details", args=["sensor_msgs/JointState"])["typedefs"]
    assert states["fieldtypes"][0] == header["type"] == "std_msgs/Header"
    assert dict(zip(header["fieldnames"], header["fieldtypes"])) == {
        "seq": "uint32",
        "stamp": "time",
        "frame_id": "string",
    }
    diagnostics = bench.ask(client, "/rosapi/message_details", args=["diagnostic_msgs/DiagnosticStatus"])["typedefs"]
    assert diagnostics[0]["constnames"] == ["OK", "WARN", "ERROR", "STALE"]
    assert diagnostics[1]["type"] == "diagnostic_msgs/KeyValue"
    assert bench.ask(client, "/rosapi/message_details", args=["std_msgs/Empty"])["typedefs"][0]["fieldnames"] == []
    assert "Ask /rosapi/topics" in bench.ask(client, "/rosapi/message_details", args=["a/B"])


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
    assert "declared and stay" in bench.ask(client, "/rosapi/delete_param", args=["gain"])
    assert "as JSON text" in bench.ask(client, "/rosapi/set_param", args=["gain", "{"])
    assert "gain" in bench.ask(client, "/rosapi/set_param", args=["none", "1"])
