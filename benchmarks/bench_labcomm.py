"""LabComm: encoding and decoding of a robot row, and the load that a server's clients put on the publisher."""

from __future__ import annotations

import struct
import time
from contextlib import ExitStack
from typing import Any

import numpy as np
from blocks import Contender, Table, agree, each, loop, table

from armlab import robots
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.labcomm import LabCommClient
from armlab.bridge.servers.labcomm.process import labcomm_options
from armlab.bridge.servers.supervisor import Servers, server_command
from armlab.log import Tick
from armlab.state import State
from armlab.wire.labcomm import Decoder, Encoder, Sample, idl

ROWS = 500
BAR = 4.0  # relative to `struct` alone
PACK, UNPACK = "struct alone, encode", "struct alone, decode"


def run(quick: bool) -> list[Table]:
    """Compare the codec with a bare `struct`; measure publishing without clients and with a stalled client."""
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
        Contender("armlab encode", loop(lambda value: encoder.data(sample, value), values), "armlab", BAR, "", PACK),
        Contender("armlab encode, NumPy arrays", loop(lambda value: encoder.data(sample, value), arrays), "armlab"),
        Contender("armlab decode", loop(decoder.feed, packets), "armlab", BAR, "one packet per call", UNPACK),
        Contender(
            "armlab decode, per row",
            lambda: loop(decoder.feed, pieces)() / 64.0,
            "armlab",
            BAR,
            "64 packets per call",
            UNPACK,
        ),
        Contender(PACK, loop(pack, values), "limit", note="one call for the 22 numbers"),
        Contender(UNPACK, loop(unpack, packets), "limit", note="to a dict with three lists"),
    ]
    text = (
        f"A robot_row of 7 joints, {len(packets[0])} bytes with its header, converted from and to a dict with three "
        f"lists. The values agree to {worst:.1g}. No other LabComm library for Python 3 is on PyPI."
    )
    return table("LabComm, one row", text, "µs", contenders, rounds)


def _publishing(rounds: int) -> Table:
    """Measure the cost of a row to the loop at 250 Hz in blocks of 0.2 s, with the server in a separate process."""
    robot = robots.load("yumi_right")
    q = np.array(robot.q_home)
    state = State(t=1.0, dt=0.004, q=q, qd=np.zeros(7), tau=np.zeros(7), robot=robot.name)
    tick = Tick(0, 0, 10**18, 10**18, 10**18, 0)
    with ExitStack() as stack:
        exchanges, clients = [], []
        for count in (0, 10):
            exchange = Hub([robot], ["labcomm"])
            options = labcomm_options([robot], ports=[0], parameters=0, fused=0)
            servers = stack.enter_context(Servers(exchange, {"labcomm": server_command("labcomm", options)}))
            ports = [int(where.partition(" ")[0].rpartition(":")[2]) for where in servers.ready()]
            exchanges.append(exchange)
            if count:
                idle = [LabCommClient(port=ports[k % 2]) for k in range(count)]
                deaf = LabCommClient(port=ports[0])
                clients = [stack.enter_context(client) for client in (*idle, deaf)][:-1]
        for _ in range(3000):  # fill the operating system's buffers for the client that never reads
            exchanges[1].row(state, None, tick)
            time.sleep(5e-4)

        def publish(index: int) -> Any:
            def drain() -> None:
                for client in clients if index else ():
                    client.events(0.0)

            return each(lambda _: exchanges[index].row(state, None, tick), range(50), drain, period=4e-3)

        contenders = [
            Contender("armlab row, no client", publish(0), "armlab"),
            Contender("armlab row, ten idle clients and one that never reads", publish(1), "armlab"),
        ]
        text = (
            "Time of `Hub.row`, which the loop calls after each reply, 250 times per second, with `LabCommProcess` at "
            "the other end. `Hub.row` passes the row to that process, so clients do not take time from the loop."
        )
        return table("LabComm server, one row published", text, "µs", contenders, rounds)
