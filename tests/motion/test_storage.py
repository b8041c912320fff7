"""Files of movement primitives: each kind is read back bit-identically, and refuses unknown content."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import models
from armlab.errors import ConfigError, ModelMismatchError
from armlab.estimation import Fit
from armlab.motion import Dmp, PeriodicDmp, PoseDmp, ProMP, TwoDofDmp
from armlab.motion.storage import Saved

from .conftest import primitive

KINDS = {"dmp": Dmp, "two_dof_dmp": TwoDofDmp, "pose_dmp": PoseDmp, "periodic_dmp": PeriodicDmp, "promp": ProMP}


@pytest.fixture(scope="module")
def saved(pose_fit: Fit[PoseDmp]) -> dict[str, Any]:
    """One primitive of each kind, with many-digit numbers."""
    rng = np.random.default_rng(3)
    weights, centres, widths = rng.normal(size=(5, 2)), rng.uniform(size=5), rng.uniform(0.1, 1.0, 5)
    dmp = primitive(demo_weights=rng.normal(size=(3, 20, 3)), limits=np.array([[-9.0] * 3, [9.0] * 3]))
    return {
        "dmp": dmp,
        "two_dof_dmp": TwoDofDmp(
            dmp, kp=np.pi, kv=7.3, kc=1e3 / 3, alpha_e=4.1, e0=[0.1, 0.2, 1 / 3], e_scale=0.7, e_max=9.0
        ),
        "pose_dmp": pose_fit.value,
        "periodic_dmp": PeriodicDmp(weights, centres, 0.3, 1.7, rng.normal(size=2)),
        "promp": ProMP(weights, np.eye(10) / 3, centres, widths, 1.1, np.array([0.1, 0.0])),
    }


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_gives_the_same_value(saved: dict[str, Any], kind: str, tmp_path: Path) -> None:
    value = saved[kind]
    path = value.save(tmp_path / "it.toml")
    for again in (KINDS[kind].load(path), models.load(path)):
        assert isinstance(again, Saved)
        assert type(again) is KINDS[kind]
        assert again == value
    text = path.read_text()
    assert f'kind = "{kind}"\n' in text
    assert 'package = "armlab.motion"' in text
    (tmp_path / "more.toml").write_text(text.replace("\n[value]\n", "\n[value]\nextra = 1\n"))
    with pytest.raises(ConfigError, match="extra"):
        KINDS[kind].load(tmp_path / "more.toml")
    with pytest.raises(ModelMismatchError, match=f"got '{kind}'"):
        KINDS["dmp" if kind != "dmp" else "promp"].load(path)
    with pytest.raises(TypeError):
        hash(value)


@pytest.mark.parametrize("kind", KINDS)
def test_a_value_that_has_run_is_copied_and_sent_to_other_processes(saved: dict[str, Any], kind: str) -> None:
    value = saved[kind]
    value.sample(0.02, 0, 2) if kind == "promp" else value.stepper()
    for again in (pickle.loads(pickle.dumps(value)), copy.deepcopy(value)):
        assert again == value
        for field in fields(again):
            part = getattr(again, field.name)
            assert not isinstance(part, np.ndarray) or not part.flags.writeable, field.name


def test_units_are_those_of_the_numbers(saved: dict[str, Any], tmp_path: Path) -> None:
    path = saved["two_dof_dmp"].save(tmp_path / "it.toml")
    text = path.read_text()
    for old, new, name in (('"dmp.tau_d" = "s"', '"dmp.tau_d" = "ms"', "dmp.tau_d"), ('\nkp = "1', '\nkq = "1', "kq")):
        assert old in text
        path.write_text(text.replace(old, new))
        with pytest.raises(ConfigError, match=rf"meta\.units.* for {name}"):
            TwoDofDmp.load(path)


def test_a_file_is_read_before_its_package_is_imported(saved: dict[str, Any], tmp_path: Path) -> None:
    path = saved["dmp"].save(tmp_path / "it.toml")
    code = "from armlab import models; import sys; print(type(models.load(sys.argv[1])).__name__)"
    run = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=False)
    assert run.stdout == "Dmp\n", run.stderr
    path.write_text(path.read_text().replace('"dmp"', '"swing"').replace('"armlab.motion"', '"elsewhere"'))
    with pytest.raises(ModelMismatchError, match="Import elsewhere, which wrote the file"):
        models.load(path)
