"""Who wrote a message, by the tokens of the graph."""

from __future__ import annotations

import pytest

from armlab.bridge.servers.ros.rmw_zenoh import Names, Origin, Writer

pytest.importorskip("xxhash", reason="the extra net is not installed")

from armlab.bridge.servers.ros.rmw_zenoh import Nodes

TEXT = "std_msgs/msg/String"


def origin(token: str) -> Origin:
    return Origin(1, 0, Writer(token).id)


def test_writers_of_a_node_are_one_client_which_leaves_with_the_last() -> None:
    left: list[str] = []
    nodes = Nodes(left.append)
    names = Names(0, "0123456789abcdef", node="theirs")
    tokens = [names.writer(k, f"/topic_{k}", TEXT) for k in (1, 2)]
    assert nodes.client(origin(tokens[0])) == origin(tokens[0]).client, "nothing is known yet"
    for token in tokens:
        nodes.token(token, is_there=True)
    assert {nodes.client(origin(token)) for token in tokens} == {"/theirs@0123456789abcdef"}
    nodes.token(tokens[0], is_there=False)
    assert left == []
    nodes.token(tokens[1], is_there=False)
    nodes.token(tokens[1], is_there=False)
    assert left == ["/theirs@0123456789abcdef"]
    assert nodes.client(origin(tokens[0])) == origin(tokens[0]).client


def test_a_namespace_is_part_of_the_name_and_what_is_no_token_is_none() -> None:
    nodes = Nodes(lambda client: None)
    token = f"@ros2_lv/0/ab/0/3/MP/%/%lab%left/node/%topic/{TEXT}/hash/::,10:,:,:,,"
    nodes.token(token, is_there=True)
    nodes.token("@ros2_lv/0/ab/0/4/MP", is_there=True)
    assert nodes.client(origin(token)) == "/lab/left/node@ab"


def test_a_flood_of_writers_is_not_kept() -> None:
    nodes = Nodes(lambda client: None)
    names = Names(0, "ab")
    for k in range(5000):
        nodes.token(names.writer(k, "/topic", TEXT), is_there=True)
    assert len(nodes._clients) == 4096
