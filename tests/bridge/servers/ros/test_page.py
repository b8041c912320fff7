"""Agreement of docs/ros.md with the tests, and the job that checks real ROS 2, without its containers."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import pytest

from armlab import robots
from armlab.bridge.cell import parse_cell
from armlab.bridge.servers.ros.actions import CONTROLLER, TRAJECTORY
from armlab.bridge.servers.ros.server import Commands
from armlab.bridge.servers.ros.topics import Topics
from armlab.bridge.servers.row import RowSchema

from .test_peers import PEERS, RELEASES, SDK

ROOT = Path(__file__).parents[4]
SCRIPT, CHECKS = ROOT / ".ci" / "ros2.py", ROOT / ".ci" / "ros2_checks.sh"


def _loaded() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ci_ros2", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


JOB = _loaded()
HZ = "average rate: 247.013\n\tmin: 0.003s max: 0.006s std dev: 0.00031s window: 249\n"

INFO = """Type: sensor_msgs/msg/JointState

Publisher count: 1

Node name: yumi_left
Node namespace: /
Topic type: sensor_msgs/msg/JointState
Topic type hash: RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e
Endpoint type: PUBLISHER
QoS profile:
  Reliability: RELIABLE
  History (Depth): KEEP_LAST (10)
  Durability: VOLATILE

