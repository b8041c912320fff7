"""docs/ros.md says what is so: every topic with its type, and as checked what the tests with peers check."""

from __future__ import annotations

import json
import re
import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest

from armlab import robots
from armlab.bridge.servers.ros.requests import Commands
from armlab.bridge.servers.ros.topics import Topics
from armlab.bridge.servers.row import RowSchema

from .test_containers import JOB, ROOT
from .test_dds_with_peers import PEERS
from .test_rmw_zenoh_with_peers import RELEASES, SDK

PAGE = (ROOT / "docs" / "ros.md").read_text(encoding="utf-8")
RUNS = json.loads(JOB.RESULTS.read_text(encoding="utf-8")) if JOB.RESULTS.exists() else []
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
    real = JOB.clause(RUNS) if RUNS else "Not yet checked against a running ROS 2 node"
    assert re.findall(r"\*\*([^*]+)\*\*", section) == [*PEERS, real]
    zenoh = PAGE.partition("## ROS 2 over Zenoh")[2].partition("\n## ")[0]
    assert re.findall(r"\*\*([^*]+)\*\*", zenoh) == [*RELEASES, f"zenoh-ros2-sdk {SDK}"]


@pytest.mark.parametrize("page", JOB.PAGES, ids=lambda page: page.name)
def test_the_readme_and_the_parity_table_claim_what_the_tests_check(page: Path) -> None:
    """Real ROS 2, which is not run here, as .ci/ros2.py left it in its file."""
    text = page.read_text(encoding="utf-8")
    cyclone, fast = _claimed()
    first, last = min(RELEASES, key=_number), version("eclipse-zenoh").rpartition(".")[0]
    assert (
        f"ROS 2: wire-compatible, checked against {fast}, {cyclone} and Zenoh {first} to {last}; {JOB.clause(RUNS)}. "
        "ROS 1: checked with a real roscore, rospy and roslibpy."
    ) in text
    assert JOB.stated(text, RUNS) == text


@pytest.mark.parametrize(("place", "package"), [(0, "cyclonedds-dev"), (1, "libfastrtps-dev")])
def test_the_peers_that_are_built_have_the_versions_that_are_claimed(place: int, package: str) -> None:
    system = Path("/etc/os-release")
    if not system.is_file() or not re.search(r'^VERSION="12 \(bookworm\)"$', system.read_text(), flags=re.M):
        pytest.skip("the versions are those of Debian 12, which this is not")
    command = ["dpkg-query", "-W", "-f", "${Version}", package]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    if found.returncode:
        pytest.skip(f"{package} is not installed")
    assert re.match(r"[\d.]+", found.stdout)[0] == _claimed()[place].split()[-1]  # type: ignore[index]


def _claimed() -> list[str]:
    """Names and versions of the peers that are built."""
    found = [re.match(r"(.+ [\d.]+), C", name) for name in PEERS]
    return sorted(one[1] for one in found if one)


def _number(release: str) -> list[int]:
    return [int(part) for part in release.split(".")]
