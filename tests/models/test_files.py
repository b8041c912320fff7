"""Files of models: registered kinds, saving and loading."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from armlab import models
from armlab.errors import ConfigError, ModelMismatchError
from armlab.lie import se3, so3
from armlab.models import Accelerometer, ForceSensor, HandEye, LaserSensor, Payload, load, save
from armlab.models.files import kind_of, load_statistics, provenance, read_value, register, torque_tables, value_file
from armlab.models.friction import FrictionMap, RadialBasis, RippleLines, speed_basis


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
        ("tuples = []", "got a table with 'tuples'"),
        ("", "fields of a test_outer"),
        ("tuple = [1]", "strings for sources .* 1"),
    ],
)
def test_sources_that_no_file_could_name_are_refused(sources: str, said: str, tmp_path: Path) -> None:
    """A value with such sources would be refused, with a traceback, when saved again."""
    path = models.save(value(), tmp_path / "outer.toml")
    head, _, rest = path.read_text().partition("[value.sources]")
    path.write_text(f"{head}[value.sources]\n{sources}\n{rest[rest.index(']') + 1 :]}")
    with pytest.raises(ConfigError, match=said):
        models.load(path)


# Files of torque models.


@pytest.mark.parametrize(
    ("old", "new", "error", "sentence"),
    [
        ('sign = "environment_on_robot"', 'sign = "robot_on_environment"', ModelMismatchError, "kind, format and sign"),
        ("format = 6", "format = 9", ModelMismatchError, "kind, format and sign"),
        ("rotor = [", "motor = [", ConfigError, "motor|rotor"),
        ("[meta]", "[meta", ConfigError, "TOML model file"),
        ("alpha2 = ", 'alpha2 = "x"\nbeta = ', ConfigError, "alpha2|beta"),
        ("[meta]", "[meat]", ModelMismatchError, "and a kind among"),
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


def test_a_fit_is_saved_as_by_its_own_save(tmp_path, fitted) -> None:
    path = save(fitted, tmp_path / "model.toml", sources=["a.mcap"])
    assert any("a.mcap" in source for source in load(path, kind="torque_model").sources)
    np.testing.assert_array_equal(load_statistics(path)["cov"], fitted.cov)


def values(truth) -> list[object]:
    rng = np.random.default_rng(0)
    X, Y = se3.exp(rng.standard_normal((2, 6)))
    R = so3.exp(rng.standard_normal(3))
    robot = truth.robot
    basis = RadialBasis(np.tile([0.0, 1.0], (7, 1)), np.ones((7, 2)), np.tile([0.1, 1.0], (7, 1)), np.ones((7, 2)))
    spread = [np.tile(part, (7, 1)) for part in speed_basis(0.0, 2.0)]
    return [
        ForceSensor(R, 0.3, rng.normal(size=3), rng.normal(size=6), -1, rng.normal(size=3), sources=("c",)),
        Accelerometer(R, rng.normal(size=3), 1.1, sources=("a",)),
        LaserSensor(X, np.eye(3)[:2], np.array([1.0, 0.5]), ("a", "b"), sources=("c",)),
        HandEye("eye_in_hand", X, Y),
        HandEye("eye_to_hand", None, Y, np.full((2, 3), 0.1)),
        Payload(robot.name, robot.hash, rng.normal(size=10), robot.links[-1], ("log sha256:0",)),
        FrictionMap(basis, rng.standard_normal((7, 2, 2, 2))),
        RippleLines([0, 6], [100.0, 202.0], *spread, rng.standard_normal((2, 2, 8, 2))),
    ]


@pytest.mark.parametrize("k", range(8))
def test_every_value_comes_back_bit_equal_and_read_only(truth, tmp_path: Path, k: int) -> None:
    before = values(truth)[k]
    after = load(save(before, tmp_path / "value.toml"), kind=kind_of(before))
    assert type(after) is type(before)
    for name in before.__dataclass_fields__:  # type: ignore[attr-defined]
        one, other = getattr(before, name), getattr(after, name)
        if isinstance(one, np.ndarray):
            assert one.tobytes() == other.tobytes(), name
            assert not other.flags.writeable, name
        elif not is_dataclass(one):
            assert one == other, name


def test_a_model_comes_back_bit_equal(tmp_path: Path, model) -> None:
    path = save(model, tmp_path / "model.toml")
    for one in (model, replace(model, momentum=None)):
        again = load(save(one, path))
        tables = [torque_tables(value) for value in (one, again)]
        for table in tables:
            del table["meta"]["created"]
        assert tables[0] == tables[1]
    assert path.stat().st_size < 1_000_000


def test_an_older_file_lacks_the_covariance_of_the_parameters(tmp_path: Path, model) -> None:
    assert load(save(replace(model, parameters=None), tmp_path / "older.toml")).parameters is None


def test_a_model_keeps_the_parts_of_its_drives(truth, tmp_path: Path, model) -> None:
    *_, over, lines = values(truth)
    more = replace(model, friction_map=over, lines=lines, gains=model.gains * 1.01)
    again = load(save(more, tmp_path / "model.toml"))
    q, qd = np.random.default_rng(1).standard_normal((2, 40, 7))
    assert np.array_equal(again.torque(q, qd), more.torque(q, qd))
    assert not np.allclose(more.torque(q, qd), model.torque(q, qd))
    assert np.array_equal(again.gain_cov, more.gain_cov)
