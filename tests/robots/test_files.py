"""Robot files: round trip to the last bit, the format, and an error message for every possible fault."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from armlab import robots
from armlab.errors import MissingExtra, RobotError, UnknownName
from armlab.lie import quaternion, se3
from armlab.robots import Mesh, Robot, inertia
from armlab.robots.build import Details

MINIMAL = """
name = "mine"
source = "measured"
joint = [
  { name = "shoulder", alpha_deg = 90, a = 0.1, d = 0.2, limits_deg = [-90, 90], speed_deg = 100 },
  { name = "elbow", a = 0.3, offset_deg = 45 },
]
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def assert_same_bits(a: Robot, b: Robot) -> None:
    assert a == b
    assert a.hash == b.hash
    assert a.frames.tobytes() == b.frames.tobytes()
    assert a.q_min.tobytes() == b.q_min.tobytes()


def test_an_unknown_name_lists_what_exists() -> None:
    assert robots.names() == tuple(sorted(robots.names()))
    assert robots.load("irb2400") is robots.load("irb2400")
    with pytest.raises(UnknownName) as caught:
        robots.load("yumi_rigth")
    assert str(caught.value) == (
        "Expected the name of a robot, got 'yumi_rigth'. "
        f"Known: {', '.join(robots.names())}. Did you mean 'yumi_right'?"
    )


def test_load_a_file_of_the_user(tmp_path: Path) -> None:
    path = written(tmp_path, MINIMAL)
    robot = robots.load(path)
    assert robot == robots.load(str(path))
    expected = robots.from_dh(
        "mine", [np.pi / 2, 0], [0.1, 0.3], [0.2, 0], [0, np.pi / 4],
        q_min=[-np.pi / 2, -np.inf], q_max=[np.pi / 2, np.inf], qd_max=[np.deg2rad(100), np.inf],
        joint_names=["shoulder", "elbow"], source="measured",
    )  # fmt: skip
    assert_same_bits(robot, expected)


def test_the_text_alone_for_who_has_no_file() -> None:
    robot = robots.load("yumi_left")
    assert_same_bits(robots.from_toml(robots.to_toml(robot), "a feed"), robot)
    with pytest.raises(RobotError, match="Expected a robot file in a feed, got a file that cannot be read"):
        robots.from_toml(robots.to_toml(robot) + "[more]\n", "a feed")
    with pytest.raises(RobotError, match="Expected a Robot"):
        robots.to_toml("yumi_left")  # type: ignore[arg-type]


