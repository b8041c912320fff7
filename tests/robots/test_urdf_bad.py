"""URDF that contradicts itself: one sentence with file, line and what to do. Corrupted text: no other exception."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import robots
from armlab.errors import ArmlabError, RobotError, ShapeError, UnknownName
from armlab.robots import Robot, urdf

ARM = """<?xml version="1.0" encoding="utf-8"?>
<robot name="arm">
  <link name="foot"/>
  <joint name="turn" type="revolute">
    <parent link="foot"/>
    <child link="upper"/>
    <origin xyz="0 0 0.1" rpy="0 0.5 0"/>
    <axis xyz="0 0 1"/>
    <limit lower="-2" upper="2.5" effort="40" velocity="3"/>
  </joint>
  <link name="upper">
    <inertial>
      <origin xyz="0 0 0.05"/>
      <mass value="2"/>
      <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/>
    </inertial>
    <visual><geometry><mesh filename="upper.stl"/></geometry></visual>
  </link>
  <joint name="slide" type="prismatic">
    <parent link="upper"/>
    <child link="lower"/>
    <axis xyz="1 1 0"/>
    <limit lower="0" upper="0.4" effort="100" velocity="0.5"/>
    <mimic joint="turn" multiplier="0.1"/>
  </joint>
  <link name="lower"/>
