"""Every verb: its example, its line in the reference, and for every error a message, the right exit code, no traceback
and no partial file.

The table is generated from the application itself, so that new verbs and options are tested from the start.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from cyclopts import App

from armlab import cli, log, models, robots
from armlab.cli.support.options import take_robot_options
from armlab.motion import fit_dmp

NEED_NOTHING = {  # verbs without a required argument
    ("bridge", "release"), ("bridge", "resume"), ("bridge", "set"), ("bridge", "stop"),
    ("config", "show"), ("demo",), ("doctor",), ("fleet", "list"), ("fleet", "router"), ("monitor",),
    ("robot", "list"), ("view",),
}  # fmt: skip
HEAVY = (  # slow imports; help needs only cyclopts and rich
    "cvxpy", "google.protobuf", "h5py", "lz4", "matplotlib", "msgspec", "mujoco", "numpy", "pyarrow", "rosbags",
    "ruckig", "scipy", "threadpoolctl", "tomli_w", "viser", "zstandard",
)  # fmt: skip
FILES = {
    "none": None,
    "folder": None,
    "empty": b"",
    "junk": bytes(np.random.default_rng(0).integers(0, 256, 5000, np.uint8)),
    "text": b"hello\nworld\n",
    "toml": b"x = 1\n",
}
INPUTS = """
log show {}
log recover {}
log export {} new.csv
log cut {} --from 0 -o new.mcap
log resample {} --rate 250 -o new.mcap
identify yumi_left {} -o new.toml
estimate yumi_left good.csv --model {}
payload yumi_left good.csv --model {}
calibrate hand-eye {}
calibrate force-sensor {}
calibrate accelerometer {}
calibrate laser {}
calibrate kinematics yumi_left {}
calibrate dual-arm yumi_left yumi_right {}
dmp fit {} -o new.toml
dmp play {} -o new.csv
plot dmp {}
plot table {}
robot show {}
robot convert {} new.toml
bridge --config {}
config show --config {}
run yumi_left {} --no-log
run {} --no-log
record {} -o new.mcap
doctor {}
excite {} -o new.csv
excite yumi_left --saved {} -o new.csv
demo --robot {}
sim {} --to 127.0.0.1:9
sim yumi_left --to 127.0.0.1:9 --operator {}
"""
OUTPUTS = """
log export good.csv {}.csv
log cut good.mcap --from 0.5 -o {}.mcap
log resample good.mcap --rate 500 -o {}.mcap
identify yumi_left good.csv -o {}.toml
identify yumi_left good.csv -o new.toml --report {}.html
estimate yumi_left good.csv --model m.toml -o {}.csv
payload yumi_left good.csv --model m.toml --figure {}.png
calibrate hand-eye good.csv -o {}.toml
calibrate kinematics yumi_left good.csv --corrected {}.toml
dmp fit good.csv -o {}.toml
dmp play motion.toml -o {}.csv
plot dmp motion.toml -o {}.png
robot convert yumi_left {}.toml
robot show yumi_left --figure {}.png
excite yumi_left -o {}.csv
record yumi_left -o {}.mcap
"""
NUMBERS = {
    "sim yumi_left --to 127.0.0.1:9": "seed seconds phase patience loss burst external rapid-data delay pause grip",
    "run yumi_left --no-log --seconds 0.1": "speed wait",
    "run yumi_left --no-log": "seconds",
    "record yumi_left -o new.mcap": "seconds patience port",
    "doctor": "seconds port",
    "excite yumi_left -o new.csv": "seconds f0 harmonics speed acceleration seed joint noise approach",
    "monitor": "seconds",
    "fleet router": "seconds port",
    "log resample good.mcap -o new.mcap": "rate",
    "fleet record -o new": "seconds",
    "fleet list": "seconds",
    "demo": "seed",
    "dmp fit good.csv -o new.toml": "start basis kind schedule",
    "estimate yumi_left good.csv --model m.toml": "prior-force method",
}
REFUSED = """
sim yumi_rihgt --to 127.0.0.1:9 | yumi_right
sim yumi_right --to 127.0.0.1 | HOST:PORT
sim yumi_right --to 127.0.0.1:99999 | 65535
sim yumi_right --to 127.0.0.1:9,127.0.0.1:8 | got 1 robots and 2
sim yumi_right --to 127.0.0.1:9 --delay 5 | two numbers
sim yumi_right --to 127.0.0.1:9 --outgoing.loss 2 | loss
sim yumi_right --to 127.0.0.1:9 --axes 6 | got both
sim yumi_right --to 127.0.0.1:9 --fields tim | planned
sim yumi_right --to 127.0.0.1:9 --program lead-through --hand missing.csv | missing.csv
sim yumi_right --to 127.0.0.1:9 --seed 1,2 | --seed
sim yumi_right --to 127.0.0.1:9 --seed 99999999999999999999 | --seed
sim yumi_right yumi_left --to 127.0.0.1:9,127.0.0.1:8 --truth new.csv | one robot together with --truth
record -o run.mcap | Expected the name of a robot, got none
record yumi_left yumi_right --port 6511 -o run.mcap | one port per robot
record yumi_left --port egm -o run.mcap | such as --port 6511
record yumi_left -o run.csv | .mcap
record yumi_left -o good.mcap | exists
record yumi_lefft -o run.mcap | Did you mean
run yumi_left --log a --no-log | either --log or --no-log
run yumi_left --log nowhere/a | existing folder
run yumi_left --link sim://yumi_right | Expected a link to yumi_left, got sim://yumi_right, a different arm
run yumi_left --link sim://yumi_left+yumi_right | one URL per robot
doctor yumi | Did you mean
excite yumi_left | got neither
excite yumi_left -o motion.txt | .csv
excite yumi_left --run sim://yumi_right | got sim://yumi_right, a different arm
view --live yumi_left yumi_right | Expected one arm with --live, got yumi_left, yumi_right
view --live --model none.toml | Expected a model file at none.toml
view --live --package-path none | Expected --package-path with a folder, got none
view | Expected at least one log to show, got none
view --cell yumi run.mcap | Expected --cell yumi together with --live
view --live --zenoh http://host | Expected an address such as zenoh://
view --live --zenoh zenoh://host --cell a | Expected either --cell for a bridge on this computer or --zenoh
view --fleet run.mcap | Expected only --zenoh and --port with --fleet
demo --fast --robot irb1200 | no masses
sim yumi_right --to 127.0.0.1:9 --rapid-data 1 | --rapid-data from 0 to 40
sim yumi_right --to 127.0.0.1:9 --robotware 7 --rapid-data 41 | --rapid-data from 0 to 40
sim yumi_right --to 127.0.0.1:9 --grip soon | --grip
demo --fast -o folder | new folder
fleet list --router nowhere:port | Expected an address such as zenoh://
fleet record -o text | Expected a folder for the recordings, got the file text
fleet router --port 70000 | Expected a port from 0 to 65535
log export good.mcap run.xls | ends in .mcap or .csv or .mat
log export good.mcap good.csv | good.csv already exists
log cut good.mcap -o to.mcap | Expected --from S < --to S
log cut good.mcap --from 1 --to 1 -o to.mcap | or only one of them, got 1.0 and 1.0
log merge good.mcap -o to.mcap | Expected at least two recordings to merge, got 1
log open good.mcap --rerun --foxglove | got foxglove and rerun
plot wrenches | one per arm, got no log
plot wrenches good.csv good.csv | distinct names
plot scene | --cloud
plot table good.csv wrench | Known: q
plot dmp motion.toml good.csv good.csv | one demonstration
plot dmp motion.toml -o a.txt | .png
dmp fit -o x.toml | log of a motion
dmp fit good.csv -o motion.toml | --force
dmp fit good.csv -o x.toml --column speed | speed
dmp fit good.csv -o x.toml --period 2 | --kind periodic
dmp fit good.csv -o x.toml --kind pose | --robot
dmp fit good.csv -o x.toml --frame goal | --kind pose
dmp fit good.csv -o x.toml --kind periodic | Expected --period
dmp fit good.csv -o x.toml --kind rhythm | periodic
dmp fit good.csv good.csv -o x.toml --kind periodic --period 1 | Expected one log
dmp play motion.toml | --robot NAME
dmp play motion.toml --robot yumi_left --goal -9,0,0,0,0,0,0 | got -9 for joint 1
dmp play motion.toml -o x.csv --goal here | comma-separated numbers
robot convert yumi_left x.json | ends in .toml or .urdf, got x.json
robot show yumi_left --figure x.txt | ends in
calibrate hand-eye | sample files, got none
dmp play motion.toml -o x.csv --amplitude 2 | --amplitude
dmp play motion.toml -o x.csv --via now:1 | TIME:Y
dmp play robot.toml -o x.csv | a movement primitive
"""
FAILED_WORK = """
sim yumi_right --to 127.0.0.1:9 --stats missing/stats.json | missing/stats.json
sim yumi_right --to 127.0.0.1:9 --seconds 0.05 --stats /dev/full | Expected to write /dev/full, got: No space left
sim yumi_right --to 127.0.0.1:9 --seconds 0.05 --truth /dev/full | Expected to write /dev/full, got: No space left
excite yumi_left --saved none.csv --run sim://yumi_left | none.csv
log show folder | Is a directory
log cut good.mcap --from 9 -o to.mcap | got none. It contains rows from 0 s to 0.996 s
log cut good.csv --from 9 -o to.csv | The log covers 0 s to 0.996 s
log merge good.mcap good.mcap -o to.mcap | to begin after
log open good.csv | got a file of format text
plot wrench good.csv | armlab estimate ROBOT LOG
plot observability good.csv | column observability
plot poses good.csv | --robot NAME
plot latency good.csv | receive_ns
plot coverage good.csv | --model MODEL
plot two_dof motion.toml good.csv | --firm
"""
MAY_BE_INFINITE = {"seconds", "patience"}
READING = {"log", "identify", "estimate", "payload", "calibrate", "dmp", "plot", "bridge"}  # a file, not a name
NOBODY = 65534
LISTENING = """
record yumi_left --port {} -o new.mcap
run yumi_left still.py:still --link egm://127.0.0.1:{} --no-log
dmp play motion.toml --robot yumi_left --link egm://127.0.0.1:{} --log new.mcap
"""
FULL = """
log export good.csv new.csv
log cut good.mcap --from 0.5 -o new.mcap
dmp fit good.csv -o new.toml
dmp play motion.toml -o new.csv
robot convert yumi_left new.toml
robot convert yumi_left new.urdf
robot show yumi_left --figure new.png
excite yumi_left --joint 1 -o new.csv
"""


def rows(text: str) -> list[str]:
    return [line for line in text.splitlines() if line]


def verbs(app: App | None = None, before: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    app = cli.build_app() if app is None else app
    commands = [name for name in app if not name.startswith("-")]
    for name in commands:
        yield from verbs(app[name], (*before, name))
    if before and (not commands or app.default_command is not None):
        yield before


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("desk")
    for name, content in FILES.items():
        if content is not None:
            (folder / name).write_bytes(content)
    (folder / "folder").mkdir()
    arm, t = robots.load("yumi_left"), np.arange(0.0, 1.0, 0.004)
    q = arm.q_home + 0.1 * np.sin(t)[:, None]
    table = log.Table(t, {"q": q, "qd": np.gradient(q, t, axis=0), "tau": 0.1 + 0.0 * q})
    log.write(table, folder / "good.csv")
    log.write(table, folder / "good.mcap", arm)
    fit_dmp(t, q, n_basis=8).value.save(folder / "motion.toml")
    models.save(arm, folder / "robot.toml")
    (folder / "still.py").write_text("def still(state):\n    return None\n")
    return folder


@pytest.fixture
def tried(desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Return a function that runs a command, checks the common properties of failures, and returns the output."""
    monkeypatch.chdir(desk)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(desk))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(desk))
    monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path))  # created when matplotlib is first imported
    before = contents(desk)

    def attempt(words: list[str], codes: tuple[int, ...], silent: bool = True) -> str:
        code = cli.main(words)
        told = capsys.readouterr()
        assert code in codes, f"{code}: {told.err}"
        assert not silent or told.out == ""
        sentences = [line for line in told.err.splitlines() if line.startswith("armlab: ") and ": note: " not in line]
        assert len(sentences) == 1, told.err
        assert "internal error" not in told.err
        assert "Traceback" not in told.err
        assert contents(desk) == before
        return sentences[0]

    return attempt