Subscription count: 0
"""


def echoed(angle: float) -> str:
    names = "".join(f"- yumi_robl_joint_{k}\n" for k in range(1, 8))
    q = "".join(f"- {value}\n" for value in (0.0, -2.2, 1e-05, 0.5, 0.0, 0.7, angle))
    head = "header:\n  stamp:\n    sec: 1795371167\n    nanosec: 174991857\n  frame_id: ''\n"
    return f"{head}name:\n{names}position:\n{q}velocity: []\neffort: []\n---\n"


SAID = {
    "echo": echoed(0.0),
    "hz": "average rate: 12.000\n\tmin: 0.1s\n" + HZ,
    "info": INFO,
    "parameters": "data: '{\"gain\": 3.0}'\n---\n",
    "moved": echoed(0.3),
    "stopped": echoed(0.31),
    "held": echoed(0.3101),
}

OUTPUT = "".join(f"== {name}\n{text}" for name, text in {**SAID, "pub": "publisher: beginning loop\n"}.items())
GOOD = dict.fromkeys(("echo", "hz", "info -v", "parameter", "command", "stop"), "")


@pytest.mark.parametrize(
    ("part", "text", "check", "words"),
    [
        ("echo", "Could not determine the type for the passed topic\n", "echo", "no joint states"),
        ("hz", HZ.replace("247", "31"), "hz", "31.013 Hz"),
        ("info", INFO.replace("RIHS01_a13e", "RIHS01_b13e"), "info -v", "RIHS01_a13e"),
        ("parameters", "data: '{\"gain\": 2.0}'\n", "parameter", "2.0"),
        ("moved", echoed(0.01), "command", "turned by 0.0100 rad"),
        ("held", echoed(0.5), "stop", "turned 0.1900"),
    ],
)
def test_what_does_not_hold_is_told(part: str, text: str, check: str, words: str) -> None:
    found = JOB.judge({**SAID, part: text}, "jazzy", "rmw_zenoh_cpp")
    assert words in found[check]
    assert all(JOB.judge({}, "humble", "rmw_fastrtps_cpp").values()), "nodes without output pass no check"


def test_cells_and_settings_are_those_of_the_page() -> None:
    page = (ROOT / "docs" / "ros.md").read_text(encoding="utf-8")
    for server in set(JOB.MIDDLEWARE.values()):
        assert server in parse_cell(JOB.CELL.format(server, JOB.DOMAIN)).servers
    assert JOB.settings("humble", "rmw_cyclonedds_cpp")["CYCLONEDDS_URI"] in page
    assert "=".join(list(JOB.settings("jazzy", "rmw_cyclonedds_cpp").items())[-1]) in page
    assert set(JOB.settings("jazzy", "rmw_fastrtps_cpp")) == {"RMW_IMPLEMENTATION", "ROS_DOMAIN_ID"}


def test_the_script_in_the_container_parses() -> None:
    done = subprocess.run(["bash", "-n", str(CHECKS)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
    monkeypatch.setattr(sys, "executable", str(folder / "python"))
    monkeypatch.setattr(JOB.shutil, "which", lambda name: str(folder / name) if (folder / name).exists() else None)
    return folder


def program(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(f"#!/bin/bash\n{text}\n")
    (folder / name).chmod(0o755)


def ask(folder: Path, *wanted: str) -> tuple[int, Path, Path]:
    results, readme = folder / "ros2.json", folder / "README.md"
    readme.write_text("Checked against others; not yet against a running ROS 2 node. ROS 1: with a roscore.\n")
    return JOB.main(list(wanted), results, (readme,)), results, readme


def test_without_docker_it_refuses(programs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, results, _ = ask(programs)
    assert status == 2
    assert "Expected docker, got none" in capsys.readouterr().err
    assert not results.exists()
    assert ask(programs, "noetic")[0] == 2
    assert "Expected some of humble, jazzy, kilted, got noetic." in capsys.readouterr().err
    program(programs, "docker", "exit 1")
    assert ask(programs)[0] == 2
    assert "ros:humble was not built" in capsys.readouterr().err
    assert not results.exists()


def test_a_run_makes_a_table_a_file_and_a_sentence(programs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (programs / "said.txt").write_text(OUTPUT)
    seen = f'echo "$*" >> {programs}/asked.txt'
    program(programs, "docker", f'{seen}; case "$*" in build*|*cyclone*) ;; *) cat {programs}/said.txt;; esac')
    program(programs, "armlab", "echo listens >&2; trap 'exit 0' INT; while true; do sleep 0.05; done")
    status, results, readme = ask(programs, "jazzy")
    assert status == 1
    runs = json.loads(results.read_text())
    assert [(one["middleware"], any(one["checks"].values())) for one in runs] == [
        ("rmw_fastrtps_cpp", False),
        ("rmw_cyclonedds_cpp", True),
        ("rmw_zenoh_cpp", False),
    ]
    said = "nodes of ROS 2 Jazzy (rmw_fastrtps_cpp, rmw_zenoh_cpp) read and command, not those of Jazzy"
    assert said in readme.read_text()
    out = capsys.readouterr().out
    assert "jazzy  rmw_zenoh_cpp       yes   yes  yes" in out
    assert "jazzy, rmw_cyclonedds_cpp, hz: 0 Hz" in out
    asked = (programs / "asked.txt").read_text()
    assert "build --pull -t armlab-ros2-jazzy -" in asked
    assert "run --rm --network host -e RMW_IMPLEMENTATION=rmw_fastrtps_cpp -e ROS_DOMAIN_ID=77 " in asked


PAGE = (ROOT / "docs" / "ros.md").read_text(encoding="utf-8")
RUNS = json.loads(JOB.RESULTS.read_text(encoding="utf-8")) if JOB.RESULTS.exists() else []
ARM = robots.load("yumi_left")


def test_every_topic_stands_on_the_page_with_its_type() -> None:
    rows = re.findall(r"^\| `([\w/]+)`(, `…/(\w+)`)? \| `([\w/]+)` \|", PAGE, flags=re.M)
    told = {name: type_ for name, _, _, type_ in rows}
    told |= {f"{name.rpartition('/')[0]}/{also}": type_ for name, _, also, type_ in rows if also}
    topics = {name: one.type for name, one in Topics({ARM.name: ARM}, RowSchema.of([ARM])).published.items()}
    topics |= Commands("cell", {ARM.name: ARM}).types
    topics |= {f"/{ARM.name}/{CONTROLLER}/joint_trajectory": TRAJECTORY}
    assert {f"/yumi_left/{name}": type_ for name, type_ in told.items()} == topics


def test_what_is_said_to_be_checked_is_what_the_tests_check() -> None:
    section = PAGE.partition("## Compatibility")[2].partition("\n## ")[0]
    real = JOB.clause(RUNS) if RUNS else "Not yet checked against a running ROS 2 node"
    assert re.findall(r"\*\*([^*]+)\*\*", section) == [*PEERS, real]
    zenoh = PAGE.partition("## ROS 2 over Zenoh")[2].partition("\n## ")[0]
    assert re.findall(r"\*\*([^*]+)\*\*", zenoh) == [*RELEASES, f"zenoh-ros2-sdk {SDK}"]


@pytest.mark.parametrize("page", JOB.PAGES, ids=lambda page: page.name)
def test_the_readme_and_the_parity_table_claim_what_the_tests_check(page: Path) -> None:
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
        pytest.skip("the versions apply only to Debian 12")
    command = ["dpkg-query", "-W", "-f", "${Version}", package]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    if found.returncode:
        pytest.skip(f"{package} is not installed")
    assert re.match(r"[\d.]+", found.stdout)[0] == _claimed()[place].split()[-1]  # type: ignore[index]


def _claimed() -> list[str]:
    found = [re.match(r"(.+ [\d.]+), C", name) for name in PEERS]
    return sorted(one[1] for one in found if one)


def _number(release: str) -> list[int]:
    return [int(part) for part in release.split(".")]