</robot>
"""
TURN = '<joint name="turn" type="revolute">'
LIMIT = '<limit lower="-2" upper="2.5" effort="40" velocity="3"/>'
MASS = '<mass value="2"/>'
INERTIA = '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/>'
LOOSE = '<joint name="j" type="fixed"><parent link="{}"/><child link="{}"/></joint>'
END = "</robot>"
FAULTS = [  # what is replaced by what; the line that must be named; the sentence
    (END, "", 28, "Expected XML in .*, got: no element found"),
    ("</link>\n  <joint", "\n  <joint", 27, "Expected XML in .*, got: mismatched tag"),
    ('"utf-8"', '"utf-77"', 1, "Expected XML in .*, got: unknown encoding"),
    ('"utf-8"?>', '"utf-8"?><!DOCTYPE robot [<!ENTITY a "b">]>', 1,
     "XML without a document type .*Remove the document type"),
    ("robot", "sdf", 2, "Expected <robot> as the outermost element of a URDF .* got <sdf>"),
    ('name="arm"', "", 2, "Expected the attribute name of <robot>.*Add it"),
    ('<link name="foot"/>', "<link/>", 3, "the attribute name of <link> .* got none"),
    ('<link name="foot"/>', '<link name=" "/>', 3, "the attribute name of <link> .* got none"),
    ('<link name="foot"/>', '<link name="lower"/>', 26, "link .* unique name .*'lower' again, as in line 3"),
    ('name="slide"', 'name="turn"', 19, "every joint to have a unique name .* 'turn' again, as in line 4"),
    ('<link name="foot"/>', "", 4, "the parent of joint 'turn' to be one of the links .* got 'foot'. Add"),
    ('child link="upper"', 'child link="uper"', 4, "joint 'turn' to be one of the links .* closest name is 'upper'"),
    (END, LOOSE.format("foot", "lower") + END, 27, "joint above link 'lower' .* 'j' in addition to 'slide' in line 19"),
    (END, LOOSE.format("lower", "foot") + END, 4, "directed away from a single root .*a loop through joint 'turn'"),
    (END, '<link name="a"/>' + LOOSE.format("a", "a") + END, 27, "a loop through joint 'j'"),
    (END, '<link name="alone"/></robot>', 27, "one root link .*'foot' .line 3., 'alone' .line 27"),
    ('type="revolute"', 'type="hinge"', 4, "a joint type among revolute, continuous, .* got 'hinge'"),
    ('type="revolute"', "", 4, "the attribute type of <joint> .* got none"),
    ('<parent link="foot"/>', "", 4, "a <parent> inside <joint> .* got none. Add it"),
    ('<child link="upper"/>', "", 4, "a <child> inside <joint> .* got none. Add it"),
    ('<child link="upper"/>', '<child/>', 6, "the attribute link of <child>"),
    ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><axis xyz="0 0 1"/>', 8, "one <axis> inside <joint> .* another"),
    ('<axis xyz="0 0 1"/>', '<axis xyz="0 0"/>', 8, "Expected 3 numbers in xyz of <axis> .* got '0 0'"),
    ('<axis xyz="0 0 1"/>', '<axis/>', 8, "the attribute xyz of <axis>"),
    ('xyz="0 0 0.1"', 'xyz="0 0 nan"', 7, "a finite number in xyz of <origin> .* got 'nan'"),
    ('xyz="0 0 0.1"', 'xyz="0 0 inf"', 7, "a finite number in xyz of <origin> .* got 'inf'"),
    ('xyz="0 0 0.1"', 'xyz="0 0 1e999"', 7, "numbers below 1e.09 in xyz of <origin> .* got 1e999"),
    ('xyz="0 0 0.1"', 'xyz="0, 0, 0.1"', 7, "a finite number in xyz of <origin> .* got '0,'"),
    ('xyz="0 0 0.1"', 'xyz="0 0 1_0"', 7, "a finite number in xyz of <origin> .* got '1_0'"),
    ('xyz="0 0 0.1"', 'xyz="0 0 ${h}"', 7, "plain text in xyz of <origin> .* xacro expression .* Expand the file"),
    ('filename="upper.stl"', 'filename="$(find a)/b"', 17, "plain text in filename of <mesh> .* Expand the file"),
    ('filename="upper.stl"', "", 17, "the attribute filename of <mesh>"),
    ('filename="upper.stl"', 'filename="a" scale="1 0 1"', 17, "a scale other than 0"),
    ('filename="upper.stl"', 'filename="a" scale="1"', 17, "3 numbers in scale of <mesh> .* got '1'"),
    ('<link name="lower"/>', '<xacro:arm name="a"/>', 26, "a URDF .* got the xacro element <xacro:arm>. Expand"),
    ('lower="-2"', 'lower="nan"', 9, "a finite number in lower of <limit> .* got 'nan'"),
    ('lower="-2"', 'lower="deg"', 9, "a finite number in lower of <limit> .* got 'deg'"),
    (MASS, "", 12, "a <mass> inside <inertial>"),
    (MASS, "<mass/>", 14, "the attribute value of <mass>"),
    (MASS, '<mass value="nan"/>', 14, "a finite number in value of <mass>"),
    (INERTIA, "", 12, "a <inertia> inside <inertial>"),
    ('iyz="0" ', "", 15, "the attribute iyz of <inertia>"),
    ('multiplier="0.1"', 'multiplier=""', 24, "the attribute multiplier of <mimic>"),
]  # fmt: skip
FOLLOW = "to mimic a revolute or prismatic joint"
IN_THE_ARM = [  # refused where the joint or link is part of the arm from foot to lower; the ends of an arm without it
    (TURN, '<joint name="turn" type="floating">', 4, "got floating joint 'turn'. Choose base and tip", None),
    ('type="prismatic"', 'type="planar"', 19, "one degree of freedom .* got planar joint 'slide'", ("foot", "upper")),
    ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', 4, "a non-zero axis of joint 'turn'", ("upper", "lower")),
    (LIMIT, "", 4, "below upper in joint 'turn' .* 0 and 0 .*missing values are 0.*`continuous`", ("upper", "lower")),
    ('lower="-2" upper="2.5"', "", 4, "below upper in joint 'turn' .* 0 and 0 .*missing values", ("upper", "lower")),
    ('lower="-2"', 'lower="3"', 4, "below upper in joint 'turn' .* got 3 and 2.5", ("upper", "lower")),
    ('upper="0.4"', 'upper="0"', 19, "below upper in joint 'slide' .* make it `fixed`", ("foot", "upper")),
    ('velocity="3"', 'velocity="-3"', 4, "speed and effort limits of joint 'turn' .* velocity -3", ("upper", "lower")),
    ('effort="100"', 'effort="-1"', 19, "speed and effort limits of joint 'slide' .* effort -1", ("foot", "upper")),
    (MASS, '<mass value="-2"/>', 11, "inertia in link 'upper' .* got a mass of -2 kg. Correct it", ("upper", "lower")),
    ('iyz="0"', 'iyz="0.1"', 11, r"inertia in link 'upper' .* principal moments \[-0.08", ("upper", "lower")),
    ('izz="0.01"', 'izz="-0.01"', 11, r"inertia in link 'upper' .* principal moments \[-0.01", ("upper", "lower")),
    ('joint="turn"', 'joint="turm"', 19, f"'slide' {FOLLOW} .*'turm', which does not exist", ("foot", "upper")),
    ('joint="turn"', 'joint="slide"', 19, f"'slide' {FOLLOW} .*'slide', which mimics itself", ("foot", "upper")),
    (TURN, '<joint name="turn" type="fixed">', 19, f"'slide' {FOLLOW} .*'turn', which is fixed", None),
    (LIMIT, LIMIT + '<mimic joint="slide"/>', 19, f"'slide' {FOLLOW} .*'turn', which mimics itself", None),
]  # fmt: skip


def spoiled(old: str, new: str) -> str:
    assert old in ARM
    text = ARM.replace(old, new) if old == "robot" else ARM.replace(old, new, 1)
    return text.replace('<mimic joint="turn" multiplier="0.1"/>', "") if 'type="floating"' in new else text


@pytest.mark.parametrize(
    ("old", "new", "line", "sentence", "others"), [(*fault, None) for fault in FAULTS] + IN_THE_ARM
)
def test_a_contradiction_is_refused(
    tmp_path: Path, old: str, new: str, line: int, sentence: str, others: tuple[str, str] | None
) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(spoiled(old, new), encoding="utf-8")
    with pytest.raises(RobotError, match=sentence) as caught:
        robots.load(path, base="foot", tip="lower")
    message = str(caught.value)
    assert str(path) in message
    assert re.search(rf"\bline {line}\b", message), message
    assert message.endswith(".")
    assert "\n" not in message
    assert message.count("Expected") == 1
    if others:
        assert robots.load(path, base=others[0], tip=others[1]).n == 1


def test_nothing_at_all() -> None:
    for text, sentence in (("", "no element found"), ("arm", "syntax error"), (b"\xff\xfe\x00", "Expected XML")):
        with pytest.raises(RobotError, match=sentence):
            urdf.parse(text)
    with pytest.raises(RobotError, match="Expected at least one link in the URDF text, got no links"):
        urdf.parse('<robot name="a"/>')
    with pytest.raises(RobotError, match=r"one moving branch .* got none"):
        urdf.parse('<robot name="a"><link name="b"/></robot>').chain()


def test_entities_cannot_grow_and_files_cannot_be_opened() -> None:
    bomb = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(20))
    outside = '<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/hostname">]><robot name="&a;"><link name="b"/></robot>'
    for text in (f'<!DOCTYPE robot [<!ENTITY a0 "ha">{bomb}]><robot name="&a20;"/>', outside):
        with pytest.raises(RobotError, match="XML without a document type"):
            urdf.parse(text)


def test_depth_is_bounded() -> None:
    with pytest.raises(RobotError, match="Expected elements nested at most 64 deep"):
        urdf.parse('<robot name="a">' + "<a>" * 1000)


def test_long_and_wide_trees() -> None:
    """No recursion, and no noticeable quadratic cost."""
    n = 1000
    links = "".join(f'<link name="l{i}"/>' for i in range(n))
    long = "".join(LOOSE.format(f"l{i}", f"l{i + 1}").replace('"j"', f'"j{i}"') for i in range(n - 2))
    wide = "".join(LOOSE.format("l0", f"l{i + 1}").replace('"j"', f'"j{i}"') for i in range(n - 2))
    last = LOOSE.format(f"l{n - 2}", f"l{n - 1}").replace("fixed", "continuous")
    for joints in (long, wide):
        robot = urdf.parse(f'<robot name="r">{links}{joints}{last}</robot>').chain()
        assert robot.n == 1


@pytest.mark.parametrize(("links", "moving", "words"), [(2001, 1, "at most 2000 links"), (40, 33, "at most 32 joints")])
def test_more_parts_than_any_robot_has(links: int, moving: int, words: str) -> None:
    parts = "".join(f'<link name="l{i}"/>' for i in range(links))
    for i in range(links - 1):
        kind = "continuous" if i < moving else "fixed"
        parts += LOOSE.format(f"l{i}", f"l{i + 1}").replace('"j"', f'"j{i}"').replace("fixed", kind)
    with pytest.raises(RobotError, match=words):
        urdf.parse(f'<robot name="r">{parts}</robot>').chain(tip=f"l{links - 1}")


def survives(text: str | bytes) -> None:
    """Reading gives a robot or an armlab error."""
    sentence = "."
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Expected (principal moments|revolute limits|a nonzero mass for)")
        try:
            tree = urdf.parse(text)
            for base in ("foot", "lower", None):
                robot = tree.chain(base, None if base is None else "upper")
                assert isinstance(robot, Robot)
                assert isinstance(robot.hash, str)
        except ArmlabError as error:
            sentence = str(error)
    assert sentence.endswith((".", "?"))


NUMBERS = [match.span() for match in re.finditer(r'(?<=[ "])-?[\d.]+(?=[ "])', ARM)]


number_like = st.floats().map(repr) | st.integers().map(str) | st.text("0123456789.e+-_naif ", max_size=12)


@settings(max_examples=100)
@given(st.lists(st.tuples(st.sampled_from(NUMBERS), number_like), min_size=1, max_size=4))
def test_fuzz_numbers(changes: list[tuple[tuple[int, int], str]]) -> None:
    text = ARM
    for (begin, end), word in sorted(dict(changes).items(), reverse=True):
        text = text[:begin] + word + text[end:]
    survives(text)


def test_a_directory_is_no_urdf(tmp_path: Path) -> None:
    folder = tmp_path / "folder.urdf"
    folder.mkdir()
    with pytest.raises(RobotError, match=r"Expected a URDF file at .*folder\.urdf, got"):
        robots.load(folder)


def test_questions_about_what_is_not_there() -> None:
    tree = urdf.parse(ARM)
    with pytest.raises(UnknownName, match="link of the URDF text, got 'hand'"):
        tree.tips_below("hand")
    with pytest.raises(RobotError, match="Expected names of joints of the URDF text to be a list or tuple, got 'turn'"):
        tree.mimic("turn")
    with pytest.raises(ShapeError, match="Expected positions of the free joints to be real numbers, got 'x'"):
        tree.mimic(["turn"]).positions("x")
