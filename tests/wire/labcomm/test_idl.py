"""The declarations that come with armlab have the signatures of the format's vectors."""

from __future__ import annotations

from pathlib import Path

import pytest

from armlab.errors import UnknownName
from armlab.wire.labcomm import idl, parse_lc


def test_files() -> None:
    assert idl.FILES == ("armlab", "extctrl")
    assert set(idl.samples("armlab")) == {"robot_row", "command_row", "fused_row", "stop"}
    assert "force_torque_net" in idl.text("extctrl")
    with pytest.raises(UnknownName, match="extctrl"):
        idl.samples("orca")


@pytest.mark.parametrize("name", ["armlab", "extctrl"])
def test_signatures_are_those_of_the_vectors(name: str, folder: Path) -> None:
    ours = idl.samples(name)
    theirs = parse_lc((folder / "idl" / f"{name}.lc").read_text(encoding="utf-8"))
    both = [one for one in theirs if one.name in ours]
    assert len(both) == 3
    for one in both:
        assert one.type == ours[one.name].type
    assert len(idl.samples("armlab")["fused_row"].signature()) == 91
