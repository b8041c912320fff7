"""Columns of other programs: real header lines, presets, factors and units, files without a header."""

from contextlib import suppress

import numpy as np
import pytest

from armlab import log, robots
from armlab.errors import ArmlabError, ConfigError, LogError, UnknownName
from armlab.log.file_formats.column_names import ColumnNames

RTDE = [f"{name}_{k}" for name in ("target_q", "target_qd", "target_current", "target_moment", "actual_q", "actual_qd",
                                   "actual_current", "actual_TCP_pose") for k in range(6)]  # fmt: skip
FRANKA = ["time", "success_rate"]
FRANKA += [f"{name}[{k}]" for name in ("state.q", "state.q_d", "state.dq", "state.dq_d", "state.tau_J",
           "state.tau_ext_hat_filtered", "cmd.q_d", "cmd.dq_d") for k in range(7)]  # fmt: skip
FRANKA += [f"cmd.O_T_EE_d[{k}]" for k in range(16)] + [f"cmd.tau_J_d[{k}]" for k in range(7)]
EGM = ["TIMESTAMP"] + [f"{one}_{axis}J{k}" for one in ("R_FB_POS", "R_FB_VEL", "R_PL_POS", "S_REF_POS")
                       for axis in "RE" for k in range(1, 7)]  # fmt: skip
ROSTOPIC = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id"]
ROSTOPIC += [f"field.{name}{k}" for name in ("name", "position", "velocity", "effort") for k in range(6)]
UR_DRIVER = ["elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint", "wrist_1_joint", "wrist_2_joint",
             "wrist_3_joint"]  # fmt: skip


def rows(width: int, count: int = 20) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, width))


def write(path, header, values, separator=","):
    lines = [separator.join(header)] if header else []
    path.write_text("\n".join([*lines, *(separator.join(map(str, row)) for row in values), ""]))
    return path


def at(header, name, count, first=0):
    start = header.index(name.format(first))
    return slice(start, start + count)


