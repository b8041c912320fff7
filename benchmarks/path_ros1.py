"""rospy alone, under the system's Python: `path_ros1.py read COUNT` or `path_ros1.py write`."""

from __future__ import annotations

import os
import sys

import rospy
from geometry_msgs.msg import WrenchStamped
from path_ends import JOINTS, ROBOT, Lines, numbers, paced
from sensor_msgs.msg import JointState

NAMES = [f"yumi_robl_joint_{k}" for k in range(1, JOINTS + 1)]
TOPICS = {"J": (f"/{ROBOT}/joint_states", JointState), "W": (f"/{ROBOT}/wrench", WrenchStamped)}


def read(count):
    """Receive messages until there are enough."""
    lines = Lines(count)

    def take(message, kind):
        stamp = message.header.stamp
        lines.add(kind, stamp.secs * 10**9 + stamp.nsecs)

    for kind, (topic, type_) in TOPICS.items():
        rospy.Subscriber(topic, type_, take, kind, queue_size=1000, tcp_nodelay=True)
    lines.wait()


def write():
    """Send a new message of each kind in every period."""
    joints, wrenches = (
        rospy.Publisher(topic, type_, queue_size=500, tcp_nodelay=True) for topic, type_ in TOPICS.values()
    )

    def send(stamp_ns):
        stamp = rospy.Time(*divmod(stamp_ns, 10**9))
        message = JointState()
        message.header.stamp, message.name = stamp, NAMES
        message.position, message.velocity, message.effort = numbers(stamp_ns)
        joints.publish(message)
        wrench = WrenchStamped()
        wrench.header.stamp, wrench.header.frame_id = stamp, "tool"
        wrench.wrench.force.z, wrench.wrench.torque.z = 1.0, 2.0
        wrenches.publish(wrench)

    paced(send)


def main():
    rospy.init_node("benchmark", anonymous=True, disable_signals=True)
    if sys.argv[1] == "read":
        read(int(sys.argv[2]))
    else:
        write()
    sys.stdout.flush()
    os._exit(0)  # a normal exit would wait for the threads


if __name__ == "__main__":
    main()
