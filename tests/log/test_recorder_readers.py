"""What a recorder wrote is read by the programs of others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armlab import robots
from armlab.log import Column, Recorder, inspect, read
from armlab.robots import Robot


def test_a_finished_file_is_read_by_rosbags_and_by_mcap(recording: Callable[..., Path], rows: Callable) -> None:
    from mcap.reader import make_reader
    from rosbags.highlevel import AnyReader

    path = recording(40)
    with AnyReader([path]) as reader:
        states = [c for c in reader.connections if c.topic == "/yumi_right/joint_states"]
        messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(states)]
        stamps = [time for _, time, _ in reader.messages(states)]
        estimates = [c for c in reader.connections if c.topic == "/yumi_right/wrench_hat"]
        for i, (c, _, raw) in enumerate(reader.messages(estimates)):
            estimate = reader.deserialize(raw, c.msgtype)
            assert np.array_equal(estimate.covariance.reshape(6, 6), rows(i)[1].record["wrench_hat_cov"])
    assert len(messages) == 40
    for i, message in enumerate(messages):
        state, _, tick = rows(i)
        assert message.name == [f"yumi_robr_joint_{k}" for k in range(1, 8)]
        assert np.array_equal(message.position, state.q)
        assert np.array_equal(message.effort, state.tau)
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == tick.stamp_ns == stamps[i]
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.channel_message_counts[2] == 40
        assert reader.get_header().profile == "ros2"
        names = {attachment.name for attachment in reader.iter_attachments()}
        assert names == {"robot.toml", "summary.json"}
        ticks = [message.sequence for _, channel, message in reader.iter_messages("/yumi_right/tick")]
    assert ticks == list(range(40))


def test_every_topic_is_read_by_mcap_ros2_support(recording: Callable[..., Path], rows: Callable) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    path, seen = recording(20), {}
    with path.open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            seen.setdefault(channel.topic, []).append(message)
    assert {topic: len(messages) for topic, messages in seen.items()} == {
        topic.name: topic.messages for topic in inspect(path).topics if topic.messages
    }
    assert [message.tick for message in seen["/yumi_right/tick"]] == list(range(20))
    assert list(seen["/yumi_right/columns/fext"][7].values) == rows(7)[1].record["fext"].tolist()


@pytest.mark.parametrize("topic", ["joint_states", "joint_states_ref", "joint_states_sent"])
def test_joints_have_the_names_of_the_urdf_and_of_the_live_topics(
    recording: Callable[..., Path], robot: Robot, tmp_path: Path, topic: str
) -> None:
    """A played recording drives robot_state_publisher."""
    from rosbags.highlevel import AnyReader

    path = recording(2)
    robots.save(robot, tmp_path / "arm.urdf")
    with AnyReader([path]) as reader:
        states = [c for c in reader.connections if c.topic == f"/yumi_right/{topic}"]
        names = {tuple(reader.deserialize(raw, c.msgtype).name) for c, _, raw in reader.messages(states)}
    assert names == {robots.load(tmp_path / "arm.urdf").joint_names} == {robot.ros_joint_names}


def test_names_of_joints_in_messages_do_not_change_the_table(
    recording: Callable[..., Path], robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Recordings from before have the names of the description in their messages."""
    now = read(recording(3))
    with monkeypatch.context() as before:
        before.setattr(Robot, "ros_joint_names", property(lambda robot: robot.joint_names))
        then = read(recording(3, "before.mcap"))
    assert now.columns == then.columns
    assert now.columns["q"].labels == robot.joint_names
    assert now.sha256 == then.sha256


def test_poses_are_written_with_the_real_part_last(recording: Callable[..., Path], rows: Callable) -> None:
    from rosbags.highlevel import AnyReader

    from armlab.lie import quaternion

    with AnyReader([recording(60)]) as reader:
        poses = [c for c in reader.connections if c.topic == "/yumi_right/tcp_pose"]
        for i, (c, _, raw) in enumerate(reader.messages(poses)):
            o = reader.deserialize(raw, c.msgtype).pose.orientation
            expected = quaternion.from_matrix(rows(i)[0].T_frame_tool[:3, :3])
            assert np.array([o.w, o.x, o.y, o.z]) * np.sign(o.w) == pytest.approx(
                expected * np.sign(expected[0]), abs=1e-12
            )


def test_a_force_sensor_of_its_own_is_a_stamped_wrench(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    from rosbags.highlevel import AnyReader

    name = "force.wrench_raw"
    with Recorder(tmp_path / "run.mcap", robot, extra={name: Column((6,), unit="N, N m", frame="sensor")}) as recorder:
        for i in range(5):
            state, _, tick = rows(i)
            recorder.row(state, None, tick._replace(record={name: state.wrench_raw + 1.0}))
    table = read(recorder.path)
    assert np.array_equal(table[name], table["wrench_raw"] + 1.0)
    assert (table.columns[name].unit, table.columns[name].frame) == ("N, N m", "sensor")
    with AnyReader([recorder.path]) as reader:
        topics = [c for c in reader.connections if c.topic == "/yumi_right/wrench/force"]
        forces = [reader.deserialize(raw, c.msgtype).wrench.force.x for c, _, raw in reader.messages(topics)]
    assert np.array_equal(forces, table[name][:, 0])