def test_a_recording_of_rtde_is_read_by_its_preset_and_torque_follows_from_the_moments(tmp_path) -> None:
    header, values = ["timestamp", *RTDE], rows(1 + len(RTDE), 400)
    constants = np.array([13.0, 12.0, 11.0, 9.0, 8.0, 7.0])
    values[:, 0] = 1.7e9 + 0.002 * np.arange(400)
    moment, qd = values[:, at(header, "target_moment_{}", 6)], values[:, at(header, "actual_qd_{}", 6)]
    qd[:] = np.where(np.abs(qd) < 0.01, 0.01, qd)
    values[:, at(header, "target_current_{}", 6)] = (moment + 2.0 * np.sign(qd) + 0.5 * qd) / constants
    table = log.read(write(tmp_path / "ur.csv", header, values, " "), "ur")  # as the RTDE client writes it
    np.testing.assert_allclose(table.t, 0.002 * np.arange(400), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(table["q"], values[:, at(header, "actual_q_{}", 6)])
    np.testing.assert_array_equal(table["qd"], qd)
    np.testing.assert_allclose(table["tau"], values[:, at(header, "actual_current_{}", 6)] * constants, rtol=1e-9)
    assert "13, 12, 11, 9, 8, 7 N m/A" in " ".join(table.notes)
    own = log.read(tmp_path / "ur.csv", "ur,tau=actual_current_{0..5}*{1,2,3,4,5,6}")
    np.testing.assert_allclose(own["tau"], values[:, at(header, "actual_current_{}", 6)] * np.arange(1, 7))
    values[:, at(header, "target_moment_{}", 6)][:, 5] = 0.0  # of a wrist joint without load
    idle = log.read(write(tmp_path / "idle.csv", header, values), "ur")
    np.testing.assert_allclose(idle["tau"][:, 5] / values[:, at(header, "actual_current_{}", 6)][:, 5], 8.5)
    assert "joint 6" in " ".join(idle.notes)
    named = [name.replace("actual_current", "actual_current_as_torque") for name in header]
    torque = log.read(write(tmp_path / "torque.csv", named, values), "ur")
    np.testing.assert_array_equal(torque["tau"], values[:, at(named, "actual_current_as_torque_{}", 6)])


def test_currents_without_moments_are_refused_with_what_mends_it(tmp_path) -> None:
    header = ["timestamp", *(f"{name}_{k}" for name in ("actual_q", "actual_qd", "actual_current") for k in range(6))]
    values = rows(len(header))
    values[:, 0] = np.arange(20)
    with pytest.raises(LogError, match=r"currents.*target_moment.*--columns 'ur,tau=actual_current_\{0\.\.5\}\*"):
        log.read(write(tmp_path / "ur.csv", header, values), "ur")


@pytest.mark.parametrize(("preset", "header"), [("ur", ["timestamp", *RTDE]), ("franka", FRANKA), ("abb or .*7", EGM)])
def test_names_of_known_programs_are_recognised(preset, header, tmp_path) -> None:
    values = rows(len(header))
    values[:, 0] = np.arange(20)
    path = write(tmp_path / "log.csv", header, values)
    with pytest.raises(LogError, match=f"Read these column names with --columns {preset}"):
        log.read_arm(path, robots.load("ur5e"))


def test_logs_of_libfranka_and_abb_libegm_are_read_in_si(tmp_path) -> None:
    values = rows(len(FRANKA))
    values[:, 0] = 1000 + np.arange(20)
    header = FRANKA[:2] + [f" {name}" if not name.endswith("[0]") else name for name in FRANKA[2:]]
    table = log.read(write(tmp_path / "panda.csv", header, values), "franka")
    np.testing.assert_allclose(table.t, 1e-3 * np.arange(20), rtol=0, atol=1e-12)
    for name, source in (("q", "state.q"), ("qd", "state.dq"), ("tau", "state.tau_J"), ("q_ref", "state.q_d")):
        np.testing.assert_array_equal(table[name], values[:, at(FRANKA, source + "[{}]", 7)])
    place = FRANKA.index("cmd.q_d[0]")  # older libfranka: repeated names, separated by a column without numbers
    before = [" " * (not name.endswith("[0]")) + name.partition(".")[2] for name in FRANKA]
    before = ["duration", " success rate", *before[2:place], "sent commands", *before[place:]]
    lines = [[*row[:place], "", *row[place:]] for row in values]
    old = log.read(write(tmp_path / "old.csv", before, lines), "franka")
    for name in ("t", "q", "qd", "tau", "q_ref"):
        np.testing.assert_array_equal(old.t if name == "t" else old[name], table.t if name == "t" else table[name])
    values = rows(len(EGM))
    values[:, 0] = 4 * np.arange(20)
    path = write(tmp_path / "egm.csv", EGM, values)
    six, seven = log.read(path, "abb"), log.read(path, "abb7")
    np.testing.assert_allclose(six["q"], np.deg2rad(values[:, at(EGM, "R_FB_POS_RJ{}", 6, 1)]))
    np.testing.assert_allclose(six.t, 4e-3 * np.arange(20), rtol=0, atol=1e-12)
    order = [EGM.index(f"R_FB_POS_{one}") for one in ("RJ1", "RJ2", "EJ1", "RJ3", "RJ4", "RJ5", "RJ6")]
    np.testing.assert_allclose(seven["q"], np.deg2rad(values[:, order]))


@pytest.mark.parametrize("form", ["rostopic", "ros2 topic", "plotjuggler", "bagpy"])
def test_joint_states_as_csv_come_in_the_order_of_the_robot(form, tmp_path) -> None:
    ur5e, numbers = robots.load("ur5e"), rows(18)
    stamps = [1_700_000_000_000_000_000 + 8_000_000 * k for k in range(20)]
    if form == "rostopic":
        lines = [[s + 5, k, s, "base", *UR_DRIVER, *row] for k, (s, row) in enumerate(zip(stamps, numbers))]
        path = write(tmp_path / "log.csv", ROSTOPIC, lines)
    elif form == "ros2 topic":
        lines = [[s // 10**9, s % 10**9, "base", *UR_DRIVER, *row] for s, row in zip(stamps, numbers)]
        path = write(tmp_path / "log.csv", [], lines)
        with pytest.raises(LogError, match="Read a JointState with --columns ros"):
            log.read(path)
    elif form == "bagpy":
        header = ["Time", "header.seq", "header.stamp.secs", "header.stamp.nsecs", "header.frame_id"]
        header += [f"{name}_{k}" for name in ("name", "position", "velocity", "effort") for k in range(6)]
        lines = [[s / 1e9, k, s // 10**9, s % 10**9, "base", *UR_DRIVER, *row]
                 for k, (s, row) in enumerate(zip(stamps, numbers))]  # fmt: skip
        path = write(tmp_path / "log.csv", header, lines)
    else:  # all series of a bag, sorted, one row per message: cells of other topics are empty
        kinds = ("position", "velocity", "effort")
        header = [f"/joint_states/{joint}/{kind}" for kind in kinds for joint in UR_DRIVER]
        order = sorted(range(18), key=header.__getitem__)
        lines = [[f"{s / 1e9:.6f}", "", *numbers[k][order], s / 1e9] for k, s in enumerate(stamps)]
        lines += [[f"{s / 1e9 + 0.003:.6f}", 0.04, *[""] * 18, ""] for s in stamps[::3]]
        names = ["/gripper/finger/position", *np.array(header)[order], "/joint_states/header/stamp"]
        path = write(tmp_path / "log.csv", ["__time", *names], sorted(lines, key=lambda line: line[0]))
    table = log.read_arm(path, ur5e, columns="ros")
    order = [UR_DRIVER.index(name) for name in ur5e.ros_joint_names]
    np.testing.assert_allclose(table.t, 0.008 * np.arange(20), rtol=0, atol=1e-6)
    for k, name in enumerate(("q", "qd", "tau")):
        np.testing.assert_array_equal(table[name], numbers[:, 6 * k : 6 * k + 6][:, order])
    with pytest.raises(LogError, match=r"Expected the joints of irb2400.*elbow_joint.*--columns q="):
        log.read_arm(path, robots.load("irb2400"), columns="ros")


def test_columns_are_named_with_units_factors_lists_and_places(tmp_path) -> None:
    values = rows(5)
    values[:, 0] = np.arange(20)
    path = write(tmp_path / "log.csv", ["stamp", "joint_1_pos", "joint_2_pos", "current_1", "current_2"], values, ";")
    table = log.read(path, "t=stamp [ms],q=joint_{1..2}_pos [deg],tau=current_{1,2}*-2.5")
    np.testing.assert_allclose(table.t, 1e-3 * np.arange(20))
    np.testing.assert_allclose(table["q"], np.deg2rad(values[:, 1:3]))
    np.testing.assert_allclose(table["tau"], -2.5 * values[:, 3:])
    told = {"t": "stamp", "q": ["joint_2_pos", "joint_1_pos"]}
    np.testing.assert_allclose(log.read(path, told)["q"], values[:, [2, 1]])
    bare = write(tmp_path / "bare.csv", [], values)
    with pytest.raises(LogError, match=r"Expected a header.*--columns 't=1,q=\{2\.\.7\}'"):
        log.read(bare)
    np.testing.assert_array_equal(log.read(bare, "t=1,q={2..3}")["q"], values[:, 1:3])
    np.testing.assert_array_equal(log.read_csv(bare, columns="t=1,q={2..3}")["q"], values[:, 1:3])


@pytest.mark.parametrize("ending", ["csv", "h5", "parquet", "mat", "mcap"])
def test_columns_of_any_format_are_renamed(ending, tmp_path) -> None:
    arm = robots.load("ur5e")
    table = log.Table(0.004 * np.arange(50), {"q": rows(6, 50), "tau": rows(6, 50)})
    path = log.write(table, tmp_path / f"log.{ending}", arm)
    read = log.read(path, "tau=tau*-1")
    np.testing.assert_array_equal(read["tau"], -table["tau"])
    np.testing.assert_array_equal(read["q"], table["q"])


@pytest.mark.parametrize(
    ("columns", "error", "words"),
    [
        ("kuka", UnknownName, "kuka.*franka.*ur"),
        ("ur", LogError, "actual_q_.*for q of the preset ur.*got t, a, b.*--columns q="),
        ("q=joint_{1..2}", LogError, "joint_{1..2} for q .*got .*a, b"),
        ("q=", ConfigError, "NAME=SOURCE"),
        ("tau=a*0", ConfigError, "FACTOR"),
        ("tau={a,b}*{1,2,3}", ConfigError, "FACTOR"),
        ("q=a [parsec]", LogError, "parsec"),
        ("", ConfigError, "q=joint"),
        ("q=word", LogError, "Expected numbers in word"),
        ("q={*}/pos", LogError, "one topic with .*/pos, got /l and /r. .*/l/.*/pos"),
    ],
)
def test_what_does_not_map_is_refused_by_name(columns, error, words, tmp_path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,a,b,word,/l/j/pos,/r/j/pos\n0,1,2,x,1,2\n1,2,3,y,3,4\n")
    with pytest.raises(error, match=words.replace("{", r"\{").replace("..", r"\.\.")):
        log.read(path, columns)


def test_no_text_makes_another_error() -> None:
    seed = np.random.default_rng(5)
    for _ in range(2000):
        text = "".join(seed.choice(list("qt=,{}.|*[] 12/a"), size=12))
        with suppress(ArmlabError):
            ColumnNames.of(text)
