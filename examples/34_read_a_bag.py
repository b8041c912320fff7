"""Read a ROS 2 bag with UR5e joint states at 500 Hz, in the driver's order, and a temperature at 10 Hz."""

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from armlab import log, robots
from armlab.errors import LogError


def record(path: Path, names: list[str]) -> None:  # replaces `ros2 bag record`
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = ("sensor_msgs/msg/JointState", "std_msgs/msg/Float64", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    state, number, header, time = (store.types[kind] for kind in kinds)
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
        joints = bag.add_connection("/joint_states", kinds[0], typestore=store)
        warmth = bag.add_connection("/temperature", kinds[1], typestore=store)
        for i in range(1000):
            ns, x = i * 2_000_000, np.sin(0.01 * i + np.arange(6))
            stamp = header(stamp=time(sec=1 + ns // 10**9, nanosec=ns % 10**9), frame_id="")
            message = state(header=stamp, name=names, position=x, velocity=5 * x, effort=9 * x)
            bag.write(joints, 10**9 + ns, store.serialize_cdr(message, kinds[0]))
            if i % 50 == 0:
                bag.write(warmth, 10**9 + ns, store.serialize_cdr(number(data=30.0 + 0.001 * i), kinds[1]))


def main() -> None:
    record(Path("ur5e_bag"), sorted(robots.load("ur5e").joint_names))
    try:
        log.read("ur5e_bag")
    except LogError as error:  # topics with two rates: `clock=` must name one of them
        print(error)
    print(log.read("ur5e_bag", robot="ur5e", clock="/joint_states"))
    print({topic: len(table) for topic, table in log.read_topics("ur5e_bag").items()})


if __name__ == "__main__":
    main()
