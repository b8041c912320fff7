# Run inside a container of ROS 2 beside a bridge: each part prints its name, then what ros2 says. .ci/ros2.py judges.
source "/opt/ros/$ROS_DISTRO/setup.bash"
export PYTHONUNBUFFERED=1

robot=/yumi_left
array=std_msgs/msg/Float64MultiArray

part() { # its name, seconds it may take, its command
  echo "== $1"
  timeout --signal=INT "$2" "${@:3}" 2>&1
}
echo_once() { # name of the part, topic
  part "$1" 60 ros2 topic echo --once --no-daemon --spin-time 10 "$robot/$2"
}
command_velocity() {
  part pub 8 ros2 topic pub -r 100 "$robot/joint_group_velocity_controller/commands" "$array" \
    "{data: [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.05]}" | head -1
}

echo_once echo joint_states
part hz 25 ros2 topic hz "$robot/joint_states"
part info 60 ros2 topic info -v --no-daemon --spin-time 10 "$robot/joint_states"
part pub 60 ros2 topic pub --once "$robot/set_parameter" std_msgs/msg/String '{data: "{\"gain\": 3.0}"}'
echo_once parameters parameters
command_velocity
echo_once moved joint_states
part pub 60 ros2 topic pub --once "$robot/stop" std_msgs/msg/Empty
echo_once stopped joint_states
command_velocity
echo_once held joint_states
