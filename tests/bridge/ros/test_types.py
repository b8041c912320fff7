"""The message types have the hashes that ROS 2 gives them (golden values of the Humble, Jazzy and Kilted stores)."""

from __future__ import annotations

import pytest

from armlab.bridge.ros import store

HASHES = {
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "geometry_msgs/msg/WrenchStamped": "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
    "std_msgs/msg/Float64MultiArray": "1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f",
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
}


@pytest.mark.parametrize("name", HASHES)
def test_types_have_the_hashes_of_ros_2(name: str) -> None:
    assert store().hash_rihs01(name) == f"RIHS01_{HASHES[name]}"


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
