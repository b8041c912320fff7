"""armlab identify: a report and a model file, or a sentence and no file."""

from __future__ import annotations

import pytest

from armlab import models
from armlab.cli import main
from armlab.cli.identify import identify
from armlab.log import Table


@pytest.fixture
def reading(monkeypatch, excited: Table):
    """`log.read` gives the synthetic log, short when the name says so."""
    tables = {"run.mcap": excited, "short.mcap": excited.between(0, 2)}
    monkeypatch.setattr("armlab.log.read", lambda path: tables[path.name])


def test_it_prints_a_table_per_joint_and_saves_the_model(reading, tmp_path, capsys) -> None:
    output, figure = tmp_path / "model.toml", tmp_path / "fit.png"
    assert main(["identify", "yumi_left", "run.mcap", "-o", str(output), "--figure", str(figure)]) == 0
    said = capsys.readouterr()
    assert "held-out" in said.out
    assert "excitation good" in said.out
    assert "identify: checking the log" in said.err
    assert models.load(output).robot_name == "yumi_left"
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_nothing_is_overwritten_without_force(reading, tmp_path, capsys) -> None:
    output = tmp_path / "model.toml"
    output.write_text("mine")
    assert main(["identify", "yumi_left", "run.mcap", "-o", str(output)]) == 1
    assert "--force" in capsys.readouterr().err
    assert output.read_text() == "mine"
    assert main(["identify", "yumi_left", "run.mcap", "-o", str(output), "--force"]) == 0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["yumi_left", "short.mcap"], "at least 5 s"),
        (["yumi_middle", "run.mcap"], "yumi_left"),
        (["yumi_left"], "at least one log"),
        (["irb2400", "run.mcap"], "Name the robot that was logged"),
    ],
)
def test_refusals_are_one_sentence_and_leave_no_file(
    reading, tmp_path, capsys, words: list[str], sentence: str
) -> None:
    output = tmp_path / "model.toml"
    assert main(["identify", *words, "-o", str(output)]) == 1
    said = capsys.readouterr().err
    assert sentence in said
    assert "Traceback" not in said
    assert not list(tmp_path.iterdir())
    assert identify.__doc__
