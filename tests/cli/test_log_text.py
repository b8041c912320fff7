"""What is told of a log."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from armlab.cli.log import data_of, parameters_data, parameters_text, text_of
from armlab.log import Recorder, Table, inspect
from armlab.robots import load


def test_a_log_of_another_format(tmp_path: Path) -> None:
    table = Table(np.arange(3.0), {"q": np.array([[1.0], [np.nan], [3.0]])}, source=("run.csv sha256 0",))
    text = text_of(tmp_path / "run.csv", "text", None, {"": table})
    assert "run.csv: text, began -" in text
    assert "source: run.csv sha256 0" in text
    data = data_of(tmp_path / "run.csv", "text", None, {"": table})
    assert (data["rows"], data["format"], data["columns"]["q"]["missing"]) == (3, "text", 1)


def test_a_log_without_a_topic_of_numbers(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap", load("yumi_right")) as recorder:
        recorder.event("the only word", 10**18)
    text = text_of(recorder.path, "MCAP", inspect(recorder.path), {})
    assert "began -" in text
    assert "no topic with numbers" in text
    assert "the only word" in text
    bag = text_of(tmp_path / "run.bag", "ROS 1 bag", None, {})
    assert "run.bag: ROS 1 bag, began -" in bag
    assert "no topic with numbers" in bag


def test_only_the_first_events_are_shown(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap", load("yumi_right")) as recorder:
        for i in range(30):
            recorder.event(f"event {i}", 10**18)
    held = inspect(recorder.path)
    text = text_of(recorder.path, "MCAP", held, {"yumi_right": Table(np.zeros(0), {})})
    assert "event 18" in text
    assert "event 19" not in text
    assert text.endswith("and 11 more (--json shows all)")
    assert parameters_text(held) == "This log has no parameters."
    assert parameters_data(held) == {"parameters": [], "parameters_at_end": {}}
