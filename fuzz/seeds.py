"""Write the seed inputs in `corpus` with armlab's own encoders: `python fuzz/seeds.py`. Past failures are preserved."""

from __future__ import annotations

import io
import json
import struct
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))


from armlab import log, models, robots  # noqa: E402
from armlab.bridge.servers.ros.rmw_zenoh import Names, Origin  # noqa: E402
from armlab.bridge.servers.ros.topics import store  # noqa: E402
from armlab.bridge.servers.row import RowSchema, RowWriter  # noqa: E402
from armlab.bridge.servers.zenoh.messages import Attachment  # noqa: E402
from armlab.log import Tick  # noqa: E402
from armlab.models.friction import Friction, FrictionBound, Ripple  # noqa: E402
from armlab.models.torque import Quality, Training  # noqa: E402
from armlab.robots.urdf.writing import write_urdf  # noqa: E402
from armlab.state import State  # noqa: E402
from armlab.wire.egm import EgmCodec, Reference  # noqa: E402
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec  # noqa: E402
from armlab.wire.labcomm import Encoder, parse_lc  # noqa: E402
from armlab.wire.labcomm.types import PRIMS, Array, Field, SampleType, Struct  # noqa: E402
from fuzz import fleet  # noqa: E402

Seeds = Iterator[tuple[str, str, bytes]]
ARM = robots.load("yumi_left")
SEVEN = np.linspace(-0.3, 0.3, 7)
LANGUAGE = "typedef struct { double x[3]; } point;\nsample (unit:rad) struct { int tm; point p[2]; string s; } row;\n"


def framed(*pieces: bytes) -> bytes:
    """Return the pieces, each preceded by its length."""
    return b"".join(len(piece).to_bytes(2, "big") + piece for piece in pieces)


def egm() -> Seeds:
    """Robot packets of all flavours, and replies."""
    for number, (name, flavour) in enumerate((("yumi_left", "7"), ("irb120", "6.10"), ("irb2400", "6.06"))):
        arm = robots.load(name)
        side = RobotSideCodec(arm, flavour, extension=flavour == "7", force=flavour == "7")
        q = 0.1 * np.arange(1.0, arm.n + 1)
        said = RobotMessage(0, 4, q, q, 10**18, T_frame_tool=np.eye(4), qd=q, tau=q, wrench_raw=np.ones(6), mono_ns=9)
        packets = [side.encode_robot(said._replace(seqno=k, tm_ms=4 * k)) for k in range(2)]
        yield "egm_robot", flavour, bytes([number]) + framed(*packets)
        yield "egm_session", flavour, bytes([number]) + framed(*(b"\0\x10" + one for one in packets))
        codec = EgmCodec(arm, extension=True)
        yield "egm_sensor", name, bytes([number]) + codec.encode(Reference(q, q, q, 3, 12, 3, 9))
    codec = EgmCodec(ARM)
    yield "egm_sensor", "pose", b"\0" + codec.encode_pose(np.eye(4), np.ones(6), 1, 4)
    yield "egm_sensor", "path", b"\0" + codec.encode_path_correction((1e-3, 2e-3), 0.01, 1, 4)


def labcomm() -> Seeds:
    """Streams of several dialects, declarations, and client data."""
    row = SampleType("row", Struct((Field("t", PRIMS["double"]), Field("q", Array((0,), PRIMS["float"])))))
    name = SampleType("name", PRIMS["string"])
    value = {"t": 0.004, "q": [0.5, -0.5]}
    for dialect in ("2014v1", "2014", "2014i", "2013", "2006"):
        encoder = Encoder(dialect)
        stream = encoder.version() + encoder.define(row) + encoder.data(row, value) + encoder.data(row, value)
        stream += encoder.define(name) + encoder.data(name, "a")
        yield "labcomm", dialect, b"\x07" + stream
    yield "definitions", "labcomm", LANGUAGE.encode()
    encoder = Encoder()
    from armlab.bridge.servers.labcomm.rows import RowTypes

    accepted = RowTypes(ARM.abb_axes, "abb").accepted
    fields = {one.name: [0.1] * 7 if isinstance(one.type, Array) else 1 for one in accepted.type.fields}
    stream = encoder.version() + encoder.define(accepted) + encoder.data(accepted, fields)
    yield "labcomm_client", "command", b"\0" + stream
    encoder = Encoder()
    stream = encoder.version()
    for label, kind, said in (("gain", "double", 0.7), ("note", "string", "b")):
        sample = SampleType(label, PRIMS[kind])
        stream += encoder.define(sample) + encoder.data(sample, said)
    yield "labcomm_client", "settings", b"\x01" + stream


