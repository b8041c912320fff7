"""Where the servers of a cell listen, and what is refused."""

from __future__ import annotations

import pytest

from armlab.bridge.cell import parse_cell
from armlab.bridge.listen import is_open, listening
from armlab.bridge.net.sockets import is_here
from armlab.errors import ConfigError, UnknownName

FILE = """
commands = ["local"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[servers.labcomm]
"""


def test_listening() -> None:
    cell = parse_cell(FILE)
    assert listening([], cell) == {"labcomm": "127.0.0.1"}
    assert listening(["labcomm=0.0.0.0"], cell) == {"labcomm": "0.0.0.0"}
    assert listening(["labcomm=lo"], cell) == {"labcomm": "127.0.0.1"}
    with pytest.raises(UnknownName, match="enabled server"):
        listening(["ros=0.0.0.0"], cell)
    with pytest.raises(ConfigError, match="IPv4 address or one of the interfaces"):
        listening(["labcomm=nowhere"], cell)
    commanding = parse_cell(FILE.replace('["local"]', '["labcomm"]'))
    assert listening(["labcomm=127.0.0.2"], commanding) == {"labcomm": "127.0.0.2"}
    with pytest.raises(ConfigError, match="no place for a secret and no encryption"):
        listening(["labcomm=0.0.0.0"], commanding)


def test_who_commands_from_elsewhere_has_to_know_a_secret() -> None:
    text = FILE.replace("labcomm", "rosbridge").replace('["local"]', '["rosbridge"]')
    with pytest.raises(ConfigError, match="asks for no secret, or does not encrypt"):
        listening(["rosbridge=0.0.0.0"], parse_cell(text))
    with pytest.raises(ConfigError, match="asks for no secret, or does not encrypt"):
        listening(["rosbridge=0.0.0.0"], parse_cell(text + 'token_file = "token"\ncertificate = "c.pem"'))
    cell = parse_cell(text + 'token_file = "token"\ncertificate = "c.pem"\nkey = "k.pem"')
    assert listening(["rosbridge=0.0.0.0"], cell) == {"rosbridge": "0.0.0.0"}


@pytest.mark.parametrize(("commanding", "opened"), [("zenoh", "rmw_zenoh"), ("rmw_zenoh", "zenoh")])
def test_no_commands_come_through_the_open_router_of_the_other_server(commanding: str, opened: str) -> None:
    text = FILE.replace("labcomm", opened).replace('["local"]', f'["{commanding}"]')
    with pytest.raises(ConfigError, match=f"shares the router at port 7447 with {commanding}"):
        listening([f"{opened}=0.0.0.0"], parse_cell(f"{text}\n[servers.{commanding}]"))
    through = parse_cell(f'{text}\nport = 7448\n[servers.{commanding}]\nrouter = "127.0.0.1:7448"')
    with pytest.raises(ConfigError, match="shares the router at port 7448"):
        listening([f"{opened}=0.0.0.0"], through)
    apart = parse_cell(f"{text}\n[servers.{commanding}]\nport = 7448")
    assert listening([f"{opened}=0.0.0.0"], apart) == {opened: "0.0.0.0", commanding: "127.0.0.1"}
    together = parse_cell(f"{text}\n[servers.{commanding}]")
    assert set(listening([], together).values()) == {"127.0.0.1"}


def test_two_servers_with_one_router_are_at_the_same_address() -> None:
    text = FILE.replace("labcomm", "zenoh") + "{}\n[servers.rmw_zenoh]\n"
    everywhere = ["zenoh=0.0.0.0", "rmw_zenoh=0.0.0.0"]
    with pytest.raises(ConfigError, match="zenoh and rmw_zenoh at the same address"):
        listening(everywhere[:1], parse_cell(text.format("")))
    assert set(listening(everywhere, parse_cell(text.format(""))).values()) == {"0.0.0.0"}
    assert listening(everywhere[:1], parse_cell(text.format("port = 7448"))) == {
        "zenoh": "0.0.0.0",
        "rmw_zenoh": "127.0.0.1",
    }


@pytest.mark.parametrize("master", ["http://192.168.1.9:11311", "http://127.lab.example:11311", "http://[", "nothing"])
def test_no_commands_come_from_the_network_of_a_master_elsewhere(master: str) -> None:
    text = FILE.replace("labcomm", "ros1") + f'master = "{master}"'
    assert listening([], parse_cell(text)) == {"ros1": "127.0.0.1"}
    with pytest.raises(ConfigError, match="master of ROS 1 on this computer"):
        listening([], parse_cell(text.replace('["local"]', '["ros1"]')))


@pytest.mark.parametrize("master", ["http://127.0.0.1:11311", "http://localhost:11399"])
def test_commands_come_by_a_master_of_this_computer(master: str) -> None:
    text = FILE.replace("labcomm", "ros1").replace('["local"]', '["ros1"]')
    assert listening([], parse_cell(f'{text}master = "{master}"')) == {"ros1": "127.0.0.1"}


@pytest.mark.parametrize("server", ["zenoh", "rmw_zenoh"])
def test_rows_go_to_a_router_elsewhere_only_when_that_is_asked_for(server: str) -> None:
    text = FILE.replace("labcomm", server)
    cell = parse_cell(f'{text}router = "192.168.1.9:7447"')
    with pytest.raises(ConfigError, match=f"Expected --listen {server}=ADDRESS too"):
        listening([], cell)
    assert listening([f"{server}=192.168.1.5"], cell) == {server: "192.168.1.5"}
    assert listening([], parse_cell(f'{text}router = "127.0.0.1:7448"')) == {server: "127.0.0.1"}


@pytest.mark.parametrize("place", ["127.0.0.1:1", "[::1]:1", "localhost:1"])
def test_routers_of_this_computer(place: str) -> None:
    assert is_here(place)


@pytest.mark.parametrize("place", ["192.168.1.9:7447", "127.lab.example:7447", "0.0.0.0:7447", "7447", ""])
def test_routers_elsewhere(place: str) -> None:
    assert not is_here(place)


def test_addresses_that_are_no_place_to_listen_at() -> None:
    for place in ("224.0.0.1", "239.255.0.1", "255.255.255.255"):
        with pytest.raises(ConfigError, match="Expected the address of a network card"):
            listening([f"labcomm={place}"], parse_cell(FILE))
    ros = parse_cell(FILE.replace("labcomm", "ros1"))
    with pytest.raises(ConfigError, match="address by which other nodes reach ros1"):
        listening(["ros1=0.0.0.0"], ros)
    assert listening(["ros1=127.0.0.2"], ros) == {"ros1": "127.0.0.2"}


def test_who_proves_nothing_only_reads() -> None:
    assert not is_open({}, "127.0.0.1")
    assert is_open({}, "192.168.1.5")
    assert is_open({"guarded": False}, "0.0.0.0")
    assert not is_open({"guarded": True}, "0.0.0.0")