def contents(folder: Path) -> dict[Path, bytes]:
    found = (path for path in folder.rglob("*") if "__pycache__" not in path.parts)
    return {path: path.read_bytes() if path.is_file() else b"" for path in found}


def test_help_ends_with_an_example_that_is_right_and_imports_nothing_heavy() -> None:
    """Run in one process that reports the first command to import each module; nobody asks for slow help."""
    code = (
        "import contextlib, io, json, sys\nfrom armlab import cli\nsaid = {}\nfound = {}\n"
        f"for words in {[(), *verbs()]}:\n"
        "    with contextlib.redirect_stdout(io.StringIO()) as out:\n        assert cli.main([*words, '--help']) == 0\n"
        "    said[' '.join(words)] = out.getvalue()\n"
        f"    found = {{name: words for name in {HEAVY} if name in sys.modules}} | found\n"
        "print(json.dumps([said, found]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stderr == ""
    said, heavy = json.loads(done.stdout)
    assert heavy == {}
    app = cli.build_app()
    for words in verbs():
        ending = said[" ".join(words)].rpartition("Example: armlab ")[2]
        example = ending.partition("For a URDF,")[0].split()  # on one line, or broken into two
        assert tuple(example[: len(words)]) == words
        example = take_robot_options(example)
        assert not app.parse_args(example, exit_on_error=False, print_error=False)[2]
    take_robot_options([])


def test_the_reference_names_every_command() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    table = "\n".join(line for line in page.splitlines() if line.startswith("| `armlab"))
    for words in verbs():
        whole = "armlab plot" if words[0] == "plot" else f"armlab {' '.join(words)}"
        assert whole in table or f"`{words[-1]}`" in table, whole  # `armlab calibrate hand-eye`, `force-sensor`


def test_an_option_that_is_unknown_or_missing_is_wrong_use(tried) -> None:
    for verb in verbs():
        said = tried([*verb, "--no-such-option"], (cli.WRONG_USE,))
        assert "no-such-option" in said or "requires" in said
        assert said.endswith("--help)")
        if verb not in NEED_NOTHING:
            tried(list(verb), (cli.WRONG_USE,))
    for group in {verb[0] for verb in verbs() if len(verb) > 1}:
        assert f"armlab {group} --help" in tried([group, "--none"], (cli.WRONG_USE,))


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name in ("folder", "text", "empty") else ()) for name in FILES],
)
@pytest.mark.parametrize("words", rows(INPUTS))
def test_a_wrong_file_gets_a_sentence(words: str, name: str, tried) -> None:
    said = tried(words.format(name).split(), (cli.FAILED, cli.WRONG_USE))
    assert "Expected" in said
    assert name in said


