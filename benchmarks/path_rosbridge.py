"""rosbridge with `websockets` alone: `path_rosbridge.py read PORT COUNT` or `path_rosbridge.py write PORT`.

The writer sends joint states and wrenches to every client, regardless of its requests.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import time
from typing import Any

import msgspec
from path_ends import JOINTS, PERIOD, ROBOT, Lines, numbers, say, tell
from websockets.asyncio.client import connect
from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed

TOPICS = {
    f"/{ROBOT}/joint_states": ("J", "sensor_msgs/msg/JointState"),
    f"/{ROBOT}/wrench": ("W", "geometry_msgs/msg/WrenchStamped"),
}
NAMES = [f"yumi_robl_joint_{k}" for k in range(1, JOINTS + 1)]


def stamp(message: Any) -> int:
    """Return the stamp [ns] of a message."""
    found = message["header"]["stamp"]
    return found["sec"] * 10**9 + found["nanosec"]


async def read(port: int, lines: Lines) -> None:
    """Receive messages until there are enough."""
    async with connect(f"ws://127.0.0.1:{port}", compression=None) as socket:
        for topic, (_, type_) in TOPICS.items():
            await socket.send(json.dumps({"op": "subscribe", "topic": topic, "type": type_}))
        ending = asyncio.create_task(_end(socket, lines))
        async for text in socket:
            said = json.loads(text)
            if said["op"] == "publish":
                lines.add(TOPICS[said["topic"]][0], stamp(said["msg"]))
        await ending


async def _end(socket: Any, lines: Lines) -> None:
    while not lines.over.is_set():
        await asyncio.sleep(0.1)
    await socket.close()


async def write(port: int) -> None:
    """Send until standard input is closed."""
    stamps: list[int] = []

    async def send(socket: Any) -> None:
        due = time.monotonic()
        with contextlib.suppress(ConnectionClosed):
            while True:
                stamps.append(time.time_ns())
                for topic, message in zip(TOPICS, _messages(stamps[-1]), strict=True):
                    said = {"op": "publish", "topic": topic, "msg": message}
                    await socket.send(msgspec.json.encode(said).decode())
                due += PERIOD
                await asyncio.sleep(max(0.0, due - time.monotonic()))

    async with serve(send, "127.0.0.1", port, compression=None):
        say("ready")
        await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    tell(stamps)


def _messages(stamp_ns: int) -> tuple[Any, Any]:
    sec, nanosec = divmod(stamp_ns, 10**9)
    when = {"sec": sec, "nanosec": nanosec}
    q, qd, tau = numbers(stamp_ns)
    joints = {"header": {"stamp": when, "frame_id": ""}, "name": NAMES, "position": q, "velocity": qd, "effort": tau}
    force, torque = ({"x": x, "y": x, "z": x} for x in (1.0, 2.0))
    return joints, {"header": {"stamp": when, "frame_id": "tool"}, "wrench": {"force": force, "torque": torque}}


def main() -> None:
    role, port, *count = sys.argv[1:]
    if role == "write":
        asyncio.run(write(int(port)))
        return
    lines = Lines(int(count[0]))
    with contextlib.suppress(ConnectionClosed):
        asyncio.run(read(int(port), lines))
    lines.tell()


if __name__ == "__main__":
    main()
