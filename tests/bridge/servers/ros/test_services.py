"""Services of the nodes, parameters, the robot description and the graph, over DDS and Zenoh."""

from __future__ import annotations

import io
import socket
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.bridge.servers.ros.services import register
from armlab.bridge.servers.ros.topics import later, store

from ..conftest import until
from .conftest import turning_cell

pytestmark = pytest.mark.usefixtures("often")
ARM = robots.load("yumi_left")
INTERFACES = "rcl_interfaces"
LISTED = ["gain", "count", "mode", "is_on", "axis"]


@pytest.fixture(scope="module", params=["ros2", pytest.param("rmw_zenoh", marks=pytest.mark.slow)])
def running(request: pytest.FixtureRequest) -> Iterator[Any]:
    with turning_cell(request.param) as one:
        yield one


def message(name: str, *fields: Any) -> Any:
    return store().types[f"{INTERFACES}/{name}"](*fields)


def call(running: Any, service: str, *fields: Any) -> Any:
    kind = "".join(word.capitalize() for word in service.split("_"))
    request = message(f"srv/{kind}_Request", *fields)
    response = running.node.call(f"/yumi_left/{service}", f"{INTERFACES}/srv/{kind}", request)
    (field, _), *_ = store().fielddefs[f"{INTERFACES}/srv/{kind}_Response"][1]
    return getattr(response, field)


def parameter(name: str, kind: int, value: Any = None) -> Any:
    arrays = [np.array([], dtype) for dtype in (np.uint8, bool, np.int64, float)]
    fields = [kind, False, 0, 0.0, "", *arrays, []]
    if value is not None:
        fields[kind] = value
    return message("msg/Parameter", name, message("msg/ParameterValue", *fields))


def test_parameters_are_listed_and_described(running: Any) -> None:
    assert call(running, "list_parameters", [], 0).names == LISTED
    assert call(running, "list_parameters", ["mode", "ga"], 0).names == ["mode"]
    assert list(call(running, "get_parameter_types", [*LISTED, "missing"])) == [3, 2, 4, 1, 8, 0]
    gain, count, missing = call(running, "describe_parameters", ["gain", "count", "missing"])
    assert (gain.type, gain.additional_constraints, gain.read_only) == (3, "Any client may set this parameter.", False)
    assert [(one.from_value, one.to_value) for one in gain.floating_point_range] == [(0.0, 1.0)]
    assert [(one.from_value, one.step) for one in count.integer_range] == [(0, 1)]
    assert (missing.name, missing.type) == ("missing", 0)


def test_parameters_are_set_and_read_back(running: Any) -> None:
    given = [
        parameter("gain", 2, 1),
        parameter("count", 2, 7),
        parameter("is_on", 1, False),
        parameter("axis", 8, np.array([0.5, 2.0])),
    ]
    assert [(one.successful, one.reason) for one in call(running, "set_parameters", given)] == [(True, "")] * 4
    gain, count, is_on, axis, mode, missing = call(
        running, "get_parameters", ["gain", "count", "is_on", "axis", "mode", "missing"]
    )
    assert (gain.type, gain.double_value) == (3, 1.0)
    assert (count.type, count.integer_value) == (2, 7)
    assert (is_on.type, is_on.bool_value) == (1, False)
    assert (axis.type, axis.double_array_value.tolist()) == (8, [0.5, 2.0])
    assert (mode.type, mode.string_value) == (4, "soft")
    assert missing.type == 0
    assert call(running, "set_parameters_atomically", [parameter("gain", 3, 0.5), parameter("count", 2, 1)]).successful
    assert running.exchange.parameters.values()["count"] == 1


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (parameter("gian", 3, 0.5), "gain"),
        (parameter("gain", 4, "high"), "Expected a finite number for the parameter gain"),
        (parameter("gain", 3, 1.5), "Expected a number from 0 to 1"),
        (parameter("gain", 3, np.nan), "Expected finite numbers for gain, got nan"),
        (parameter("gain", 0), "cannot be deleted"),
        (parameter("gain", 77), "cannot be deleted"),
        (parameter("count", 3, 1.5), "Expected a whole number for the parameter count"),
        (parameter("axis", 8, np.array([1.0])), "Expected 2 finite numbers"),
    ],
)
def test_what_cannot_be_set_is_answered_with_the_reason(running: Any, given: Any, words: str) -> None:
    before = running.exchange.parameters.values()["gain"]
    refused, other = call(running, "set_parameters", [given, parameter("count", 2, 2)])
    assert words in refused.reason
    assert (refused.successful, other.successful) == (False, True)
    together = call(running, "set_parameters_atomically", [parameter("gain", 3, 0.25), given])
    assert not together.successful
    assert running.exchange.parameters.values()["gain"] == before