@pytest.mark.parametrize("words", rows(OUTPUTS))
def test_what_exists_is_kept_and_a_missing_folder_named(words: str, tried, desk: Path) -> None:
    wanted = next(word for word in words.split() if "{}" in word)
    assert "Create the folder first" in tried(words.format("nowhere/new").split(), (cli.WRONG_USE,))
    mine = desk / wanted.format("mine")
    mine.write_text("mine")
    try:
        assert cli.main(words.format("mine").split()) == cli.WRONG_USE
        assert mine.read_text() == "mine"
    finally:
        mine.unlink()


@pytest.mark.parametrize(
    "value", ["nan", "-1", *(pytest.param(one, marks=pytest.mark.slow) for one in ("1e999", "text", ""))]
)
@pytest.mark.parametrize(
    ("words", "option"), [(words, option) for words, options in NUMBERS.items() for option in options.split()]
)
def test_a_wrong_number_gets_a_sentence(words: str, option: str, value: str, tried) -> None:
    if (option in MAY_BE_INFINITE and value == "1e999") or (option == "start" and value == "-1"):
        pytest.skip("infinite time, or time before the first sample")
    tried([*words.split(), f"--{option}={value}"], (cli.WRONG_USE,))


@pytest.mark.parametrize("row", rows(REFUSED))
def test_words_that_make_no_sense_are_wrong_use(row: str, tried) -> None:
    words, _, said = row.partition(" | ")
    assert said in tried(words.split(), (cli.WRONG_USE,))


