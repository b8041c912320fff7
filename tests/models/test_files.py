"""Files of models: registered kinds, saving and loading."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from armlab import models
from armlab.errors import ConfigError, ModelMismatchError
from armlab.models import load, load_statistics, save
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


# Model files: exact, bound to a robot, refused when they are something else.


def test_save_and_load_give_the_same_numbers(tmp_path, model) -> None:
    path = save(model, tmp_path / "model.toml")
    again = load(path)
    for name in ("frames", "prismatic", "gravity", "link_parameters", "rotor", "base_values", "base_cov"):
        assert np.array_equal(getattr(again, name), getattr(model, name)), name
    for part, names in (
        ("friction", vars(model.friction)),
        ("ripple", vars(model.ripple)),
        ("bound", vars(model.bound)),
        ("quality", vars(model.quality)),
    ):
        for name in names:
            assert np.array_equal(getattr(getattr(again, part), name), getattr(getattr(model, part), name)), name
    for name in ("kind", "alpha2"):
        assert getattr(again.covariance, name) == getattr(model.covariance, name)
    assert np.array_equal(again.covariance.C0, model.covariance.C0)
    assert (again.robot_hash, again.base_names, again.sources, again.cutoff) == (
        model.robot_hash, model.base_names, model.sources, model.cutoff
    )  # fmt: skip
    assert path.stat().st_size < 1_000_000


def test_the_file_says_where_it_comes_from_of_files(tmp_path, model) -> None:
    meta = tomllib.loads(save(model, tmp_path / "model.toml").read_text())["meta"]
    assert meta["kind"] == "torque_model"
    assert meta["sign"] == "environment_on_robot"
    assert meta["robot"] == "yumi_left"
    assert meta["created"].endswith("Z")
    assert "sha256:" in meta["sources"][0]


@pytest.mark.parametrize(
    ("old", "new", "error", "sentence"),
    [
        ('sign = "environment_on_robot"', 'sign = "robot_on_environment"', ModelMismatchError, "kind, format and sign"),
        ("format = 5", "format = 9", ModelMismatchError, "kind, format and sign"),
        ("rotor = [", "motor = [", ConfigError, "motor|rotor"),
        ("[meta]", "[meta", ConfigError, "TOML model file"),
        ("alpha2 = ", 'alpha2 = "x"\nbeta = ', ConfigError, "alpha2|beta"),
        ("[meta]", "[meat]", ModelMismatchError, "and a kind of"),
        ("gravity = [", "gravity = [nan,", ConfigError, "gravity"),
        ("qd_peak = [", "peak = [", ConfigError, "peak"),
        ("rotor = [", "rotor = [0.1,", ConfigError, "joints"),
        ("prismatic = [", "prismatic = [true,", ConfigError, "prismatic"),
        ("cutoff = ", "cutoff = -", ConfigError, "cut-off"),
        ("[friction.joint3]", "[friction.joint9]", ConfigError, "joint3"),
        ('kind = "exp"', 'kind = "cubic"', ConfigError, "covariance kind"),
    ],
)
def test_other_files_are_refused(tmp_path, model, old: str, new: str, error: type[Exception], sentence: str) -> None:
    path = save(model, tmp_path / "model.toml")
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(error, match=sentence):
        load(path)


def test_the_noise_of_the_momentum_estimators_is_kept_where_there_is_any(tmp_path, model) -> None:
    path = save(model, tmp_path / "model.toml")
    again = load(path)
    for name, value in vars(model.momentum).items():
        assert np.array_equal(getattr(again.momentum, name), value), name
    assert load(save(replace(model, momentum=None), tmp_path / "without.toml")).momentum is None


def test_missing_and_misnamed_files(tmp_path, model) -> None:
    with pytest.raises(ConfigError, match="model file at"):
        load(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match=r"ends in \.toml"):
        save(model, tmp_path / "model.txt")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="TOML model file"):
        load(tmp_path / "bytes.toml")


def test_what_a_fit_knew_is_kept_beside_the_value(tmp_path, model) -> None:
    cov = np.random.default_rng(0).standard_normal((3, 3))
    path = save(model, tmp_path / "model.toml", {"cov": cov, "names": ("a", "b"), "n": 3})
    known = load_statistics(path)
    assert known["cov"].tobytes() == cov.tobytes()
    assert (known["names"], known["n"]) == (("a", "b"), 3)
    assert np.array_equal(load(path, kind="torque_model").rotor, model.rotor)
    assert load_statistics(save(model, tmp_path / "bare.toml")) == {}
