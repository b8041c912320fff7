"""Phrases that a roboticist would not write, and the words to use instead. Extend the lists."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"

PHRASES = {  # in pages, and in the docstrings, errors, help and reports of the code
    r"\bwhoever\b": "the noun: the commanding client",
    r"\bwho commands\b(?!;)": "the commanding client",
    r"\bnobody \w": "unknown, missing, or a passive sentence",
    r"\bsteps? of Gauss\b|\bRunge and Kutta": "Gauss–Newton, RK4",
    r"\bsliding joint": "prismatic joint",
    r"\bmotions? with times of (its|their) own\b": "time-parameterised trajectory",
    r"\bstands? in words\b|\bin words what\b": "a summary says",
    r"\b(is|are) refused by name\b": "raises an error naming",
    r"\bholds? \d+ %": "covers",
    r"\bhow (true|sure|surely)\b": "accuracy, coverage, uncertainty",
    r"\b(is|are) told\b|\btold of\b": "given, reported, known, modelled",
    r"\b(does|do|can) not tell\b|\bcannot tell (it|the)\b": "does not determine, cannot separate",
    r"\bwhat (came|comes)\b|\bwhat (is|was) (sent|asked|left|known|wanted|given)\b": "received, sent, residual",
    r"\bwhat of\b": "the noun",
    r"\bwhen (not given|left out)\b|\bwhere there is (one|none)\b": "default: X",
    r"\bLeave (it|them|one) out\b|\bleft out (is|are)\b": "omit, is skipped",
    r"\bstretch(es)? of time\b": "segment, block",
    r"\b(the|every|its|each) bars?\b(?! of)": "target",
    r"\bknobs?\b|\brehears(e|es|ed|al)\b|\bmend(s|ed)?\b": "parameter, warm up, correct",
    r"\bfor ever\b|\bgrows? old\b|\bbegins? anew\b": "permanently, becomes stale, restarts",
    r"\b(is|are) no (robot|number|pose|table|array|text|body)\b": "is not a robot",
    r"\bas (it|they) (is|are) read\b|\bby turns\b|\bgives? back\b": "measured, alternately, returns",
    r"\bof which (some|none|one)\b": "a sentence of its own",
}


def found(text: str) -> list[str]:
    """Return the phrases in a text outside of code, each with its line and the words to use instead."""
    text = re.sub(r"^```.*?^```|`[^`\n]*`", lambda code: "\n" * code[0].count("\n"), text, flags=re.M | re.S)
    return [
        f"{text[: hit.start()].count(chr(10)) + 1}: {hit[0]!r}: {instead}"
        for pattern, instead in PHRASES.items()
        for hit in re.finditer(pattern, text, flags=re.I)
    ]


def test_pages_use_the_words_of_the_field() -> None:
    pages = [page for page in DOCS.rglob("*.md") if "_build" not in page.parts]
    pages += [ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")]
    assert len(pages) > 100
    texts = {page.relative_to(ROOT): page.read_text(encoding="utf-8") for page in pages}
    wrong = [f"{name}:{line}" for name, text in texts.items() for line in found(text)]
    assert not wrong, "\n".join(wrong)


def test_the_code_uses_the_words_of_the_field() -> None:
    wrong = []
    for path in (ROOT / "src" / "armlab").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                wrong += [f"{path.name}:{node.lineno}: {line}" for line in found(node.value)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(("text", "count"), [("Whoever moves it.\n`whoever`\n", 1), ("A prismatic joint.", 0)])
def test_code_is_not_judged(text: str, count: int) -> None:
    assert len(found(text)) == count
