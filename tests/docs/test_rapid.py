"""The RAPID modules and the controller configuration shipped with armlab, as far as testable without a robot.

No RAPID compiler is available; the tests check that blocks balance, statements end, names are declared, and each
argument is one that ABB's manual 3HAC073318-001 lists for its instruction.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from armlab.bridge.rws import PROGRAMS

FOLDER = Path(__file__).parents[2] / "src/armlab/bridge/rapid"
MODULES = sorted(FOLDER.glob("*.mod"))
GUIDES = [path for path in MODULES if path.stem != "ArmlabStream"]
JOINTS = {f"J{i}" for i in range(1, 8)}
ARGUMENTS = {  # instruction -> optional arguments
    "EGMReset": set(),
    "EGMGetId": set(),
    "EGMSetupUC": {"Joint", "Pose", "CommTimeout"},
    "EGMActJoint": {"StreamStart", "Tool", "WObj", "LpFilter", "SampleRate", "MaxPosDeviation", "MaxSpeedDeviation"}
    | JOINTS,
    "EGMRunJoint": {"NoWaitCond", "CondTime", "RampInTime", "RampOutTime", "PosCorrGain"} | JOINTS,
    "EGMStreamStart": {"SampleRate"},
    "MoveAbsJ": {"NoEOffs", "WObj"},
    "WaitTime": set(),
    "TPWrite": set(),
    "TRYNEXT": set(),
    "RAISE": set(),
    "start": set(),  # an assignment
}
BLOCKS = {"MODULE": "ENDMODULE", "PROC": "ENDPROC", "WHILE": "ENDWHILE", "IF": "ENDIF"}
GIVEN = {  # declared by RAPID, the system module or the controller
    *("TRUE", "ERRNO", "ERR_UDPUC_COMM", "EGM_STOP_HOLD", "v50", "fine", "tool0"),
    *("ROB_1", "ROB_L", "ROB_R", "CJointT"),
}
DECLARATION = re.compile(r"LOCAL (?:PERS|CONST|VAR) (?:jointtarget|num|egm_minmax|egmident) (\w+)(?: := (.*))?")


def code(path: Path) -> str:
    """Return the text without comments and with empty strings."""
    lines = [re.sub(r'"[^"]*"', '""', line).partition("!")[0] for line in path.read_text(encoding="ascii").splitlines()]
    return "\n".join(lines)


def statements(path: Path) -> list[str]:
    """Return the declarations and instructions, each in one line without its semicolon."""
    text = re.sub(r"^\s*(MODULE \w+|PROC \w+\(\)|WHILE .* DO|IF .* THEN|ERROR|END\w+)\s*$", "", code(path), flags=re.M)
    *whole, rest = text.split(";")
    assert not rest.strip(), f"no semicolon after {rest.strip()!r}"
    return [" ".join(one.split()) for one in whole]


def declared(path: Path) -> dict[str, str]:
    found = [DECLARATION.fullmatch(one) for one in statements(path)]
    return {one[1]: one[2] or "" for one in found if one}


def instructions(path: Path) -> list[tuple[str, str]]:
    parts = [one.partition(" ") for one in statements(path) if not one.startswith("LOCAL")]
    return [(word, text) for word, _, text in parts]


def argument(path: Path, instruction: str, name: str) -> str:
    """Return the value of an optional argument."""
    (text,) = [text for word, text in instructions(path) if word == instruction]
    (value,) = re.findall(rf"\\{name}:=(\S+)", text)
    return declared(path).get(str(value), str(value))


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
class TestModule:
    def test_blocks_balance(self, path: Path) -> None:
        open_blocks: list[str] = []
        for line in code(path).splitlines():
            word = line.split()[0] if line.split() else ""
            if word in BLOCKS:
                open_blocks.append(BLOCKS[word])
            elif word in BLOCKS.values():
                assert open_blocks.pop() == word
        assert not open_blocks

    def test_it_begins_and_ends_as_a_module_of_its_name_with_one_main(self, path: Path) -> None:
        text = code(path)
        assert text.startswith(f"MODULE {path.stem}\n")
        assert text.rstrip().endswith("ENDMODULE")
        assert re.findall(r"PROC (\w+)\(\)", text) == ["main"]
        assert len(path.stem) <= 16

    def test_every_statement_is_known_with_arguments_of_the_manual(self, path: Path) -> None:
        for word, text in instructions(path):
            assert word in ARGUMENTS, word
            assert set(re.findall(r"\\(\w+)", text)) <= ARGUMENTS[word], text
        assert len(instructions(path)) + len(declared(path)) == len(statements(path))

    def test_names_are_declared_and_used(self, path: Path) -> None:
        body = "\n".join(text for _, text in instructions(path))
        conditions = " ".join(re.findall(r"(?:WHILE|IF) (.*?) (?:DO|THEN)", code(path)))
        used = set(re.findall(r"(?<![\\\w.])[A-Za-z]\w*", f"{body} {conditions}"))
        assert used <= GIVEN | declared(path).keys()
        assert declared(path).keys() <= used

    def test_lines_fit_the_pendant_and_say_that_nobody_has_tried_it(self, path: Path) -> None:
        text = path.read_text(encoding="ascii")
        assert "not yet tested on a" in text
        assert max(map(len, text.splitlines())) <= 120
        assert "\t" not in text
        assert all(len(said) <= 80 for said in re.findall(r'TPWrite "(.*)"', text))

    def test_its_device_and_configuration_exist(self, path: Path) -> None:
        text = path.read_text(encoding="ascii")
        ((unit, configuration, device),) = re.findall(r'^ *EGMSetupUC (\w+), guide, "(\w+)", "(\w+)"', text, re.M)
        assert f'-name "{configuration}"' in (FOLDER / "armlab_MOC.cfg").read_text(encoding="ascii")
        ports = {"ROB_1": ("armlab", 6510), "ROB_L": ("armlab_l", 6511), "ROB_R": ("armlab_r", 6512)}
        assert ports[unit][0] == device
        devices = (FOLDER / "armlab_SIO.cfg").read_text(encoding="ascii")
        assert re.search(rf'-Name "{device}" -Type "UDPUC" .* -RemotePortNumber {ports[unit][1]}\n', devices)


@pytest.mark.parametrize("path", GUIDES, ids=lambda path: path.stem)
def test_guidance(path: Path) -> None:
    """In the manual's order; faster than ABB's default; it does not end at rest, ends soon without answers, begins
    again."""
    words = [word for word, _ in instructions(path) if word.startswith(("EGM", "Move"))]
    assert words == ["MoveAbsJ", "EGMReset", "EGMGetId", "EGMSetupUC", "EGMActJoint", "EGMRunJoint"]
    axes = {f"J{i}" for i in range(1, 7 if path.stem == "ArmlabJoint" else 8)}
    assert {argument(path, "EGMActJoint", axis) for axis in axes} == {"[0, 0]"}
    (run,) = [text for word, text in instructions(path) if word == "EGMRunJoint"]
    assert set(re.findall(r"\\(J\d)", run)) == axes
    assert "NoWaitCond" not in run
    assert "EGM_STOP_HOLD" in run
    assert float(argument(path, "EGMSetupUC", "CommTimeout")) == 0.2
    assert float(argument(path, "EGMRunJoint", "CondTime")) == 3600
    assert float(argument(path, "EGMRunJoint", "PosCorrGain")) == 1
    assert float(argument(path, "EGMActJoint", "MaxSpeedDeviation")) > 1
    assert float(argument(path, "EGMActJoint", "SampleRate")) == 4
    handler = code(path).partition("ERROR")[2]
    assert "ERRNO = ERR_UDPUC_COMM" in handler
    assert "TRYNEXT" in handler


@pytest.mark.parametrize("path", GUIDES, ids=lambda path: path.stem)
def test_guidance_begins_where_the_arm_is(path: Path) -> None:
    """A program that a computer starts moves nothing by itself."""
    first, second, *_ = instructions(path)
    assert first == ("start", ":= CJointT()")
    assert second == ("MoveAbsJ", "start, v50, fine, tool0")


def test_the_modules_are_those_of_armlab_abb() -> None:
    found = {re.search(r'"(\w+)" \\Joint', path.read_text(encoding="ascii"))[1]: path.stem for path in GUIDES}  # type: ignore[index]
    assert {device: module for module, device in PROGRAMS.values()} == found


def test_the_configuration_is_two_files_of_instances() -> None:
    for kind, section in (("MOC", "EXT_MOTION_DATA"), ("SIO", "COM_TRP")):
        first, hash_, name, *lines = (FOLDER / f"armlab_{kind}.cfg").read_text(encoding="ascii").splitlines()
        assert (first, hash_, name) == (f"{kind}:CFG_1.0:6:0::", "#", f"{section}:")
        joined = " ".join(line.removesuffix("\\") for line in lines)
        assert re.fullmatch(r'(?:\s+-\w+(?: (?:"[\w.]+"|[\d.]+))?)+\s*', joined)
    motion = (FOLDER / "armlab_MOC.cfg").read_text(encoding="ascii")
    recommended = motion.partition('"armlab"')[2].partition("-name")[0]
    assert "-ext_motion_level 0" in recommended
    assert "-ext_motion_Kp 20" in recommended
    assert "-ext_motion_filter_bandwidth 100" in recommended
