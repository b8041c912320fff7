"""Metadata, attachments and events of a recording, and secrets that are removed from them."""

from __future__ import annotations

import hashlib
import io
import json
import struct
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from ruamel.yaml import YAML

from armlab import robots
from armlab.errors import LogError, RobotError
from armlab.log.recording.metadata import (
    SECRET,
    Event,
    Inspection,
    Setting,
    Topic,
    attached,
    described,
    inspect,
    metadata,
    redacted,
    revision,
)
from armlab.log.recording.recorder import Recorder
from armlab.robots import Robot, from_toml, load, to_toml

MARKER = "q7Zw"
LETTERS = st.text("abcxyz", min_size=1, max_size=5)  # cannot form the name of a secret
SCALARS = st.one_of(st.integers(0, 9), st.booleans(), LETTERS)
HIDING = st.recursive(
    st.sampled_from([MARKER, f"a\n{MARKER}\n  b", f" {MARKER}", f"a # {MARKER}", f"]}}'\"\\\n{MARKER}"]),
    lambda inside: st.one_of(
        st.lists(st.one_of(inside, SCALARS), max_size=3),
        st.dictionaries(LETTERS, st.one_of(inside, SCALARS), max_size=3),
    ),
    max_leaves=5,
)
NAMES = st.sampled_from(
    ["token", "my_token", "PASSWORD", "api-key", "ApiKey", "the secret of it", "x.passwd", "token \"'", "tokens"]
)


def table(inside: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    plain = st.dictionaries(LETTERS, st.one_of(SCALARS, inside, st.lists(inside, max_size=2)), max_size=3)
    return st.builds(lambda open_, hidden: open_ | hidden, plain, st.dictionaries(NAMES, HIDING, max_size=2))


TREES = table(st.recursive(SCALARS, table, max_leaves=8))


def seen(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: "***" if SECRET.search(key) else seen(one) for key, one in value.items()}
    return [seen(one) for one in value] if isinstance(value, list) else value


def yaml_text(tree: Any, flow: bool | None) -> str:
    writer, out = YAML(typ="safe", pure=True), io.StringIO()
    writer.default_flow_style = flow
    writer.dump(tree, out)
    return out.getvalue()


@settings(max_examples=25)
@given(tree=TREES, flow=st.sampled_from([None, True, False]), width=st.sampled_from([None, 2]))
def test_no_shape_of_a_secret_is_kept_and_nothing_else_is_lost(tree: Any, flow: bool | None, width: int | None) -> None:
    for name, text, parse in (
        ("a.toml", tomli_w.dumps(tree, multiline_strings=bool(flow)), tomllib.loads),
        ("a.JSON", json.dumps(tree, indent=width), json.loads),
        ("a.yaml", yaml_text(tree, flow), YAML(typ="safe", pure=True).load),
    ):
        told = redacted(name, text.encode()).decode()
        assert MARKER not in told, name
        assert parse(told) == seen(tree), name


@settings(max_examples=25)
@given(
    sections=st.dictionaries(st.sampled_from(["cell", "token", "my secrets"]), st.booleans(), max_size=3),
    lines=st.lists(st.sampled_from([MARKER, f"x = {MARKER}", f"# {MARKER}"]), min_size=1, max_size=3),
    between=st.sampled_from(["=", ":", " = "]),
)
def test_sections_and_long_values_of_ini_files(sections: dict[str, bool], lines: list[str], between: str) -> None:
    text = f"api-key{between}" + "\n  ".join(lines) + "\nport = 1\n"
    for section, has_value in sections.items():
        secret = SECRET.search(section) is not None
        text += f"[{section}]\nvalue{between}{MARKER if secret and has_value else 5}\npasswd{between}{MARKER}\n"
    told = redacted("a.ini", text.encode()).decode()
    assert MARKER not in told
    assert "port = 1" in told
    assert ("value = 5" in told) == ("cell" in sections)


BLOCKS = f"""
list:
- secret: >-
    {MARKER}
    b
- api-key: [a,
{MARKER}]
? token
: {MARKER}
base: &base {{password: "x
  {MARKER}", port: 1}}
again: *base
merged:
  <<: *base
round: &round
  - *round
"t\\x6fken": {MARKER}
--- # {MARKER}
passwords: |2
    {MARKER}
kept: here
"""


def test_what_only_yaml_can_say() -> None:
    told = redacted("cell.yml", BLOCKS.encode()).decode()
    assert MARKER not in told
    first, second = YAML(typ="safe", pure=True).load_all(told)
    assert first["list"] == [{"secret": "***"}, {"api-key": "***"}]
    assert first["merged"] == first["again"] == {"password": "***", "port": 1}
    assert first["round"][0] is first["round"]
    assert second == {"passwords": "***", "kept": "here"}


def test_files_that_share_a_table_many_times_stay_small() -> None:
    text = "a: &a [token]\n" + "".join(
        f"{new}: &{new} [{', '.join(9 * ['*' + old])}]\n" for old, new in zip("abcdefghijk", "bcdefghijkl")
    )
    assert len(redacted("a.yaml", text.encode())) < 10 * len(text)  # not 9**11


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.toml", b"token = [" + 40 * b"# aaaa\n"),
        ("a.json", b'{"token": '),
        ("a.json", 100_000 * b"[" + b'"token"'),
        ("a.yaml", b"token: [a\nb: }"),
        ("a.yaml", b"x: !!pairs [token: a]"),
        ("a.yaml", b"token: !!python/name:os.system"),
        ("a.cfg", b"token\n=\n[\n"),
        ("a.ini", b"token:b :\na\n  c = 1\n"),  # a line goes on with a key without a value: AttributeError
        ("a.toml", 'token = "a"'.encode("utf-16")),
        ("a.toml", b"\xff token"),
    ],
)
def test_what_cannot_be_read_is_left_out(name: str, data: bytes) -> None:
    assert redacted(name, data).startswith(b"# omitted: ")