def states(count: int) -> Iterator[State]:
    """Yield plausible robot states."""
    for k in range(count):
        q = SEVEN + 0.01 * k
        yield State(t=0.004 * k, dt=0.004, q=q, qd=np.ones(7), tau=np.full(7, 0.5), robot=ARM.name)


def logs(folder: Path) -> Seeds:
    """Recordings (complete, truncated, uncompressed), text files, bags, settings."""
    grown = log.Log(ARM)
    for k, state in enumerate(states(4)):
        grown.row(state, None, Tick(k, -1, 5 * 10**9 + 4_000_000 * k, k, -1, 0))
    whole = grown.save(folder / "a.mcap").read_bytes()
    yield "mcap", "whole", whole
    yield "mcap", "torn", whole[: 2 * len(whole) // 3]
    yield "mcap", "plain", plain(whole)
    yield "mcap", "encodings", encodings()
    table = grown.table()
    small = table.select("q", "tau")
    path = log.write(small, folder / "a.csv")
    yield "text", "ours", path.read_bytes() + b"\0\0" + path.with_name("a.csv.toml").read_bytes()
    yield "text", "plain", b"t [ms],q1 [deg],q2 [deg],word\n0,1.5,,a\n4,2e0,nan,b\n8,-3,4,c\n"
    yield "text", "tracker", b"1 1.0 2.0 3.0 0.0 90.0 0.0\n2 1.0 2.5 3.0 0.0 90.0 0.0\n# name: a\n"
    yield "text", "plane", b"1 0 0 0\n0 1 0 0\n0 0 1 250\n0 0 0 1\n"
    joints = [f"robot[0].joint[{k}].posRawAbs" for k in range(7)]
    yield "text", "orca", f"t,{','.join(joints)}\n0,1,2,3,4,5,6,7\n0.004,1,2,3,4,5,6,8\n".encode()
    about = "[columns]\na = { signal = 1717, axis = 1 }\nb = { signal = 42, axis = 2 }\n"
    about = f'time = "t"\ntime_unit = "s"\narm = "yumi_left"\nseparator = " "\n{about}'
    yield "abb", "two", b"t a b\n0 1 2\n0.004 1.5 2.5\n\0\0" + about.encode()
    yield "bag", "small", bag(folder / "a.bag")
    for name, text in {
        "toml": 'token = "a"\n[b]\nx = 1\n',
        "json": '{"token": "a", "b": {"x": [1, "password: c"]}}',
        "yaml": "token: a\nb: &x\n  - secret = 1\nc: *x\n",
        "ini": "[b]\npassword = c\nx = 1\n",
    }.items():
        yield "secrets", name, text.encode()


def plain(whole: bytes) -> bytes:
    """Return the same messages in chunks without compression or checksum, so mutations reach their content."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    out, seen = io.BytesIO(), {}
    writer = Writer(out, compression=CompressionType.NONE, enable_crcs=False, use_statistics=False)
    writer.start()
    for schema, channel, message in make_reader(io.BytesIO(whole)).iter_messages():
        if channel.id not in seen:
            number = writer.register_schema(schema.name, schema.encoding, schema.data)
            seen[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
        writer.add_message(seen[channel.id], message.log_time, message.data, message.publish_time, message.sequence)
    writer.finish()
    return out.getvalue()


def encodings() -> bytes:
    """Return messages as written by other programs in JSON, protobuf and CDR, without checksums."""
    from google.protobuf import descriptor_pb2, timestamp_pb2
    from mcap.writer import CompressionType, Writer

    types = descriptor_pb2.FileDescriptorSet()
    timestamp_pb2.DESCRIPTOR.CopyToProto(types.file.add())
    types.file[0].ClearField("options")
    text = f"In[] a\nstring n\nfloat64[2] x\n{'=' * 80}\nMSG: t/In\nbool b\nint16 c"
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.NONE, use_statistics=False, enable_crcs=False)
    writer.start()
    for name, encoding, schema, data in (
        ("lab.State", "json", "jsonschema", b"{}"),
        ("google.protobuf.Timestamp", "protobuf", "protobuf", types.SerializeToString()),
        ("t/msg/T", "cdr", "ros2msg", text.encode()),
    ):
        writer.register_channel(f"/{encoding}", encoding, writer.register_schema(name, schema, data))
    for k in range(4):
        parts = struct.pack("<Ibxh", 1, k % 2, k), struct.pack("<I3sx", 3, b"ab\0"), struct.pack("<2d", k, 1.5)
        for channel, raw in enumerate(
            (
                b'{"t": %d, "q": [1, 2.5e%d], "s": {"on": true, "x": [{"a": -%d}]}}' % (k, k, k),
                timestamp_pb2.Timestamp(seconds=k + 1, nanos=7 * k).SerializeToString(),
                b"\0\1\0\0" + b"".join(parts),
            ),
            start=1,
        ):
            writer.add_message(channel, 10**9 + k * 10**7, raw, 10**9 + k * 10**7, k)
    writer.finish()
    return out.getvalue()


def bag(path: Path) -> bytes:
    """Return a ROS 1 bag with one topic."""
    from rosbags.rosbag1 import Writer

    known = store()
    with Writer(path) as writer:
        name = "std_msgs/msg/Float64"
        connection = writer.add_connection("/x", name, typestore=known)
        for k in range(3):
            message = known.types[name](data=0.5 * k)
            writer.write(connection, 10**18 + 4_000_000 * k, bytes(known.serialize_ros1(message, name)))
    return path.read_bytes()


def described(folder: Path) -> Seeds:
    """Robots, cells, models."""
    small = robots.load("irb120")
    yield "robot_urdf", "irb120", write_urdf(small).encode()
    branch = '<link name="a"/><link name="b"/><joint name="j" type="prismatic"><parent link="a"/><child link="b"/>'
    about = '<axis xyz="0 0 1"/><limit lower="0" upper="1" velocity="1" effort="1"/><mimic joint="j"/></joint>'
    yield "robot_urdf", "mimic", f'<robot name="r">{branch}{about}</robot>'.encode()
    for name in ("irb120", "dh_test"):
        yield "robot_toml", name, (Path(robots.__file__).parent / "library" / f"{name}.toml").read_bytes()
    yield "robot_toml", "written", robots.to_toml(small).encode()
    text = '[[robots]]\nname = "irb120"\nlink = "sim://irb120?seed=1"\n'
    yield "cell", "least", text.encode()
    more = "[parameters.gain]\ndefault = 0.5\nmaximum = 1.0\n[servers.rosbridge]\nport = 0\n[servers.labcomm]\n"
    source = '[sources.force]\nperiod = 0.01\nport = 0\nfields.f = { shape = [3], unit = "N" }\n'
    yield "cell", "more", f'name = "c"\ncommands = ["rosbridge"]\n{text}{more}{source}'.encode()
    yield "cell", "address", b"zenoh://127.0.0.1:7447/lab?secret=a"
    yield from saved(folder)


def saved(folder: Path) -> Seeds:
    """Model files."""
    path = folder / "a.toml"
    for name, value in {
        "robot": robots.load("irb120"),
        "payload": models.Payload("a", "b", np.arange(10.0), np.eye(4), ("run.mcap",)),
        "hand_eye": models.HandEye("eye_to_hand", np.eye(4), np.eye(4)),
    }.items():
        yield "model", name, models.save(value, path, {"sigma": np.ones(2), "n": 5}).read_bytes()
    yield "model", "torque", models.save(torque_model(), path).read_bytes()


def torque_model() -> models.TorqueModel:
    """Return a torque model without a fit."""
    arm = robots.load("irb120")
    some = np.full(arm.n, 0.1)
    friction = Friction(*[some] * 7, np.zeros(arm.n))
    return models.TorqueModel(
        robot_name=arm.name,
        robot_hash=arm.hash,
        frames=arm.frames,
        prismatic=arm.prismatic,
        gravity=arm.gravity,
        link_parameters=np.zeros((arm.n, 10)),
        rotor=some,
        friction=friction,
        ripple=Ripple(*[np.zeros(arm.n)] * 3),
        covariance=models.velocity_covariance("const", some, some),
        bound=FrictionBound.of(friction),
        cutoff=10.0,
        base_names=("a",),
        base_values=np.ones(1),
        base_cov=np.eye(1),
        quality=Quality(some, some, some, some, 30.0),
        training=Training(-some, some, some, np.full((arm.n, 12), 1 / 12), 0.1, 0.5),
    )


def client() -> Seeds:
    """Client data."""
    said = [
        {"op": "subscribe", "topic": "/yumi_left/joint_states", "type": "sensor_msgs/JointState", "id": "1"},
        {"op": "publish", "topic": "/yumi_left/joint_group_position_controller/command", "msg": {"data": [0.0] * 7}},
        {"op": "call_service", "service": "/rosapi/set_param", "args": {"name": "gain", "value": "0.5"}},
        {"op": "call_service", "service": "/rosapi/topics", "id": 2},
    ]
    yield "rosbridge", "talk", "\n".join(json.dumps(one) for one in said).encode()
    types = store().types
    array = types["std_msgs/msg/Float64MultiArray"](
        layout=types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0), data=SEVEN
    )
    yield "ros_command", "numbers", b"\0" + bytes(store().serialize_cdr(array, "std_msgs/msg/Float64MultiArray"))
    yield "ros_command", "json", b"\0" + json.dumps([0.1] * 7).encode()
    setting = types["std_msgs/msg/String"](data='{"gain": 0.5}')
    yield "ros_command", "setting", bytes([18]) + bytes(store().serialize_cdr(setting, "std_msgs/msg/String"))
    names = Names(0, "a1b2")
    token = names.writer(1, "/yumi_left/stop", "std_msgs/msg/Empty")
    yield "zenoh", "token", token.encode() + b"\n" + Origin(1, 10**18, b"0123456789abcdef").pack()
    attached = Attachment(b"0123456789abcdef", 1, 10**18).pack()
    numbers = struct.pack("<7d", *SEVEN)
    yield "zenoh", "position", bytes([8]) + b"position" + bytes([len(attached)]) + attached + numbers
    yield "zenoh", "setting", bytes([4]) + b"gain" + bytes([0]) + b"0.5"
    schema = RowSchema.of([ARM, robots.load("yumi_right")])
    state = replace(next(states(1)), t=1.5)
    yield "request", "row", RowWriter(schema).row(state, None, Tick(0, -1, 5 * 10**9, 0, -1, 0), 10**12)
    yield "request", "command", json.dumps({"kind": "command", "arm": "yumi_left", "q": [0.1] * 7}).encode()
    yield "request", "schema", RowSchema.of([robots.load("irb120")]).text[:16000]
    yield "request", "datagram", b'{"force": [1, 2.5, null], "on": true, "seq": 3, "stamp_ns": 4}'


def message() -> Seeds:
    """Message type definitions with messages."""
    text = "int32 a\nstring b\nfloat64[] c\nfloat32[2] d\nS[] e\n" + "=" * 80 + "\nMSG: a/S\nbool x\n"
    body = struct.pack("<i", 7) + struct.pack("<I", 2) + b"b\0\0\0" + struct.pack("<II2d", 2, 0, 1.0, 2.0)
    yield "definitions", "msg", text.encode() + b"\0\0" + b"\0\1\0\0" + body + struct.pack("<2fI", 1, 2, 1) + b"\1"
    idl = "module a { module msg { struct B { int32 a; sequence<double> c; string b; }; }; };"
    yield "definitions", "idl", idl.encode() + b"\0\0" + b"\0\1\0\0" + struct.pack("<iIdI", 7, 1, 1.0, 1) + b"\0"


def main() -> None:
    """Write all seeds."""
    parse_lc(LANGUAGE, "2014i")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seeds in (egm(), labcomm(), logs(folder), described(folder), client(), message(), fleet.seeds()):
            for target, label, data in seeds:
                path = ROOT / "fuzz" / "corpus" / target / label
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)


if __name__ == "__main__":
    main()
