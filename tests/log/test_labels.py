"""Names of columns in other tools' logs."""

from __future__ import annotations

from armlab.log.column import OLD_NAMES, alias, natural_key


def test_aliases_are_those_of_the_old_tools() -> None:
    assert alias("irb2ext.robot[0].joint[2].posRawAbs") == "irb2ext_robot_0__joint_2__posRawAbs"
    assert alias("sample:value[3]") == "sample_value_3"


def test_natural_order() -> None:
    names = ["q10", "q9", "q1", "p2", "q", "2q"]
    assert sorted(names, key=natural_key) == ["2q", "p2", "q", "q1", "q9", "q10"]


def test_names_of_the_ancestors_logs() -> None:
    assert (OLD_NAMES["pos"], OLD_NAMES["trq_o"], OLD_NAMES["timestamp"]) == ("q", "tau_ref", "t")
