#!/usr/bin/env python3
"""Level 3 tests: the bridge of a simulated arm against real ROS 2 in containers, with each middleware.

    .venv/bin/python .ci/ros2.py                 # everything: Linux, Docker, about 4 GB of images, an hour
    .venv/bin/python .ci/ros2.py jazzy           # some distributions

The bridge runs on this computer and the containers share its network. The results are printed as a table, saved in
.ci/ros2.json, and stated in README.md and docs/parity.md. tests/bridge/servers/ros/test_page.py checks these pages, and
docs/ros.md, which is edited by hand, against that file.
"""

from __future__ import annotations

import datetime
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

FOLDER = Path(__file__).parent
RESULTS, CHECKS = FOLDER / "ros2.json", FOLDER / "ros2_checks.sh"
PAGES = (FOLDER.parent / "README.md", FOLDER.parent / "docs" / "parity.md")
DISTRIBUTIONS = ("humble", "jazzy", "kilted")
MIDDLEWARE = {"rmw_fastrtps_cpp": "ros2", "rmw_cyclonedds_cpp": "ros2", "rmw_zenoh_cpp": "rmw_zenoh"}
DOMAIN = 77  # not used by any other robot on this computer
HASH = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"  # type hash of JointState
IMAGE = """
FROM ros:{0}
RUN apt-get update && apt-get install -y --no-install-recommends \
    ros-{0}-rmw-fastrtps-cpp ros-{0}-rmw-cyclonedds-cpp ros-{0}-rmw-zenoh-cpp
"""
CELL = """
name = "level3"
commands = ["{0}"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[parameters.gain]
default = 2.0
maximum = 10.0
rights = "anyone"
[servers.{0}]
domain = {1}
"""
# Cyclone DDS setting from docs/ros.md for Humble; from Iron on, a discovery range replaces it.
PEERS = (
    "<CycloneDDS><Domain><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
)


def sections(output: str) -> dict[str, str]:
    """Return the output of each section of the checks."""
    parts = re.split(r"^== (\w+)\n", output, flags=re.M)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def numbers(echoed: str, field: str) -> list[float]:
    """Return an array field of a message printed by `ros2 topic echo`."""
    found = re.search(rf"^{field}:\n((?:- \S+\n)+)", echoed, flags=re.M)
    return [float(line[2:]) for line in found[1].splitlines()] if found else []


def rate(text: str) -> float:
    """Return the last average rate printed by `ros2 topic hz`, or 0 if none was printed."""
    found = re.findall(r"^average rate: ([\d.]+)$", text, flags=re.M)
    return float(found[-1]) if found else 0.0


def judge(said: dict[str, str], distribution: str, middleware: str) -> dict[str, str]:
    """Return the reason for the failure of each check; "" if it passed."""
    q = {name: numbers(said.get(name, ""), "position") for name in ("echo", "moved", "stopped", "held")}
    missing = {name: f"no joint states: {said.get(name, '')[-200:]!r}" for name in q if len(q[name]) != 7}
    info, hz = said.get("info", ""), rate(said.get("hz", ""))
    wanted = ["Type: sensor_msgs/msg/JointState", "Publisher count: 1", "Reliability: RELIABLE", "Durability: VOLATILE"]
    wanted += ["Node name: yumi_left"] + ([HASH] if distribution != "humble" else [])
    lacks = [words for words in wanted if words not in info]

    def turned(name: str, since: str) -> float:
        return q[name][6] - q[since][6]

    moved = missing.get("echo") or missing.get("moved")
    held = missing.get("stopped") or missing.get("held")
    return {
        "echo": missing.get("echo") or ("" if "- yumi_robl_joint_1\n" in said["echo"] else "without names of joints"),
        "hz": "" if 240.0 < hz < 255.0 else f"{hz:g} Hz",
        "info -v": f"without {lacks}: {info[-400:]!r}" if lacks else "",
        "parameter": "" if '"gain": 3.0' in said.get("parameters", "") else f"{said.get('parameters', '')[-200:]!r}",
        "command": moved or ("" if turned("moved", "echo") > 0.05 else f"turned by {turned('moved', 'echo'):.4f} rad"),
        "stop": held or ("" if abs(turned("held", "stopped")) < 0.005 else f"turned {turned('held', 'stopped'):.4f}"),
    }


def clause(results: list[dict]) -> str:
    """Return the clause on ROS 2 nodes for the pages."""

    def named(has_passed: bool) -> str:
        known = {name: [] for name in DISTRIBUTIONS}
        for one in results:
            if any(one["checks"].values()) != has_passed:
                known[one["distribution"]].append(one["middleware"])
        return ", ".join(f"{name.title()} ({', '.join(found)})" for name, found in known.items() if found)

    if not named(True):
        return "not yet against a running ROS 2 node"
    return f"nodes of ROS 2 {named(True)} read and command" + (f", not those of {named(False)}" if named(False) else "")