def test_everything_a_file_may_say(tmp_path: Path) -> None:
    text = """
name = "all"
side = "right"
convention = "modified"
gravity = [0, 9.81, 0]
abb_axes = [2, 1]
joint = [
  { name = "lift", kind = "prismatic", limits = [0, 0.5], speed = 0.2, acceleration = 1, home = 0.1, gear_ratio = 50 },
  { name = "turn", alpha_deg = -90, limits_deg = [10, 90], speed_deg = 90, acceleration_deg = 180 },
]
[mount]
position = [1, 2, 3]
quaternion = [0.7071, 0.7071, 0, 0]
[tool]
position = [0, 0, 0.1]
rotation = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
[source]
geometry = "CAD"
limits = "assumption"
"""
    rows = """
inertias = [[1, 0, 0, 0.1, 2, 0, 2, 0, 0, 1], [0, 0, 0, 0, 0, 0, 0, 0, 0, 0]]
mesh = [
  { link = 0, file = "package://maker/foot.stl" },
  { link = 2, file = "hand.obj", kind = "collision", position = [0, 0, 1], scale = [0.001, 0.001, 0.001] },
]
[mount]"""
    text = text.replace("\n[mount]", rows).replace("gear_ratio = 50", "gear_ratio = 50, effort = 100")
    robot = robots.load(written(tmp_path, text))
    np.testing.assert_array_equal(robot.prismatic, [True, False])
    np.testing.assert_allclose(robot.q_home, [0.1, np.deg2rad(10)])
    np.testing.assert_allclose(robot.qdd_max, [1, np.pi])
    np.testing.assert_allclose(robot.coupling, np.diag([1 / 50, 1]))
    np.testing.assert_allclose(robot.T_base_mount[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(robot.T_flange_tool[:3], [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0.1]])
    np.testing.assert_array_equal(robot.gravity, [0, 9.81, 0])
    assert (robot.abb_axes, robot.side) == ((2, 1), "right")
    np.testing.assert_array_equal(robot.tau_max, [100, np.inf])
    np.testing.assert_array_equal(robot.inertias, [[1, 0, 0, 0.1, 2, 0, 2, 0, 0, 1], [0] * 10])
    foot = Mesh("visual", "package://maker/foot.stl", np.eye(4), np.ones(3))
    hand = Mesh("collision", "hand.obj", se3.from_rp(np.eye(3), [0, 0, 1]), np.full(3, 0.001))
    assert robot.meshes == ((foot,), (), (hand,))
    assert robot.source == "geometry: CAD\nlimits: assumption"


def test_a_typed_rotation_gets_its_missing_digits_back(tmp_path: Path) -> None:
    R = np.round(quaternion.to_matrix([0.8, 0.36, 0.48, 0.0]) @ quaternion.to_matrix([0.28, 0.96, 0, 0]), 6)
    robot = robots.load(written(tmp_path, MINIMAL + f"[tool]\nrotation = {R.tolist()}\n"))
    assert se3.is_pose(robot.T_flange_tool, 1e-15)
    np.testing.assert_allclose(robot.T_flange_tool[:3, :3], R, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["dh_test", "fr3", "irb2400", "ur5e", "yumi_left", "yumi_right_urdf"])
def test_the_library_survives_a_round_trip(tmp_path: Path, name: str) -> None:
    path = tmp_path / f"{name}.toml"
    robots.save(robots.load(name), path)
    assert_same_bits(robots.load(path), robots.load(name))
    text = path.read_text(encoding="utf-8")
    assert "next" not in text, "a DH robot is written as DH rows"
    row = (
        '  { name = "axis_5", alpha_deg = 90, a = -0.027, d = 0, offset_deg = 0, limits_deg = [-88, 138], '
        "speed_deg = 400, home_deg = 40, gear_ratio = -101 },"
    )
    assert row in text.splitlines() or name != "yumi_left", "pleasant to read"


finite = st.floats(-10, 10)
positive = st.floats(1e-3, 1e3)
words = st.text(max_size=20)
names = words.filter(str.strip)


def any_mesh(rng: np.random.Generator, word: str) -> Mesh:
    scale = rng.standard_normal(3) if rng.random() < 0.5 else np.ones(3)
    kind = "visual" if rng.random() < 0.5 else "collision"
    return Mesh(kind, f"package://{word}", se3.exp(rng.standard_normal(6)), scale)


@st.composite
def any_robot(draw: st.DrawFn) -> Robot:
    n = draw(st.integers(1, 4))
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    low = np.array(draw(st.lists(finite | st.just(-np.inf), min_size=n, max_size=n)))
    prismatic = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)))
    details: Details = {
        "q_min": low,
        "q_max": np.where(np.isfinite(low), low, 0.0) + draw(st.lists(positive, min_size=n, max_size=n)),
        "qd_max": draw(st.lists(positive, min_size=n, max_size=n)),
        "joint_names": draw(st.lists(names, min_size=n, max_size=n, unique=True)),
        "gravity": draw(st.sampled_from([(0, 0, -9.80665), (0.1, 9.7, -1 / 3)])),
        "coupling": draw(st.sampled_from([np.eye(n), np.diag([-1 / 101] * n), np.eye(n) + np.tri(n) / 3])),
        "abb_axes": list(rng.permutation(n) + 1),
        "side": draw(st.sampled_from(["left", "right", ""])),
        "source": draw(words | st.just("geometry: CAD\nlimits: none") | st.just("geometry: CAD\nno key")),
    }
    if draw(st.booleans()):
        details["qdd_max"] = draw(st.lists(positive, min_size=n, max_size=n))
    if draw(st.booleans()):
        details |= {"T_base_mount": se3.exp(rng.standard_normal(6)), "T_flange_tool": se3.exp(rng.standard_normal(6))}
    if draw(st.booleans()):
        details["tau_max"] = draw(st.lists(positive | st.just(np.inf), min_size=n, max_size=n))
    if draw(st.booleans()):
        squares = rng.standard_normal((n, 3, 3))
        body = rng.uniform(0.1, 9, n), rng.standard_normal((n, 3)), squares @ squares.swapaxes(1, 2)
        details["inertias"] = inertia.from_body(*body)
    if draw(st.booleans()):
        details["meshes"] = [[any_mesh(rng, draw(words)) for _ in range(rng.integers(3))] for _ in range(n + 1)]
    name = draw(names)
    if draw(st.booleans()):
        return robots.from_links(name, se3.exp(rng.standard_normal((n + 1, 6))), prismatic, **details)
    table = rng.standard_normal((4, n)) if draw(st.booleans()) else np.deg2rad(rng.integers(-180, 180, (4, n)))
    return robots.from_dh(name, *table, prismatic=prismatic, modified=draw(st.booleans()), **details)


