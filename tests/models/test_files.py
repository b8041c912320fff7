"""Model files: exact, bound to a robot, refused when they are something else."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ConfigError, ModelMismatchError
from armlab.models import load, load_statistics, save


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


def test_the_file_says_where_it_comes_from(tmp_path, model) -> None:
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