def stated(page: str, results: list[dict]) -> str:
    """Return a page with the results inserted into its sentence on ROS 2."""
    return re.sub(r"(?<=; )[^;]*(?=\. ROS 1:)", clause(results), page)


def settings(distribution: str, middleware: str) -> dict[str, str]:
    """Return the environment of the nodes: only the variables that docs/ros.md asks users to set."""
    found = {"RMW_IMPLEMENTATION": middleware, "ROS_DOMAIN_ID": str(DOMAIN)}
    if middleware == "rmw_cyclonedds_cpp":
        is_old = distribution == "humble"
        found |= {"CYCLONEDDS_URI": PEERS} if is_old else {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return found


def until_listening(bridge: subprocess.Popen[bytes], notes: Path) -> None:
    """Wait for the first output line of a bridge, which lists its addresses."""
    end = time.monotonic() + 60.0
    while "\n" not in notes.read_text():
        if bridge.poll() is not None or time.monotonic() > end:
            raise SystemExit(f"Expected a listening bridge, got: {notes.read_text()}")
        time.sleep(0.1)


def checked(distribution: str, middleware: str, image: str) -> dict:
    """Run a bridge, run the checks in a container, and return the results."""
    server = MIDDLEWARE[middleware]
    cell = CELL.format(server, DOMAIN)
    cell += f'distribution = "{distribution}"\n' if server == "rmw_zenoh" else ""
    words = [word for pair in settings(distribution, middleware).items() for word in ("-e", "=".join(pair))]
    command = ["docker", "run", "--rm", "--network", "host", *words, image, "bash", "-c", CHECKS.read_text()]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cell.toml"
        file.write_text(cell)
        environment = {**os.environ, "XDG_RUNTIME_DIR": folder}
        armlab = [str(Path(sys.executable).with_name("armlab")), "bridge", "--config", str(file), "--seconds", "1200"]
        notes = Path(folder) / "notes.txt"
        with notes.open("wb") as err, subprocess.Popen(armlab, cwd=folder, env=environment, stderr=err) as bridge:
            try:
                until_listening(bridge, notes)
                done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False, timeout=1000)
                said = sections(done.stdout)
            except subprocess.TimeoutExpired:
                said = {}
            finally:
                bridge.send_signal(signal.SIGINT)
    checks = judge(said, distribution, middleware)
    today = datetime.date.today().isoformat()
    return {"distribution": distribution, "middleware": middleware, "image": image, "date": today, "checks": checks}


def table(results: list[dict]) -> str:
    """Return a table with one row per run and "yes" for each passed check, followed by the failures."""
    names = list(results[0]["checks"])
    rows = [["ROS 2", "middleware", *names]]
    for one in results:
        marks = ["NO" if one["checks"][name] else "yes" for name in names]
        rows.append([one["distribution"], one["middleware"], *marks])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    for one in results:
        wrong = {name: why for name, why in one["checks"].items() if why}
        lines += [f"{one['distribution']}, {one['middleware']}, {name}: {why}" for name, why in wrong.items()]
    return "\n".join(lines)


def main(wanted: list[str], file: Path = RESULTS, pages: tuple[Path, ...] = PAGES) -> int:
    """Run the checks of the given distributions; return 0 if all passed, 1 if any failed, 2 if they cannot run."""
    if unknown := set(wanted) - set(DISTRIBUTIONS):
        print(f"Expected some of {', '.join(DISTRIBUTIONS)}, got {', '.join(unknown)}.", file=sys.stderr)
        return 2
    if shutil.which("docker") is None:
        print("Expected docker, got none: the checks run ROS 2 in containers. Install Docker.", file=sys.stderr)
        return 2
    results = []
    for distribution in wanted or DISTRIBUTIONS:
        image = f"armlab-ros2-{distribution}"
        build = ["docker", "build", "--pull", "-t", image, "-"]
        if subprocess.run(build, input=IMAGE.format(distribution), text=True, check=False).returncode:
            print(f"The image for ros:{distribution} was not built: see above. Nothing was written.", file=sys.stderr)
            return 2
        results += [checked(distribution, middleware, image) for middleware in MIDDLEWARE]
    before = json.loads(file.read_text()) if file.exists() else []
    kept = [one for one in before if wanted and one["distribution"] not in wanted]
    print(table(results))
    everything = sorted([*kept, *results], key=lambda one: DISTRIBUTIONS.index(one["distribution"]))
    file.write_text(json.dumps(everything, indent=1) + "\n")
    for page in pages:
        page.write_text(stated(page.read_text(encoding="utf-8"), everything), encoding="utf-8")
    return int(any(any(one["checks"].values()) for one in results))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