@pytest.mark.filterwarnings("ignore:Expected revolute limits")
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(robot=any_robot())
def test_any_robot_survives_a_round_trip(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "robot.toml"
    robots.save(robot, path)
    assert_same_bits(robots.load(path), robot)


@pytest.mark.parametrize(("old", "new", "sentence"), [
    ("limits_deg = [-90, 90]", "limits_deg = [90, -90]", r"q_min below q_max at joint 1 \(shoulder\) of robot"),
    ("a = 0.1", "a = nan", "Expected finite a in the DH table of 'mine', got nan at joint 1."),
    ("speed_deg = 100", "speed_deg = nan", r"Expected numbers in qd_max of robot 'mine', got NaN at joint 1"),
    ("speed_deg = 100", "speed_deg = -1", "Expected a positive speed limit at joint 1"),
    ("speed_deg = 100", "home_deg = 100", "Expected a home position inside the limits at joint 1"),
    ("alpha_deg = 90", "alhpa_deg = 90", r"unknown field `alhpa_deg` - at `\$\.joint\[0\]`"),
    ("alpha_deg = 90", "alpha_deg = 90, alpha = 1.5", "either alpha or alpha_deg, got both in 'shoulder'"),
    ("alpha_deg = 90", 'alpha_deg = "90"', r"Expected `float`, got `str` - at `\$\.joint\[0\]\.alpha_deg`"),
    ("limits_deg = [-90, 90]", "limits_deg = [-90]", r"of length 2, got 1 - at `\$\.joint\[0\]\.limits_deg`"),
    ("limits_deg = [-90, 90]", 'limits_deg = ["a", 90]', r"got `str` - at `\$\.joint\[0\]\.limits_deg\[0\]`"),
    ("limits_deg = [-90, 90]", "limits = [-1.5]", r"at `\$\.joint\[0\]\.limits`"),
    ('"mine"', '""', "Expected a name in name of robot '', got ''"),
    ('"elbow"', '" "', "Expected a name in joint_names of robot 'mine', got ' '"),
    ("alpha_deg = 90", 'kind = "sliding"', r"Invalid enum value 'sliding' - at `\$\.joint\[0\]\.kind`"),
    ('{ name = "elbow", ', "{ ", r"missing required field `name` - at `\$\.joint\[1\]`"),
    ("elbow", "shoulder", "Expected 2 different joint_names"),
    ('source = "measured"', "", "missing required field `source`"),
    ('name = "mine"', 'name = "mine"\nabb_axes = [1, 2, 3]', "Expected 2 different abb_axes"),
    ('name = "mine"', 'name = "mine"\ncoupling = [[1]]', "Expected 2 numbers in every row of coupling, got"),
    ('name = "mine"', 'name = "mine"\ncoupling = [[1, 0], [1, 0]]', "full-rank coupling for robot"),
    ('name = "mine"', 'name = "mine"\nfirst = {}', "Expected `first` only together with `next`"),
    ('name = "mine"', 'name = "mine"\nmount = { rotation = [[1, 0, 0], [0, 2, 0], [0, 0, 1]] }',
     "pose in mount.*rotat"),
    ('name = "mine"', 'name = "mine"\nmount = { quaternion = [1, 1, 0, 0] }', "pose in mount.* length 1"),
    ('name = "mine"', 'name = "mine"\ntool = { position = [1, 2] }', r"at `\$\.tool\.position`"),
    ('name = "mine"', 'name = "mine"\ntool = { position = [1, 2, nan] }', "Expected numbers in T_flange_tool"),
    ("alpha_deg = 90", "effort = 0", r"Expected a positive torque limit at joint 1 \(shoulder\)"),
    ("alpha_deg = 90", "a_deg = 90", r"unknown field `a_deg` - at `\$\.joint\[0\]`"),
    ('name = "mine"', 'name = "mine"\ninertias = [[1, 2]]', r"at `\$\.inertias\[0\]`"),
    ('name = "mine"', f'name = "mine"\ninertias = [{[1] + [0] * 9}]', r"inertias .* to have shape \(2, 10\),"),
    ('name = "mine"', f'name = "mine"\ninertias = {[[-1] + [0] * 9] * 2}', "inertia of link 1 .* mass of -1 kg"),
    ('name = "mine"', 'name = "mine"\nmesh = [{ link = 3, file = "a" }]', "mesh 'a' on a link from 0 .* to 2, got 3"),
    ('name = "mine"', 'name = "mine"\nmesh = [{ link = 1, file = "" }]', "file name of a mesh, got ''"),
    ('name = "mine"', 'name = "mine"\nmesh = [{ link = 1 }]', r"missing required field `file` - at"),
    ("alpha_deg = 90", "gear_ratio = 0", "Expected a gear_ratio other than zero, got 0 in joint 'shoulder'"),
    ("alpha_deg = 90, ", 'kind = "prismatic", ', "Expected metres for the prismatic joint 'shoulder', got limits_deg"),
    ("offset_deg = 45", 'kind = "prismatic", acceleration_deg = 9', "'elbow', got acceleration_deg"),
    ("offset_deg = 45", "next = {}", "in all joints, got a mixture at 'shoulder'"),
    ("joint = [", "joint = [ 1,", r"Expected `object`, got `int` - at `\$\.joint\[0\]`"),
    ("joint = [", "joint = ", "Expected a robot file in"),
    ('name = "mine"',
     'name = "mine"\ntool = { quaternion = [1, 0, 0, 0], rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]] }',
     "Expected either quaternion or rotation in tool, got both"),
])  # fmt: skip
def test_a_bad_file_is_one_sentence_with_its_path(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    assert old in MINIMAL
    path = written(tmp_path, MINIMAL.replace(old, new, 1))
    with pytest.raises(RobotError, match=sentence) as caught:
        robots.load(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert message.endswith(".")


def test_files_that_cannot_be_read_or_written(tmp_path: Path) -> None:
    robot = robots.load("dh_test")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    text = MINIMAL.replace("a = 0.1", "a = 0.1, gear_ratio = 2").replace("name", "coupling = [[1, 0], [0, 1]]\nname", 1)
    before = [*tmp_path.iterdir()]
    for words, call in (
        (r"robot file at .*absent\.toml, got: .*No such file", lambda: robots.load(tmp_path / "absent.toml")),
        (r"Expected a robot file at .*binary\.toml", lambda: robots.load(tmp_path / "binary.toml")),
        ("Expected a robot file", lambda: robots.load("a\0b.toml")),
        (r"Expected a path that ends in \.toml or \.urdf for robot 'dh_test'",
         lambda: robots.save(robot, tmp_path / "robot.txt")),
        ("Expected a writable path for robot 'dh_test', got ",
         lambda: robots.save(robot, tmp_path / "absent" / "robot.toml")),
        ("Expected a writable path for robot",
         lambda: robots.save(replace(robot, source="\ud800"), tmp_path / "arm.toml")),
        ("at least one joint, got none", lambda: robots.from_toml('name = "none"\nsource = ""\njoint = []\n', "a")),
        ("Expected gears either as coupling or as gear_ratio, got both", lambda: robots.from_toml(text, "a text")),
        *((r"Expected a robot file in huge, got a file that cannot be read: ",
           lambda x=x: robots.from_toml(MINIMAL.replace("offset_deg = 45", f"home_deg = {x}"), "huge"))
          for x in ("1" + 400 * "0", "1" + 5000 * "0", 3000 * "[" + 3000 * "]")),
    ):  # fmt: skip
        with pytest.raises(RobotError, match=words):
            call()
    assert [*tmp_path.iterdir()] == before


def test_files_of_windows(tmp_path: Path) -> None:
    """A byte-order mark, carriage returns, an upper-case extension."""
    robot = robots.load("irb120")
    robots.save(robot, tmp_path / "plain.toml")
    text = (tmp_path / "plain.toml").read_text(encoding="utf-8").replace("\n", "\r\n")
    (tmp_path / "ARM.TOML").write_bytes(text.encode("utf-8-sig"))
    assert robots.load(tmp_path / "ARM.TOML") == robot


def test_names_of_robot_descriptions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """A stand-in package, so that the network is not used."""
    robots.save(robots.load("ur5e"), tmp_path / "toy.urdf")
    package = tmp_path / "robot_descriptions"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "toy_description.py").write_text(f"print('Cloning')\nURDF_PATH = {str(tmp_path / 'toy.urdf')!r}")
    (package / "far_description.py").write_text("raise OSError('no network')")
    (package / "other_description.py").write_text("MJCF_PATH = 'other.xml'")
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.partition(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name)
    assert robots.load("toy_description").n == 6
    assert robots.load("toy_description", tip="flange").n == 6
    assert capsys.readouterr() == ("", "Cloning\n")  # only results go to stdout
    for name, words in (
        ("far", "no network. The first use of a description needs network access"),
        ("other", "URDF of other_description"),
    ):
        with pytest.raises(RobotError, match=words):
            robots.load(f"{name}_description")
    with pytest.raises(UnknownName, match="tyo_description"):
        robots.load("tyo_description")
    for name in [name for name in sys.modules if name.partition(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    with pytest.raises(MissingExtra, match=r"armlab\[robots\]"):
        robots.load("toy_description")
