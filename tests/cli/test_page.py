"""The page of a report: everything inside, nothing asked from outside, words are never markup."""

from __future__ import annotations

import base64
import re

import pytest

from armlab.cli.support.html_report import HtmlReport, Verdict

PIXEL = b"\x89PNG\r\n\x1a\n not really"


@pytest.fixture
def page() -> HtmlReport:
    page = HtmlReport("Arm <1> & more", "a log & a model")
    page.verdict(Verdict(good=("It <fits>.",), bad=("Joint 7.",)))
    page.section("Per joint", "How to read it.")
    page.table([("joint", "RMS"), ("1", "0.5 & up")])
    page.figure(PIXEL, 'the "residual"', "A caption.")
    page.verbatim("a < b")
    return page


def test_the_words_are_there_and_none_of_them_is_markup(page: HtmlReport) -> None:
    html = page.html()
    for words in (
        "Arm &lt;1&gt; &amp; more",
        "It &lt;fits&gt;.",
        "0.5 &amp; up",
        "the &quot;residual&quot;",
        "a &lt; b",
    ):
        assert words in html
    assert "<fits>" not in html
    assert html.startswith("<!doctype html>")
    assert html.rstrip().endswith("</html>")
    assert '<meta charset="utf-8">' in html


def test_figures_are_inside_and_nothing_is_asked_from_outside(page: HtmlReport) -> None:
    html = page.html()
    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    assert base64.b64decode(data) == PIXEL
    assert not re.findall(r"https?:|//\w|<script|<link|@import|url\(", html)
    assert "default-src 'none'; img-src data:" in html


def test_a_table_fits_words_to_the_left_and_figures_whole() -> None:
    page = HtmlReport("t", "a")
    page.table([("joint", "friction [N m]", "where"), ("1", "0.5 ± 0.1", "point 100 %"), ("2", "nan", "-")])
    (table,) = page.pieces
    assert table.count("<th>") == 2
    assert "friction [N\N{NO-BREAK SPACE}m]" in table
    assert table.count('<th class="words">where</th>') == table.count('<td class="words">-</td>') == 1
    assert "<td>0.5 ±\N{NO-BREAK SPACE}0.1</td>" in table
    assert "overflow" not in page.html()
    assert "nowrap" not in page.html()


def test_long_tables_and_texts_open_with_a_click() -> None:
    page = HtmlReport("t", "a")
    page.table([("a",), ("1",)], "50 <numbers>")
    page.verbatim("long", "A text")
    assert page.pieces[0].startswith("<details><summary>50 &lt;numbers&gt;</summary><table>")
    assert page.pieces[1] == "<details><summary>A text</summary><pre>long</pre></details>"


def test_a_verdict_has_only_the_parts_that_there_are() -> None:
    verdict = Verdict(good=("One.", "Two."), ahead=("Log more.",))
    assert verdict.text().splitlines() == ["good: One.", "good: Two.", "next: Log more."]
    assert [title for title, _ in verdict.parts] == ["Good", "Next"]
    page = HtmlReport("t", "a")
    page.verdict(verdict)
    assert "care" not in page.pieces[0]
    assert Verdict().text() == ""


def test_writing_replaces_in_one_step(page: HtmlReport, tmp_path) -> None:
    path = tmp_path / "report.html"
    path.write_text("old")
    page.write(path)
    assert path.read_text(encoding="utf-8") == page.html()
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]
