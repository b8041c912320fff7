"""Read a URDF, select an arm, compute its poses and gravity torques, and save it as TOML."""

import numpy as np

from armlab import dynamics, kinematics, robots

ARM = """<robot name="lift">
  <link name="floor"/>
  <joint name="column" type="prismatic"><parent link="floor"/><child link="carriage"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="0.8" effort="500" velocity="0.5"/></joint>
  <link name="carriage"><inertial><mass value="5"/><origin xyz="0.1 0 0"/>
    <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.03"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="carriage"/><child link="beam"/>
    <origin xyz="0.3 0 0"/><axis xyz="0 1 0"/><limit lower="-1.5" upper="1.5" effort="60" velocity="2"/></joint>
  <link name="beam"><inertial><mass value="2"/><origin xyz="0.25 0 0"/>
    <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.04" iyz="0" izz="0.04"/></inertial></link>
  <joint name="wrist" type="fixed"><parent link="beam"/><child link="hand"/><origin xyz="0.5 0 0"/></joint>
  <link name="hand"><inertial><mass value="0.5"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial></link>
</robot>"""


def main() -> None:
    tree = robots.urdf.parse(ARM)  # for a file: robots.urdf.read, or robots.load for a single arm
    print(tree, "from", tree.root, "to", ", ".join(tree.tips))
    robot = tree.chain("floor", "hand")  # the fixed joint is merged: the hand becomes part of the beam
    print("joints", robot.joint_names, "masses", robot.inertias[:, 0], "kg, effort limits", robot.tau_max, "N, N m")

    q = np.array([0.4, 0.5])
    print("hand position", kinematics.forward(robot, q)[:3, 3].round(4), "m")
    print("gravity force and torque", dynamics.gravity(robot, q).round(3), "N, N m")

    robots.save(robot, "lift.toml")  # lossless
    robots.save(robot, "lift.urdf")  # for Pinocchio, MuJoCo and ROS
    print("loaded robot equals the saved one:", robots.load("lift.toml") == robot)


if __name__ == "__main__":
    main()
