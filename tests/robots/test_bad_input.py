"""Whatever is wrong with the description of a robot, one sentence says it: no error of NumPy comes through."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ArmlabError, RobotError, ShapeError, UnknownName
from armlab.robots import Robot

ONE = np.eye(4)
LINKS = np.tile(ONE, (3, 1, 1))
TURN = [[0, 0, 0, 0, 0, 1]]
LIMITS = {"q_min": [-1.0, -1.0], "q_max": [1.0, 1.0], "qd_max": [1.0, 1.0]}


def two(**details: Any) -> Robot:
    return robots.from_dh("r", 0.0, [1.0, 1.0], 0.0, **details)


@pytest.fixture(scope="module")
def yumi() -> Robot:
    return robots.load("yumi_left")


def pose(**changes: float) -> np.ndarray:
    """The identity with entries changed: pose(a01=2) has 2 in row 0, column 1."""
    T = np.eye(4)
    for key, value in changes.items():
        T[int(key[1]), int(key[2])] = value
    return T


NO_POSES = [
    (2 * ONE, "to be a pose"),
    (pose(a00=-1), "to be a pose"),  # a mirror
    (pose(a01=1e-6), "orthonormal to 1e-09.*Project it first"),
    (pose(a30=1), "to be a pose"),
    (pose(a33=0), "to be a pose"),
    (pose(a03=np.nan), r"got NaN at index \(0, 3\)"),
    (pose(a03=np.inf), "to be a pose"),
    (np.full((4, 4), np.nan), r"got NaN at index \(0, 0\)"),
    (np.eye(3), r"to have shape \(4, 4\), got \(3, 3\)"),
    (ONE[None], r"to have shape \(4, 4\), got \(1, 4, 4\)"),
    (np.zeros(16), r"to have shape \(4, 4\), got \(16,\)"),
    (1j * ONE, "to be real numbers"),
    ("up", "to be real numbers, got 'up'"),
    (None, "to be real numbers, got None"),
    ([[1, 0], [0]], r"to be real numbers, got \[\[1, 0\], \[0\]\]"),
]


@pytest.mark.parametrize(("T", "sentence"), NO_POSES)
def test_tools_and_bases_that_are_no_poses(yumi: Robot, T: Any, sentence: str) -> None:
    for change, field in ((yumi.with_tool, "T_flange_tool"), (yumi.with_base, "T_base_mount")):
        with pytest.raises(RobotError, match=rf"Expected .*{field} of robot 'yumi_left'.*{sentence}") as caught:
            change(T)
        assert str(caught.value).endswith(".")


BAD: dict[str, tuple[Callable[[], object], type[ArmlabError], str]] = {
    "no links": (lambda: robots.from_links("r", None), RobotError, "Expected links of robot 'r' to be real numbers"),
    "one pose": (lambda: robots.from_links("r", ONE), RobotError, "Expected links of robot 'r' .* got"),
    "a number": (lambda: robots.from_links("r", 3.0), RobotError, "Expected at least one joint for robot 'r'"),
    "3x3 links": (lambda: robots.from_links("r", LINKS[:, :3, :3]), RobotError, "got .3, 3, 3."),
    "NaN in a link": (lambda: robots.from_links("r", LINKS * np.nan), RobotError, "Expected numbers in links"),
    "scaled link": (lambda: robots.from_links("r", 2 * LINKS), RobotError, r"Expected links\[0\] of robot 'r'"),
    "one flag for two joints": (
        lambda: robots.from_links("r", LINKS, [True]), RobotError,
        r"Expected prismatic of robot 'r' \(2 joints\) to have shape \(2,\), got \(1,\)\.",
    ),
    "words for flags": (lambda: robots.from_links("r", LINKS, ["a", "b"]), RobotError, "Expected prismatic of robot"),
    "a matrix of angles": (
        lambda: robots.from_dh("r", np.zeros((2, 2)), 0, 0), RobotError,
        r"Expected alpha in the DH table of 'r' as one column \(n,\), got shape \(2, 2\)\.",
    ),
    "no angle": (lambda: robots.from_dh("r", None, [1, 2], 0), RobotError, "Expected alpha in the DH table of 'r' to"),
    "a word": (lambda: robots.from_dh("r", "pi", [1, 2], 0), RobotError, "real numbers, got 'pi'"),
    "columns of two lengths": (lambda: robots.from_dh("r", 0, [1, 2], [1, 2, 3]), RobotError, "of one length"),
    "NaN in a table": (
        lambda: robots.from_dh("r", [0.0, np.nan], 1.0, 0.0), RobotError,
        r"Expected finite alpha in the DH table of 'r', got nan at joint 2\.",
    ),
    "empty table": (lambda: robots.from_dh("r", [], [], []), RobotError, "Expected at least one joint"),
    "screws of five": (lambda: robots.from_poe("r", np.ones((2, 5)), ONE), RobotError, r"screws of shape \(n, 6\)"),
    "one screw flat": (lambda: robots.from_poe("r", TURN[0], ONE), RobotError, r"screws of shape \(n, 6\)"),
    "a screw": (lambda: robots.from_poe("r", 1.0, ONE), RobotError, r"screws of shape \(n, 6\)"),
    "NaN in a screw": (lambda: robots.from_poe("r", np.full((1, 6), np.nan), ONE), RobotError, "for joint 1"),
    "a home that is none": (lambda: robots.from_poe("r", TURN, 2 * ONE), RobotError, "Expected T_home of robot 'r'"),
    "a home with holes": (lambda: robots.from_poe("r", TURN, [[1], []]), RobotError, "Expected T_home of robot 'r'"),
    "poses missing": (lambda: robots.from_local_poe("r", ONE[None], TURN), RobotError, r"\(n\+1, 4, 4\)"),
    "a word as screw": (lambda: robots.normalise_screw("x"), ShapeError, "Expected screw to be real numbers"),
    "limits reversed": (
        lambda: two(q_min=[-1, 1], q_max=[1, -1]), RobotError,
        r"Expected q_min below q_max at joint 2 \(joint_2\) of robot 'r', got q_min 1, q_max -1\.",
    ),
    "limits equal": (lambda: two(q_min=[1, 1], q_max=[1, 2]), RobotError, "Expected q_min below q_max at joint 1"),
    "no limits": (lambda: two(q_min=None), RobotError, "Expected q_min of robot 'r' to be real numbers, got None"),
    "gravity in words": (lambda: two(gravity="down"), RobotError, "Expected gravity of robot 'r' to be real numbers"),
    "names that are numbers": (lambda: two(joint_names=[1, 2]), RobotError, "Expected text in joint_names"),
    "no source": (lambda: two(source=None), RobotError, "Expected text in source of robot 'r', got None"),
    "nine inertial numbers": (lambda: two(inertias=np.zeros((2, 9))), RobotError, r"shape \(2, 10\), got \(2, 9\)"),
    "inertias of one link": (lambda: two(inertias=np.zeros((1, 10))), RobotError, r"shape \(2, 10\), got \(1, 10\)"),
    "torque limits of none": (lambda: replace(two(), tau_max=None), RobotError, "Expected tau_max of robot 'r'"),
    "a text for names": (lambda: two(joint_names="ab"), RobotError, "Expected joint_names of .* as a list or tuple"),
    "no names": (lambda: two(joint_names=None), RobotError, "Expected joint_names of robot 'r' as a list or tuple"),
    "no axes": (lambda: two(abb_axes=None), RobotError, "Expected abb_axes of robot 'r' as a list or tuple"),
    "axes that are no counts": (lambda: two(abb_axes=[1.0, 2.0]), RobotError, r"as whole numbers, got \[1\.0, 2\.0\]"),
    "axes of two kinds": (lambda: two(abb_axes=["1", 2]), RobotError, "as whole numbers, got"),
    "no meshes": (lambda: two(meshes=None), RobotError, "Expected meshes of robot 'r' as a list or tuple"),
    "meshes not by link": (lambda: two(meshes=[1, 2, 3]), RobotError, "Expected meshes of one link of robot 'r'"),
    "half a flag": (lambda: robots.from_links("r", LINKS, [1, 0.5]), RobotError, "Expected prismatic .* as True and"),
    "NaN for a flag": (lambda: robots.from_links("r", LINKS, [1, np.nan]), RobotError, "Expected prismatic .* as True"),
    "a convention by name": (
        lambda: robots.from_dh("r", 0, [1, 2], 0, modified="standard"), RobotError,  # type: ignore[arg-type]
        "Expected modified of robot 'r' to be True or False, got 'standard'",
    ),
    "33 joints": (lambda: robots.from_dh("r", 0, np.ones(33), 0), RobotError, "Expected at most 32 joints for robot"),
    "one scale": (
        lambda: robots.Mesh("visual", "a.stl", ONE, 2.0), RobotError,  # type: ignore[arg-type]
        "Expected 3 finite factors of mesh 'a.stl'",
    ),
    "a name for a robot": (
        lambda: robots.to_local_poe("irb120"), RobotError,  # type: ignore[arg-type]
        r"Expected a Robot, got 'irb120'\. Load it first: robots\.load\('irb120'\)\.",
    ),
    "nothing to save": (lambda: robots.save(None, "r.toml"), RobotError, "Expected a Robot, got None"),  # type: ignore[arg-type]
    "nowhere to save": (lambda: robots.save(two(), None), RobotError, "Expected the path of a file"),  # type: ignore[arg-type]
    "no path at all": (lambda: robots.urdf.read(None), RobotError, "Expected a URDF file at None"),  # type: ignore[arg-type]
    "a path for a text": (
        lambda: robots.urdf.parse(Path("a.urdf")), RobotError,  # type: ignore[arg-type]
        "Expected the text of a URDF, got .*Of a file: urdf.read",
    ),
    "no robot": (lambda: robots.load("irb121"), UnknownName, "Did you mean"),
    "a number for a name": (lambda: robots.load(3), UnknownName, "got '3'. Known: dh_test"),  # type: ignore[arg-type]
    "no file": (lambda: robots.load("absent.toml"), RobotError, "Expected a robot file at absent.toml"),
    "no URDF": (lambda: robots.load("absent.urdf"), RobotError, "Expected a URDF file at absent.urdf"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_one_sentence(case: str) -> None:
    make, error, sentence = BAD[case]
    with pytest.raises(error, match=sentence) as caught:
        make()
    message = str(caught.value)
    assert message.endswith((".", "?"))  # "Did you mean ...?"
    assert "\n" not in message
    assert len(message) < 500


@pytest.mark.parametrize("field", ["q_min", "q_max", "qd_max", "qdd_max", "q_home", "tau_max"])
def test_every_vector_of_the_wrong_length_or_with_nan(field: str) -> None:
    with pytest.raises(
        RobotError, match=rf"Expected {field} of robot 'r' \(2 joints\) to have shape \(2,\), got \(3,\)"
    ):
        replace(two(**LIMITS), **{field: [1.0, 2.0, 3.0]})
    with pytest.raises(
        RobotError, match=rf"Expected numbers in {field} of robot 'r', got NaN at joint 2 \(joint_2\)\."
    ):
        replace(two(**LIMITS), **{field: [0.5, np.nan]})
    with pytest.raises(RobotError, match=f"Expected {field} of robot 'r' to be real numbers, got 'many'"):
        replace(two(**LIMITS), **{field: "many"})
