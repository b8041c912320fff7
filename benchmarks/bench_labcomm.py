"""LabComm: encode and decode of a robot's row, and what clients of a server cost the one who publishes."""

from __future__ import annotations

import struct
import time
from typing import Any

import numpy as np
from blocks import Contender, Table, agree, each, loop, table

from armlab.bridge.labcomm import ArmChannel, LabCommClient, LabCommServer, Row
from armlab.wire.labcomm import Decoder, Encoder, Sample, idl

ROWS = 500
BAR = 3e-6  # seconds, encode or decode of a row
STREAM_BAR = 10e-6  # seconds per row that comes in pieces of 64


def run(quick: bool) -> list[Table]:
    """Measure the codec against a bare `struct`, and publishing without clients, with idle ones, with a deaf one."""
    return [_codec(20 if quick else 100), _publishing(10 if quick else 50)]


def _codec(rounds: int) -> Table:
    sample = idl.samples("armlab")["robot_row"]
    rng = np.random.default_rng(4)
    values = [
        {"tm": 4 * k, **{name: rng.standard_normal(7).tolist() for name in ("pos", "vel", "trq")}} for k in range(ROWS)
    ]
    arrays = [{name: v if name == "tm" else np.array(v) for name, v in value.items()} for value in values]
    encoder, bare = Encoder(), struct.Struct(">i21d")
    head = encoder.version() + encoder.define(sample)
    packets = [encoder.data(sample, value) for value in values]
    pieces = [b"".join(packets[k : k + 64]) for k in range(0, 448, 64)]
    decoder = Decoder()
    decoder.feed(head)
    (event,) = decoder.feed(packets[0])
    worst = agree("row", event.value["pos"] if isinstance(event, Sample) else [], values[0]["pos"])

    def pack(value: dict[str, Any]) -> bytes:
        return bare.pack(value["tm"], *value["pos"], *value["vel"], *value["trq"])

    def unpack(packet: bytes) -> dict[str, Any]:
        flat = bare.unpack_from(packet, 3)
        return {"tm": flat[0], "pos": list(flat[1:8]), "vel": list(flat[8:15]), "trq": list(flat[15:22])}

    contenders = [
        Contender("armlab encode", loop(lambda value: encoder.data(sample, value), values), "armlab", BAR),
        Contender("armlab encode, NumPy arrays", loop(lambda value: encoder.data(sample, value), arrays), "armlab"),
        Contender("armlab decode", loop(decoder.feed, packets), "armlab", BAR, "one packet per call"),
        Contender(
            "armlab decode, per row",
            lambda: loop(decoder.feed, pieces)() / 64.0,
            "armlab",
            STREAM_BAR,
            "64 packets per call",
        ),
        Contender("struct alone, encode", loop(pack, values), "limit", note="one call for the 22 numbers"),
        Contender("struct alone, decode", loop(unpack, packets), "limit", note="to a dict with three lists"),
    ]
    text = (
        f"A robot_row of 7 joints, {len(packets[0])} bytes with its head, from and to a dict with three lists. The "
        f"values agree to {worst:.1g}. No other LabComm library for Python 3 is on PyPI."
    )
    return table("LabComm, one row", text, "µs", contenders, rounds)


def _publishing(rounds: int) -> Table:
    """250 Hz for a fifth of a second per block: what `LabCommServer.row` takes of the loop that calls it."""
    servers = [LabCommServer([ArmChannel("left", 0)]) for _ in range(3)]
    ports = [server.ports["left"] for server in servers]
    idle = [LabCommClient(port=ports[1]) for _ in range(8)]
    deaf = LabCommClient(port=ports[2])
    for _ in range(3000):  # fills what the system keeps for the client that never reads
        servers[2].row("left", Row(0, np.zeros(7)))
        time.sleep(2e-4)
    rows = [Row(4 * k, np.zeros(7), np.zeros(7), np.zeros(7)) for k in range(50)]

    def publish(index: int) -> Any:
        def drain() -> None:
            for client in idle if index == 1 else ():
                client.events(0.0)

        return each(lambda row: servers[index].row("left", row), rows, drain, period=4e-3)

    contenders = [
        Contender("armlab row, no client", publish(0), "armlab"),
        Contender("armlab row, eight clients", publish(1), "armlab"),
        Contender("armlab row, a client that never reads", publish(2), "armlab"),
    ]
    text = (
        "`LabCommServer.row` as the control loop calls it, 250 times a second: the row is queued and the server's "
        "thread is woken. The rest is that thread's own time, in a process of its own when `armlab bridge` starts it."
    )
    try:
        return table("LabComm server, one row published", text, "µs", contenders, rounds)
    finally:
        for one in (*idle, deaf, *servers):
            one.close()