@pytest.mark.parametrize("row", rows(FAILED_WORK))
def test_work_that_cannot_be_done_fails(row: str, tried) -> None:
    words, _, said = row.partition(" | ")
    assert said in tried(words.split(), (cli.FAILED,))


@pytest.mark.parametrize("words", rows(LISTENING))
def test_a_port_in_use_is_told_with_who_has_it(words: str, tried) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        said = tried(words.format(port).split(), (cli.FAILED,))
    assert f":{port} to be free" in said
    assert f"process {os.getpid()}" in said


@pytest.mark.parametrize("words", [words for words in rows(INPUTS) if words.split()[0] in READING])
def test_a_file_of_somebody_else_is_named(words: str, tried, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried(words.format("toml").split(), (cli.FAILED, cli.WRONG_USE))  # imports modules that other users may not read
    main, me = cli.main, os.geteuid()

    def as_somebody_else(words: list[str]) -> int:
        (desk / "text").chmod(0)
        try:
            os.seteuid(me or NOBODY)  # root may read everything
            return main(words)
        finally:
            os.seteuid(me)
            (desk / "text").chmod(0o600)

    desk.chmod(0o755)
    monkeypatch.setattr(cli, "main", as_somebody_else)
    said = tried(words.format("text").split(), (cli.FAILED, cli.WRONG_USE))
    assert "text" in said
    assert "Permission denied" in said


@pytest.mark.parametrize("words", rows(FULL))
def test_a_full_disk_leaves_nothing_half(words: str, tried, full_disk) -> None:
    with full_disk():
        said = tried(words.split(), (cli.FAILED,), silent=False)  # the result may be printed first
    assert "oo large" in said
    assert "new." in said


@pytest.mark.parametrize("closed", ["full", "gone"])
def test_standard_output_that_takes_nothing(closed: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with Path("/dev/full").open("w") as full:
        to = full.fileno() if closed == "full" else writer
        done = subprocess.run(
            [sys.executable, "-m", "armlab", "--help"], stdout=to, stderr=subprocess.PIPE, text=True, timeout=60
        )
    os.close(writer)
    assert done.returncode == cli.FAILED
    assert done.stderr == ("armlab: No space left on device.\n" if closed == "full" else "")


@pytest.mark.slow
@pytest.mark.parametrize("words", ["sim yumi_left --to 127.0.0.1:9", "excite yumi_left -o new.csv", "demo -o new"])
def test_ctrl_c_leaves_no_half_file(words: str, tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "armlab", *words.split()],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            _, said = process.communicate(timeout=1.0)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=60)
            assert process.returncode in (cli.INTERRUPTED, -signal.SIGINT)  # shells show both as 130
    assert "Traceback" not in said
    assert not list(tmp_path.rglob("*.part"))
    assert not (tmp_path / "new.csv").exists()
