"""docs/ros.md says what is so: every topic with its type, and as checked what the tests with peers check."""

from __future__ import annotations

import re
from importlib.metadata import version
from pathlib import Path

from armlab import robots
from armlab.bridge.ros import Commands, Topics
from armlab.bridge.row_schema import RowSchema

from .test_dds_with_peers import PEERS
from .test_rmw_zenoh_with_peers import RELEASES

PAGE = (Path(__file__).parents[3] / "docs" / "ros.md").read_text(encoding="utf-8")
ARM = robots.load("yumi_left")


def test_every_topic_stands_on_the_page_with_its_type() -> None:
    rows = re.findall(r"^\| `([\w/]+)`(, `…/(\w+)`)? \| `([\w/]+)` \|", PAGE, flags=re.M)
    told = {name: type_ for name, _, _, type_ in rows}
    told |= {f"{name.rpartition('/')[0]}/{also}": type_ for name, _, also, type_ in rows if also}
    topics = {name: one.type for name, one in Topics({ARM.name: ARM}, RowSchema.of([ARM])).published.items()}
    topics |= Commands("cell", {ARM.name: ARM}).types
    assert {f"/yumi_left/{name}": type_ for name, type_ in told.items()} == topics


def test_what_is_said_to_be_checked_is_what_the_tests_check() -> None:
    section = PAGE.partition("## What was checked")[2].partition("\n## ")[0]
    claimed = re.findall(r"\*\*([^*]+)\*\*", section)
    assert claimed == [*PEERS, "Not yet checked against a running ROS 2 node"]


def test_the_readme_claims_what_the_tests_check() -> None:
    readme = (Path(__file__).parents[3] / "README.md").read_text(encoding="utf-8")
    dds = [re.match(r"(.+ [\d.]+), C", name) for name in PEERS]
    versions = sorted(one[1] for one in dds if one)
    first, last = min(RELEASES, key=_number), version("eclipse-zenoh").rpartition(".")[0]
    assert versions == ["Cyclone DDS 0.10", "Fast DDS 2.9"]
    assert f"{versions[1]}, {versions[0]} and Zenoh {first} to {last}; not yet against a running ROS 2 node" in readme
    assert "a real roscore, rospy and roslibpy" in readme


def _number(release: str) -> list[int]:
    return [int(part) for part in release.split(".")]
