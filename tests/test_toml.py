"""User TOML files: one error type for every fault."""

from __future__ import annotations

import pytest

from armlab._files import TomlError, parsed


def test_tables() -> None:
    assert parsed("a = 9223372036854775807\n[b]\nc = [-9223372036854775808, 1.5, true]") == {
        "a": 2**63 - 1,
        "b": {"c": [-(2**63), 1.5, True]},
    }


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a =", "Invalid value"),
        ("a = 9223372036854775808", "an integer of 64 bits plus sign, although TOML allows 63"),
        ("[[a]]\nb = {c = [-1" + "0" * 400 + "]}", "an integer of 1329 bits"),
        ("a = " + "1" * 5000, "4300 digits"),
        ("a = " + "[" * 5000 + "]" * 5000, "recursion"),
        (".".join("a" * 17) + " = 1", "a dotted key of more than 16 names"),
        ("[" + ".".join(["'a.'", '"\\".#"'] * 9) + "]", "a dotted key of more than 16 names"),
        ("x = { " + " . ".join("a" * 17) + " = 1}", "a dotted key of more than 16 names"),
        ("#" + "a" * (1 << 24), "16777217 characters"),
        ("[a.b]\n" * 8_000 + "c=1\n" * 8_000, "16000 keys and tables"),
        ("a=[" + "1," * (1 << 20) + "]", "arrays of"),
        ('k="""x""""#x""""\n' + ".".join("a" * 20) + "=1", "a dotted key of more than 16"),
    ],
)
def test_what_is_no_toml(text: str, told: str) -> None:
    with pytest.raises(TomlError, match=told):
        parsed(text)


def test_dots_that_name_nothing() -> None:
    """Only keys count, not strings, comments or numbers."""
    dots = "a." * 40
    text = f'x = \'{dots}\' # {dots}\ny = """\n{dots}"""\nz = [{"1.5, " * 40}]\n' + ".".join("a" * 16) + " = 1"
    assert parsed(text)["x"] == dots