def test_files_that_mention_no_secret_stay_as_they_are_and_a_secret_in_a_text_does_not() -> None:
    plain = {"odd.toml": b"\xff\xfe", "data.bin": b"token = 1", "a.toml": b"# mine\nx = 'a\\b'"}
    plain |= {"a.json": b'{ "x":  "\\n" }', "a.yaml": b"x: {a: 1}   # mine", "b.json": b"\xef\xbb\xbf{}"}
    for name, data in plain.items():
        assert redacted(name, data) == data
    told = tomllib.loads(redacted("a.toml", b'url = "http://x?my_token=abc&y=1" # Token: abc').decode())
    assert told == {"url": "http://x?my_token=***"}
    assert json.loads(redacted("a.json", b'{"\\u0074oken": "abc", "x": 1}')) == {"token": "***", "x": 1}


def git(folder: Path, *words: str) -> str:
    who = ["-c", "user.name=a", "-c", "user.email=a@localhost", "-c", "commit.gpgsign=false"]
    done = subprocess.run(["git", "-C", str(folder), *who, *words], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_the_commit_of_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    assert revision(folder) == ""
    revision.cache_clear()
    git(folder, "init", "-q")
    (folder / "controller.py").write_text("gain = 1")
    git(folder, "add", ".")
    git(folder, "commit", "-qm", "first")
    assert revision(folder) == git(folder, "rev-parse", "HEAD")
    revision.cache_clear()
    (folder / "controller.py").write_text("gain = 2")
    assert revision(folder) == git(folder, "rev-parse", "HEAD") + "+"
    monkeypatch.setenv("PATH", str(tmp_path))  # without git
    assert revision(tmp_path / "other") == ""


def test_the_robot_that_attachments_describe() -> None:
    left, right = load("yumi_left"), load("yumi_right")
    files = {"model.toml": b"1", "robot.toml": to_toml(left).encode(), "robot-2.toml": to_toml(right).encode()}
    assert described(files, "yumi_right", "run.mcap") == right
    assert described(files, "irb120", "run.mcap") is None
    with pytest.raises(RobotError, match=r"run\.mcap, robot\.toml"):
        described({"robot.toml": b"\xff"}, "yumi_left", "run.mcap")


def test_metadata_and_what_is_attached(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["armlab", "run", "--token", "abc", "--api-key=xyz", "tokens.py", "--seed", "3"])
    about = metadata(robot, {"model.toml": b"1"}, "mine")
    assert about["command"] == "armlab run --token *** --api-key=*** tokens.py --seed 3"
    assert (about["robot"], about["robot_hash"], about["note"]) == (robot.name, robot.hash, "mine")
    assert json.loads(about["attachments"]) == {"model.toml": hashlib.sha256(b"1").hexdigest()}
    found = attached(robot, {"cell.toml": b"[token]\nkey = 'abc'", "data.bin": b"token = 1"})
    assert from_toml(found["robot.toml"].decode(), "it").hash == robot.hash
    assert tomllib.loads(found["cell.toml"].decode()) == {"token": "***"}
    assert found["data.bin"] == b"token = 1"
    assert attached(robot, {"robot.toml": b"mine"}) == {"robot.toml": b"mine"}


def test_topics_events_and_sizes(recording: Callable[..., Path]) -> None:
    path = recording(50)
    held = inspect(path)
    assert isinstance(held, Inspection)
    counts = {topic.name: topic.messages for topic in held.topics}
    assert [counts[f"/yumi_right/{name}"] for name in ("tick", "joint_states", "columns/q_ext")] == [50, 50, 0]
    assert Topic("/yumi_right/events", "rcl_interfaces/msg/Log", 1) in held.topics
    assert isinstance(held.events[0], Event)
    assert (held.size, held.path) == (path.stat().st_size, path)
    path.write_bytes(b"\x89MCAP0\r\n")
    assert inspect(path).topics == ()
    path.write_bytes(b"text")
    with pytest.raises(LogError, match="format text"):
        inspect(path)


@pytest.mark.parametrize(
    ("encoding", "text", "told"),
    [
        ("ros2msg", b"string msg", ["a", "c"]),
        ("ros2idl", b"module rcl_interfaces { module msg { struct Log { string msg; }; }; };", ["a", "c"]),
        ("ros2msg", b"string[[[", []),
        ("ros2msg", b"uint32 x", []),
    ],
)
def test_events_of_another_program(tmp_path: Path, encoding: str, text: bytes, told: list[str]) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("rcl_interfaces/msg/Log", encoding, text)
        channel = writer.register_channel("/rosout", "cdr", schema)
        for row, word in enumerate((b"a", b"\xff", b"c")):
            writer.add_message(channel, row, b"\0\1\0\0" + struct.pack("<I", 2) + word + b"\0", row, row)
        writer.finish()
    held = inspect(path)
    assert [event.text for event in held.events] == told
    assert held.topics == (Topic("/rosout", "rcl_interfaces/msg/Log", 3),)


def test_settings_of_parameters(tmp_path: Path) -> None:
    values = [2.5, -3, True, "a 'word' \u00e9", [0.0, 1.5e-300]]
    with Recorder(tmp_path / "run.mcap", robots.load("yumi_right")) as recorder:
        for k, value in enumerate(values):
            recorder.parameter(k, f"p{k}", np.array(value) if k == 4 else value, "local 1", 10**18 + k)
    found = [Setting(10**18 + k, k, f"p{k}", value, "local 1") for k, value in enumerate(values)]
    assert list(inspect(recorder.path).parameters) == found
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(recorder.path.read_bytes()[:-100])
    assert list(inspect(torn).parameters) == found
    other = tmp_path / "x.mcap"  # in the other byte order
    with other.open("wb") as file:
        writer = Writer(file)
        writer.start()
        text = b"int64 sequence\nstring name\nstring value\nstring who"
        schema = writer.register_schema("armlab_msgs/msg/Parameter", "ros2msg", text)
        channel = writer.register_channel("/parameters", "cdr", schema)
        texts = (struct.pack(">I", 2) + letter + b"\0\0\0" for letter in (b"a", b"7", b"b"))
        writer.add_message(channel, 5, b"\0\0\0\0" + struct.pack(">q", 5) + b"".join(texts), 5, 5)
        writer.finish()
    assert inspect(other).parameters == (Setting(5, 5, "a", 7, "b"),)
