"""Demo on other arms from their descriptions: worst force error of five seeds relative to a scaled target.

The target of an arm is that of a YuMi, scaled by the force error in the home position for torque errors of 1 % of the
torque limits (`armlab.cli.demo.force_unit`).

python benchmarks/any_arm.py                 all arms, five seeds each, about ten minutes
python benchmarks/any_arm.py panda ur5e      some arms
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from armlab import robots
from armlab.cli import main as armlab
from armlab.errors import RobotError, UnknownName

__all__ = ["ARMS", "SCARA", "demo"]

# arms of the library, example-robot-data and robot_descriptions, and a file, each with its demo options
ARMS: dict[str, list[str]] = {
    "panda": [],
    "ur5e": [],
    "iiwa14": [],
    "irb2400": [],  # coupled axes
    "scara.urdf": [],
    "panda_description": ["--tip", "panda_hand"],  # like ur5_robot, from example-robot-data
    "ur5_robot": ["--tip", "tool0"],
    "gen3_description": [],  # downloaded once by robot_descriptions
    "iiwa14_description": [],
}
SEEDS = range(5)

SCARA = """<robot name="scara4"><link name="base"/>
<link name="arm1"><inertial><origin xyz="0.16 0 0.03"/><mass value="4.5"/>
  <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.06" iyz="0" izz="0.065"/></inertial></link>
<link name="arm2"><inertial><origin xyz="0.12 0 0.05"/><mass value="3.2"/>
  <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.035" iyz="0" izz="0.04"/></inertial></link>
<link name="quill"><inertial><origin xyz="0 0 0.02"/><mass value="0.8"/>
  <inertia ixx="0.004" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.0004"/></inertial></link>
<link name="flange"><inertial><origin xyz="0 0 0.01"/><mass value="0.25"/>
  <inertia ixx="0.0003" ixy="0" ixz="0" iyy="0.0003" iyz="0" izz="0.0002"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="arm1"/><origin xyz="0 0 0.2"/>
  <axis xyz="0 0 1"/><limit effort="90" lower="-2.4" upper="2.4" velocity="6"/></joint>
<joint name="elbow" type="revolute"><parent link="arm1"/><child link="arm2"/><origin xyz="0.3 0 0"/>
  <axis xyz="0 0 1"/><limit effort="45" lower="-2.6" upper="2.6" velocity="8"/></joint>
<joint name="lift" type="prismatic"><parent link="arm2"/><child link="quill"/>
  <origin xyz="0.25 0 0" rpy="3.141592653589793 0 0"/>
  <axis xyz="0 0 1"/><limit effort="160" lower="0" upper="0.18" velocity="1"/></joint>
<joint name="spin" type="revolute"><parent link="quill"/><child link="flange"/><origin xyz="0 0 0.05"/>
  <axis xyz="0 0 1"/><limit effort="6" lower="-6.2" upper="6.2" velocity="20"/></joint></robot>"""


def demo(name: str, seed: int, folder: Path) -> dict[str, Any]:
    """Run the demo in lockstep in a new folder and return its summary.

    Raises UnknownName or RobotError if the description is not installed and cannot be downloaded.
    """
    words, robot = ARMS[name], name
    if name.endswith(".urdf"):
        robot = str(folder / name)
        Path(robot).write_text(SCARA)
    elif words or name.endswith("_description"):
        robots.load(name, tip=words[1] if words else None)
    output = folder / "demo"
    armlab(["demo", "--fast", "--robot", robot, *words, "--seed", str(seed), "-o", str(output)])
    return json.loads((output / "summary.json").read_text())


def main() -> int:
    """Run the arms and print a table."""
    print("| arm | worst force RMS of 5 seeds [N] | target [N] | seeds that meet all targets |\n|---|---|---|---|")
    missed = 0
    for name in sys.argv[1:] or ARMS:
        found = []
        for seed in SEEDS:
            print(f"{name}, seed {seed} ...", file=sys.stderr, flush=True)
            with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
                try:
                    found.append(demo(name, seed, Path(folder)))
                except (UnknownName, RobotError) as error:
                    print(f"{name}: {error}", file=sys.stderr)
                    break
        if found:
            worst = np.nanmax([one["force_rms"] + one["false_force_rms"] for one in found])
            passed = sum(one["passed"] for one in found)
            missed += len(found) - passed
            print(f"| {name} | {worst:.2f} | {found[0]['force_bar']:.3g} | {passed} of {len(found)} |", flush=True)
        else:
            print(f"| {name} | not installed | | |", flush=True)
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