def test_the_description_and_the_frames_of_the_arm(running: Any) -> None:
    yourdfpy = pytest.importorskip("yourdfpy", reason="yourdfpy is not installed")
    texts = running.node.read_late("/yumi_left/robot_description", "std_msgs/msg/String")
    fixed = running.node.read_late("/tf_static", "tf2_msgs/msg/TFMessage")
    moving = running.node.read("/tf", "tf2_msgs/msg/TFMessage")
    found: dict[str, Any] = {}

    def come(name: str, read: Callable[[], list[Any]]) -> bool:
        found.setdefault(name, []).extend(read())
        return bool(found[name])

    for name, read in (("text", texts), ("fixed", fixed), ("moving", moving)):
        until(lambda name=name, read=read: come(name, read))
    urdf = yourdfpy.URDF.load(io.BytesIO(found["text"][0].data.encode()), load_meshes=False)
    assert list(urdf.actuated_joint_names) == list(ARM.ros_joint_names)
    urdf.update_cfg(ARM.q_home)
    T_base_tool = kinematics.forward(ARM, ARM.q_home)
    np.testing.assert_allclose(urdf.get_transform("yumi_left_tool", "yumi_left_base"), T_base_tool, atol=1e-9)
    tree = {one.child_frame_id: one for one in [*found["fixed"][0].transforms, *found["moving"][0].transforms]}
    T, frame = np.eye(4), "yumi_left_tool"
    while frame in tree:
        T, frame = _matrix(tree[frame].transform) @ T, tree[frame].header.frame_id
    assert frame == "yumi_left_base"
    np.testing.assert_allclose(T, T_base_tool, atol=1e-9)


def _matrix(transform: Any) -> np.ndarray:
    T, (w, x, y, z) = np.eye(4), (getattr(transform.rotation, name) for name in "wxyz")
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = [getattr(transform.translation, name) for name in "xyz"]
    return T


def test_clients_over_dds_that_leave_are_forgotten() -> None:
    pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
    from .dds_peers import DdsCell

    cell = DdsCell()
    try:
        servers, request = cell.server._servers, message("srv/ListParameters_Request", [], 0)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            for noise in (b"", b"RTPS", b"RTPS\2\3\1\x10" + b"p" * 12 + b"\x15\x07\xff\xff" + b"\xff" * 30):
                one.sendto(noise, servers._socket.getsockname())
        for _ in range(3):
            told = cell.node.call("/yumi_left/list_parameters", f"{INTERFACES}/srv/ListParameters", request)
            assert told.result.names == LISTED
        until(lambda: not servers._clients)  # their writers and readers announce their departure in separate packets
        until(lambda: not any(one.acknowledged for id_, one in list(servers._writers.items()) if id_[3] == 3))
    finally:
        cell.close()


def test_hashes_of_services() -> None:
    """Hashes in the keys of rmw_zenoh in Jazzy."""
    register({"example_interfaces/srv/AddTwoInts": ("int64 a\nint64 b", "int64 sum")})
    for name, expected in {
        "example_interfaces/srv/AddTwoInts": "e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
        "rcl_interfaces/srv/ListParameters": "3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
        "rcl_interfaces/srv/GetParameters": "bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
        "rcl_interfaces/srv/SetParameters": "56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0",
    }.items():
        assert store().hash_rihs01(name) == f"RIHS01_{expected}"


@pytest.mark.parametrize("size", [16, 24])
def test_the_graph_over_dds_in_the_layout_of_the_reader(size: int) -> None:
    """Gids have 24 bytes in Humble and 16 since Iron."""
    pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
    from .dds_peers import RELIABLE, DataReader, DdsCell, DdsTopic, Policy, Qos, carrier

    cell, name = DdsCell(), "rmw_dds_common/msg/ParticipantEntitiesInfo"
    try:
        quality = Qos(Policy.Durability.TransientLocal, base=RELIABLE)
        if size == 16:
            quality = Qos(Policy.Userdata(b"typehash=RIHS01_0;"), base=quality)
        topic = DdsTopic(cell.node.participant, "ros_discovery_info", carrier(name))
        reader = DataReader(cell.node.participant, topic, quality)
        found: list[Any] = []
        until(lambda: found.extend(one.cdr for one in reader.take(10)) or found)
        told = (later() if size == 16 else store()).deserialize_cdr(found[0], name)
        cell_node, arm_node = told.node_entities_info_seq
        assert (cell_node.node_name, arm_node.node_name, arm_node.node_namespace) == ("yumi", "yumi_left", "/")
        server = cell.server
        assert len(told.gid.data) == size
        assert told.gid.data[:16].tobytes().endswith(b"\0\0\1\xc1")
        services, taken = len(server.services), len(server._commands.types) + len(server._goals.topics)
        assert len(arm_node.writer_gid_seq) + len(cell_node.writer_gid_seq) == len(server.published) + services
        assert len(arm_node.reader_gid_seq) == taken + services
        assert len(cell_node.writer_gid_seq) == 2, "/tf and /tf_static"
    finally:
        cell.close()
