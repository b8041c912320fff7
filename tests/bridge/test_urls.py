"""Urls of a link."""

from __future__ import annotations

import pytest

from armlab.bridge.urls import Address, addresses, simulator_options, split_url
from armlab.errors import ConfigError


@pytest.mark.parametrize("port", ["65536", "0000001000000", "0" * 30 + "70000", "1" * 5000, "٦٥١٠", "-1", "x"])
def test_ports_that_are_none(port: str) -> None:
    with pytest.raises(ConfigError, match="a port from 0 to 65535"):
        addresses([f"egm://127.0.0.1:{port}"], 1)
    assert addresses([f"egm://127.0.0.1:{'0' * 5000}6510"], 1)[0].port == 6510


def test_default_ports() -> None:
    assert addresses(["egm://10.0.0.1"], 1) == [Address("egm", "10.0.0.1", 6510, "", {})]
    assert [one.port for one in addresses(["egm://127.0.0.1", "egm://127.0.0.1"], 2)] == [6511, 6512]


def test_labcomm() -> None:
    assert addresses(["labcomm://lab?order=chain"], 1) == [Address("labcomm", "lab", 7511, "", {"order": "chain"})]
    assert [one.port for one in addresses(["labcomm://lab", "labcomm://lab"], 2)] == [7511, 7512]
    assert addresses(["labcomm://lab:99"], 1)[0].port == 99
    with pytest.raises(ConfigError, match="labcomm://HOST:PORT"):
        addresses(["labcomm://lab:x"], 1)


def test_simulated() -> None:
    both = addresses(["sim://yumi_left+yumi_right?seed=3"], 2)
    assert [one.robot for one in both] == ["yumi_left", "yumi_right"]
    assert both[0].options == both[1].options == {"seed": "3"}
    assert addresses(["sim://a?seed=3", "sim://b?seed=3"], 2)[1].robot == "b"
    files = addresses(["sim://mine/a.toml+/lab/b%3f%20c.toml?seed=3"], 2)
    assert [(one.robot, one.options) for one in files] == [
        ("mine/a.toml", {"seed": "3"}),
        ("/lab/b? c.toml", {"seed": "3"}),
    ]
    assert addresses(["sim:///lab/b.toml"], 1)[0].robot == "/lab/b.toml"
    with pytest.raises(ConfigError, match="Expected a link"):
        addresses(["sim://"], 1)


def test_only_seeds_of_simulated_robots_may_differ() -> None:
    def options(*urls: str) -> dict[str, str]:
        return simulator_options(addresses(urls, len(urls)))

    assert options("sim://a?seed=3&loss=0.1", "sim://b?loss=0.1&seed=4") == {"seed": "3,4", "loss": "0.1"}
    assert options("sim://a", "sim://b?seed=4", "sim://c") == {"seed": "0,4,0"}
    assert options("sim://a?seed=4", "sim://b?seed=4") == {"seed": "4"}
    for urls in (["sim://a?loss=0.1", "sim://b"], ["labcomm://a?seed=1", "labcomm://b?seed=2"]):
        with pytest.raises(ConfigError, match="Only seeds of simulated robots may differ"):
            addresses(urls, 2)


def test_a_number_of_robots_that_is_not_that_of_the_urls() -> None:
    with pytest.raises(ConfigError, match="one url per robot, got 2 for 1"):
        addresses(["sim://a+b"], 1)
    with pytest.raises(ConfigError, match="got None"):
        addresses([None], 1)  # type: ignore[list-item]


def test_half_a_bracket_is_no_address() -> None:
    assert split_url("egm://[::1]:6510/a").port == 6510
    for url in ("egm://[::1", "sim://a]"):
        with pytest.raises(ConfigError, match="Expected a url like egm"):
            split_url(url)
        with pytest.raises(ConfigError, match="Expected a url like egm"):
            addresses([url], 1)
