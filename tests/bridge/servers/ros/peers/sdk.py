"""Node that uses zenoh-ros2-sdk, independent of armlab: PORT STATES COMMANDS; message definitions on standard input.

The SDK downloads missing definitions, so all definitions are written to its own folder first. Its command
line starts a daemon that lives for two hours; its classes, which are used here, do not.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import zenoh_ros2_sdk as sdk
from zenoh_ros2_sdk.qos import QosProfile

DEADLINE = 60.0  # s
JOINTS, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"


def until(condition):
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def define(texts):
    for name, text in texts.items():
        file = (Path(sdk.__file__).parents[1] / "messages" / name).with_suffix(".msg")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)


def graph(port):
    found = []
    for topic, _ in sdk.get_topic_names_and_types(0, router_port=port, timeout=5.0):
        info = sdk.get_topic_info(topic, 0, router_port=port, timeout=5.0, verbose=True)
        for kind, ends in (("out", info.publishers), ("in", info.subscribers)):
            for end in ends:
                qos = QosProfile.decode(end.qos)
                words = (qos.reliability.name, qos.durability.name, qos.history_kind.name, qos.history_depth)
                found.append([topic, kind, end.node_namespace, end.node_name, end.topic_type, end.type_hash, *words])
    return found


def main(port, reads, commands):
    define(json.load(sys.stdin))
    session = sdk.ZenohSession.get_instance("127.0.0.1", port)
    until(lambda: sdk.get_topic_names_and_types(0, router_port=port, timeout=5.0))
    found = {"graph": graph(port), "states": []}

    def state(message):
        stamp = message.header.stamp
        found["states"].append([stamp.sec * 10**9 + stamp.nanosec, message.position.tolist()])

    reader = sdk.ROS2Subscriber(reads, JOINTS, state, domain_id=0, router_port=port)
    writer = sdk.ROS2Publisher(commands, ARRAY, domain_id=0, router_port=port)
    found["hashes"] = {JOINTS: reader.type_hash, ARRAY: writer.type_hash}
    until(lambda: found["states"])
    layout = session.store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    end = time.monotonic() + DEADLINE
    while found["states"][-1][1][6] < found["states"][0][1][6] + 0.05 and time.monotonic() < end:
        writer.publish(layout=layout, data=np.array([0.0] * 6 + [0.05]))
        time.sleep(0.004)
    for one in (writer, reader, session):
        one.close()
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
