"""Every example runs and prints something: long ones in a separate process, as a reader would run them; short ones
here, where their imports are already loaded."""

from __future__ import annotations

import ast
import os
import re
import runpy
import subprocess
import sys
from contextlib import chdir, redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

from armlab.motion import TwoDofDmp
from armlab.sim import two_link

ROOT = Path(__file__).parents[2]
EXAMPLES = {path.name: path for path in sorted((ROOT / "examples").glob("*.py"))}
NEEDS = {  # example -> the one whose files it reads, and one of these files
    "04_contact_force.py": ("03_identify.py", "model.toml"),
    "14_hand_guiding.py": ("03_identify.py", "model.toml"),
    "16_stop_on_contact.py": ("03_identify.py", "model.toml"),
    "37_constant_force.py": ("03_identify.py", "model.toml"),
    "05_look_at_a_log.py": ("02_move_a_simulated_arm.py", "sine.mcap"),
}
LONG = (
    *("03_identify.py", "04_contact_force.py", "12_source_report.py", "15_lead_through.py", "16_stop_on_contact.py"),
    *("26_hold_and_recover.py", "27_both_arms_wait.py", "31_turned_goal.py", "32_wiping.py"),
)
SLOW = {
    *LONG, "02_move_a_simulated_arm.py", "05_look_at_a_log.py", "10_draw_an_arm.py", "14_hand_guiding.py",
    "17_impedance.py", "18_sensor_in_the_loop.py", "19_teleoperation.py", "22_calibrate_force_sensor.py",
    "23_calibrate_kinematics.py", "24_calibrate_laser.py", "25_profiles.py", "28_two_link.py", "35_many_logs.py",
    "37_constant_force.py", "38_weigh.py", "39_carry_with_two_arms.py",
}  # fmt: skip
LONGEST = 120  # s, generous for a busy machine; each takes less than 30 s on a quiet one
MAX_LINES = 40
PRINTED: dict[tuple[Path, str], str] = {}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("examples")


def run(name: str, folder: Path) -> str:
    """Run an example after the one it depends on, once for all tests, and return its output."""
    if (folder, name) not in PRINTED:
        if name in NEEDS and not (folder / NEEDS[name][1]).exists():
            run(NEEDS[name][0], folder)
        PRINTED[folder, name] = (run_file if name in LONG else run_here)(EXAMPLES[name], folder)
    return PRINTED[folder, name]


def run_here(path: Path, folder: Path) -> str:
    """Run a file in this process, in a separate namespace."""
    with chdir(folder), redirect_stdout(StringIO()) as printed:
        runpy.run_path(str(path), run_name="__main__")
    return printed.getvalue()


def run_file(path: Path, folder: Path) -> str:
    environment = {**os.environ, "MPLBACKEND": "agg", "PYTHONWARNINGS": "error"}
    done = subprocess.run(
        [sys.executable, path],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=LONGEST,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in SLOW else ()) for n in EXAMPLES])
def test_example_runs(name: str, folder: Path) -> None:
    printed = run(name, folder)
    assert printed.strip()
    assert "nan" not in printed.lower()


@pytest.mark.slow
def test_the_errors_on_the_page_are_those_of_the_example(folder: Path) -> None:
    """The accuracy on the page about contact forces matches the output of 12_source_report.py, up to rounding."""
    number = r"(\d\.\d\d)"
    printed = re.findall(rf"{number} {number} {number} N RMS, (\d+) %", run("12_source_report.py", folder))
    page = (ROOT / "docs" / "how_to" / "contact_force.md").read_text(encoding="utf-8")
    written = re.findall(rf"\| {number}, {number}, {number} \| (\d+) % \|", page)
    assert len(printed) == len(written) == 4
    for found, said in zip(printed, written, strict=True):
        assert [float(x) for x in found[:3]] == pytest.approx([float(x) for x in said[:3]], abs=0.05)
        assert int(found[3]) == pytest.approx(int(said[3]), abs=2)


@pytest.mark.slow
def test_the_program_of_the_readme_runs(folder: Path) -> None:
    """As printed there, but in lockstep and for two seconds."""
    program = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert program
    text = program[1].replace("sim://yumi_right", "sim://yumi_right?lockstep=true").replace("seconds=10", "seconds=2")
    assert "lockstep" in text
    assert "seconds=2" in text
    if not (folder / "model.toml").exists():
        run("03_identify.py", folder)
    path = folder / "readme.py"
    path.write_text(text, encoding="utf-8")
    assert "the time is up" in run_file(path, folder)


def test_examples_are_short_say_what_they_do_and_are_on_a_page() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").rglob("*.md"))
    for name, path in EXAMPLES.items():
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= MAX_LINES, name
        assert ast.get_docstring(ast.parse(text)), name
        assert f"examples/{name}" in pages, "show it with literalinclude"


def test_numbers_have_no_holes() -> None:
    numbers = [int(name[:2]) for name in EXAMPLES]
    assert numbers == list(range(1, len(EXAMPLES) + 1))


def test_the_arm_repeats_is_pushed_and_arrives(capsys: pytest.CaptureFixture[str]) -> None:
    program = runpy.run_path(str(EXAMPLES["28_two_link.py"]))
    assert (program["motion"].TwoDofDmp, program["two_link"]) == (TwoDofDmp, two_link)
    program["main"]()
    repeated, pushed, end = (float(x) for x in re.findall(r"([\d.]+) mm", capsys.readouterr().out))
    assert repeated < 1.0
    assert pushed > 50.0
    assert end < 0.1
    np.testing.assert_allclose(two_link.forward(two_link.inverse(program["POINTS"])), program["POINTS"], atol=1e-12)
