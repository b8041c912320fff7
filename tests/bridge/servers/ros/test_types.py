"""The message types have the hashes that ROS 2 gives them (golden values, and the Humble, Jazzy and Kilted stores)."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from armlab import robots
from armlab.bridge.servers.ros.requests import Commands
from armlab.bridge.servers.ros.topics import Topics, content, domain_number, store, type_name
from armlab.bridge.servers.row import RowSchema
from armlab.errors import CommandRefused, ConfigError

HASHES = {
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "geometry_msgs/msg/WrenchStamped": "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
    "std_msgs/msg/Float64MultiArray": "1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f",
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}


@pytest.mark.parametrize("name", HASHES)
def test_types_have_the_hashes_of_ros_2(name: str) -> None:
    assert store().hash_rihs01(name) == f"RIHS01_{HASHES[name]}"


@pytest.mark.parametrize("distribution", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
def test_every_type_is_the_same_in_every_distribution(distribution: Stores) -> None:
    arm = robots.load("yumi_left")
    spoken = {one.type for one in Topics({arm.name: arm}, RowSchema.of([arm])).published.values()}
    spoken |= set(Commands("yumi", {arm.name: arm}).types.values())
    theirs = get_typestore(distribution)
    assert spoken - set(theirs.fielddefs) == {"abb_egm_msgs/msg/EGMState"}
    for name in spoken & set(theirs.fielddefs):
        assert store().hash_rihs01(name) == theirs.hash_rihs01(name), name


def test_states_of_egm_are_known() -> None:
    names = [name for name, _ in store().fielddefs["abb_egm_msgs/msg/EGMChannelState"][1]]
    assert names == [
        "name",
        "active",
        "egm_convergence_met",
        "egm_client_state",
        "motor_state",
        "rapid_execution_state",
        "utilization_rate",
    ]


TAKEN = {"std_msgs/msg/Float64MultiArray", "std_msgs/msg/String", "std_msgs/msg/Empty"}


def test_names_of_types() -> None:
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
    layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
    array = types["std_msgs/msg/Float64MultiArray"](layout, np.arange(3.0))
    raw = bytes(store().serialize_cdr(array, array.__msgtype__))
    assert content(array.__msgtype__, raw).tolist() == [0.0, 1.0, 2.0]
    text = types["std_msgs/msg/String"]('{"gain": 2.0}')
    assert content(text.__msgtype__, bytes(store().serialize_cdr(text, text.__msgtype__))) == '{"gain": 2.0}'
    assert content("std_msgs/msg/Empty", b"\0\1\0\0\0\0\0\0") is None


@given(name=st.sampled_from(sorted(TAKEN)), data=st.binary(max_size=80))
def test_bytes_that_are_no_message_are_refused(name: str, data: bytes) -> None:
    for raw in (data, b"\0\1\0\0" + data, b"\0\0\0\0" + data):
        with contextlib.suppress(CommandRefused):
            found = content(name, raw)
            assert found is None or isinstance(found, str | np.ndarray)


def test_a_message_too_large_is_refused() -> None:
    with pytest.raises(CommandRefused, match="at most 131072 bytes"):
        content("std_msgs/msg/String", b"\0" * (2**17 + 1))
