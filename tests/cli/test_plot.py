"""armlab plot: figures of a saved primitive."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from armlab import log
from armlab.cli import main
from armlab.cli.plot import dmp, plot
from armlab.log import Table
from armlab.motion import fit_dmp


def test_a_primitive_is_drawn(tmp_path: Path, capsys) -> None:
    t = np.linspace(0.0, 1.0, 101)
    q = np.stack([np.sin(t), t**2], axis=1)
    taught = log.write(Table(t, {"q": q}), tmp_path / "taught.csv")
    primitive = fit_dmp(t, q, n_basis=8).value.save(tmp_path / "motion.toml")
    for name, words in {"a.png": [], "b.svg": ["--phase"], "c.png": ["--demo", str(taught)]}.items():
        assert main(["plot", "dmp", str(primitive), "-o", str(tmp_path / name), *words]) == 0
        assert (tmp_path / name).stat().st_size > 1000
    for words, sentence in {
        ("-o", str(tmp_path / "a.png")): "--force",
        ("-o", str(tmp_path / "a.txt")): ".png",
    }.items():
        assert main(["plot", "dmp", str(primitive), *words]) == 1
        assert sentence in capsys.readouterr().err
    assert plot.name == ("plot",)
    assert dmp.__doc__
