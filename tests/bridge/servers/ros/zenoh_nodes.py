"""ROS 2 server with rmw_zenoh in a thread, and sessions that act as ROS nodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("zenoh", reason="the extra net is not installed")
pytest.importorskip("xxhash", reason="the extra net is not installed")

from armlab import robots
from armlab.bridge.inputs.parameters import Parameter
from armlab.bridge.servers.ros.rmw_zenoh import Names, Origin, RmwZenohServer, Writer
from armlab.bridge.servers.ros.topics import store
from armlab.bridge.servers.zenoh.session import LabAddress, close_session

from ....processes import free_port
from ..conftest import Served, until
from .conftest import OTHERS


class ZenohNode:
    def __init__(self, port: int, name: str = "theirs") -> None:
        self.session = LabAddress("127.0.0.1", port).open()
        self.names = Names(0, str(self.session.zid()), node=name)
        self.client = f"/{name}@{self.session.zid()!s}"
        self.writers = 0

    def samples(self, topic: str, type_: str) -> list[Any]:
        found: list[Any] = []
        self.session.declare_subscriber(self.names.data(topic, type_), found.append)
        return found

    def read(self, topic: str, type_: str) -> Callable[[], list[Any]]:
        found = self.samples(topic, type_)
        return lambda: [store().deserialize_cdr(one.payload.to_bytes(), type_) for one in list(found)]

    def read_late(self, topic: str, type_: str) -> Callable[[], list[Any]]:
        from zenoh import ext

        found: list[Any] = []
        self._late = ext.declare_advanced_subscriber(
            self.session,
            self.names.data(topic, type_),
            found.append,
            history=ext.HistoryConfig(detect_late_publishers=True),
        )
        return lambda: [store().deserialize_cdr(one.payload.to_bytes(), type_) for one in list(found)]

    def call(self, name: str, type_: str, request: Any) -> Any:
        import zenoh

        raw, origin = bytes(store().serialize_cdr(request, f"{type_}_Request")), Origin(7, 1, b"c" * 16)
        key = self.names.data(name, type_)
        target = zenoh.QueryTarget.ALL_COMPLETE
        found: list[Any] = []
        until(
            lambda: (
                found.extend(
                    reply.ok
                    for reply in self.session.get(
                        key, payload=raw, attachment=origin.pack(), target=target, timeout=5.0
                    )
                    if reply.ok is not None
                )
                or found
            )
        )
        told = Origin.read(found[0].attachment.to_bytes())
        assert told is not None
        assert (told.seq, told.writer, str(found[0].key_expr)) == (origin.seq, origin.writer, key)
        return store().deserialize_cdr(found[0].payload.to_bytes(), f"{type_}_Response")

    def writer(self, topic: str, type_: str) -> ZenohWriter:
        self.writers += 1
        return ZenohWriter(self, self.names.writer(self.writers, topic, type_), self.names.data(topic, type_))

    def close(self) -> None:
        close_session(self.session)


class ZenohWriter:
    def __init__(self, node: ZenohNode, token: str, key: str) -> None:
        self._session, self._key, self._id, self._sent = node.session, key, Writer(token).id, 0
        self._life = node.session.liveliness().declare_token(token)

    def write(self, raw: bytes) -> None:
        self._sent += 1
        self._session.put(self._key, raw, attachment=Origin(self._sent, 0, self._id).pack())

    def leave(self) -> None:
        self._life.undeclare()


class ZenohCell(Served):
    def __init__(self, rights: Any = "anyone") -> None:
        gain, self.port = Parameter("gain", 0.5, minimum=0.0, maximum=1.0, rights=rights), free_port()
        options = {
            "domain": 0,
            "host": "127.0.0.1",
            "port": self.port,
            "router": "",
            "distribution": "jazzy",
            "tf": True,
        }
        arm = robots.load("yumi_left")
        super().__init__("rmw_zenoh", arm, lambda feed: RmwZenohServer(feed, options), [gain, *OTHERS])
        self.nodes: list[ZenohNode] = []
        self.node = self.join()

    def join(self, name: str = "theirs") -> ZenohNode:
        self.nodes.append(ZenohNode(self.port, name))
        return self.nodes[-1]

    def close(self) -> None:
        for one in self.nodes:
            one.close()
        super().close()
