"""Values of any registered class: bit-equal through a file, refused when they are something else."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from armlab import models
from armlab.errors import ConfigError, ModelMismatchError
from armlab.models.files import decode, encode, kind_of, provenance, read_value, register, value_file


@dataclass(frozen=True, eq=False)
class Inner:
    name: str
    flags: np.ndarray


@dataclass(frozen=True, eq=False)
class Outer:
    pose: np.ndarray
    mass: float
    count: int
    empty: np.ndarray
    parts: tuple[Inner, ...]
    table: dict[str, float]
    nothing: None = None
    sources: tuple[str, ...] = field(default=("run.csv sha256:0",))
    robot_name: str = "yumi_left"
    robot_hash: str = "abc"


register("test_inner", Inner)
register("test_outer", Outer)


def value() -> Outer:
    rng = np.random.default_rng(0)
    pose = rng.standard_normal((4, 4)) * 10.0 ** rng.integers(-300, 300, (4, 4))
    pose[0, :3] = [np.nan, np.inf, -0.0]
    parts = (Inner("a", np.array([True, False])), Inner("b", np.array([1, 2, 3])))
    return Outer(pose, 0.1, 3, np.zeros((0, 3)), parts, {"x": 1 / 3})


def test_every_bit_comes_back(tmp_path: Path) -> None:
    before = value()
    after = models.load(models.save(before, tmp_path / "outer.toml"))
    assert isinstance(after, Outer)
    assert after.pose.tobytes() == before.pose.tobytes()
    assert after.empty.shape == (0, 3)
    assert (after.mass, after.count, after.table, after.nothing) == (0.1, 3, {"x": 1 / 3}, None)
    assert after.parts[0].flags.dtype == bool
    assert after.parts[1].flags.tolist() == [1, 2, 3]
    assert after.parts[1].name == "b"
    assert after.sources == before.sources


def test_the_file_says_where_it_comes_from(tmp_path: Path) -> None:
    meta = tomllib.loads(models.save(value(), tmp_path / "outer.toml").read_text())["meta"]
    assert (meta["kind"], meta["robot"], meta["robot_hash"]) == ("test_outer", "yumi_left", "abc")
    assert meta["sources"] == ["run.csv sha256:0"]
    assert provenance("x", object())["robot"] == ""
    assert value_file(value())["meta"]["kind"] == "test_outer"


def test_another_kind_is_refused(tmp_path: Path) -> None:
    path = models.save(value(), tmp_path / "outer.toml")
    assert isinstance(models.load(path, kind="test_outer"), Outer)
    with pytest.raises(ModelMismatchError, match=r"kind 'torque_model' at .* got 'test_outer'"):
        models.load(path, kind="torque_model")
    path.write_text(path.read_text().replace('kind = "test_outer"', 'kind = "unknown"'))
    with pytest.raises(ModelMismatchError, match="got 'unknown' in format 1"):
        models.load(path)


def test_damaged_fields_are_refused_in_one_line(tmp_path: Path) -> None:
    path = models.save(value(), tmp_path / "outer.toml")
    path.write_text(path.read_text().replace("mass = ", "weight = "))
    with pytest.raises(ConfigError, match=r"fields of a test_outer at .*weight"):
        models.load(path)
    with pytest.raises(ConfigError, match="fields of a test_outer"):
        read_value({"meta": {"kind": "test_outer", "format": 1}}, path)


@pytest.mark.parametrize(
    ("sources", "said"),
    [
        ("tuples = []", "got one with 'tuples'"),
        ("", "fields of a test_outer"),
        ("tuple = [1]", "texts for sources .* 1"),
    ],
)
def test_sources_that_no_file_could_name_are_refused(sources: str, said: str, tmp_path: Path) -> None:
    """A value of them would be refused, with a traceback, when it is saved again."""
    path = models.save(value(), tmp_path / "outer.toml")
    head, _, rest = path.read_text().partition("[value.sources]")
    path.write_text(f"{head}[value.sources]\n{sources}\n{rest[rest.index(']') + 1 :]}")
    with pytest.raises(ConfigError, match=said):
        models.load(path)


def test_values_without_a_format_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="file format, got float"):
        kind_of(1.0)
    with pytest.raises(ConfigError, match="got complex"):
        models.save(1j, tmp_path / "x.toml")
    assert not list(tmp_path.iterdir())
    with pytest.raises(ConfigError, match="a kind of its own"):
        register("test_outer", Inner)
    with pytest.raises(ConfigError, match="a dataclass"):
        register("test_float", float)


def test_encode_and_decode_are_inverse() -> None:
    assert decode(encode(np.float64(0.1))) == 0.1
    assert decode(encode(((1, "a"), None))) == ((1, "a"), None)
