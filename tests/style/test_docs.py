"""The documentation builds without warnings, and its pages load nothing from other hosts."""

from __future__ import annotations

import json
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import unquote

import pytest

import armlab

from ..live.browser.conftest import _chromium, browse  # noqa: F401  fixtures

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
OUTSIDE = re.compile(r"(?:https?:)?//\w")
IN_STYLES = re.compile(r"(?:url\(\s*|@import\s+)[\"']?\s*((?:https?:)?//[^\"')]+)")
IN_SCRIPTS = re.compile(r"(?:fetch|import|importScripts|open|src\s*=|href\s*=)\s*\(?\s*[\"'`]((?:https?:)?//[^\"'`]+)")
LINKS_THAT_LOAD = {
    "stylesheet",
    "preload",
    "prefetch",
    "modulepreload",
    "icon",
    "shortcut",
    "dns-prefetch",
    "preconnect",
}


class Requests(HTMLParser):
    """Collects external addresses that a browser would load by itself; links to click do not count."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self._inside = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self._inside = tag if tag in ("style", "script") else ""
        loads = tag != "link" or set(values.get("rel", "").split()) & LINKS_THAT_LOAD
        names = ["src", "srcset", "data", "poster", *(["href"] if tag in ("link", "use", "image") else [])]
        self.found += [values[name] for name in names if loads and OUTSIDE.match(values.get(name, "").strip())]
        self.found += IN_STYLES.findall(values.get("style", ""))

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        pattern = {"style": IN_STYLES, "script": IN_SCRIPTS}.get(self._inside)
        self.found += pattern.findall(data) if pattern else []


class Links(HTMLParser):
    """The internal links of a page, and its link targets."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.places: set[str] = {""}
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.places |= {values[name] for name in ("id", "name") if name in values}
        links = [values[name] for name in ("href", "src") if values.get(name)]
        self.links += [link for link in links if not re.match(r"[a-z]+:|//", link)]


def outside_requests(name: str, text: str) -> list[str]:
    """Return the external addresses that a page, a style sheet or a script requests."""
    if name.endswith(".css"):
        return IN_STYLES.findall(text)
    if name.endswith(".js"):
        return IN_SCRIPTS.findall(text)
    page = Requests()
    page.feed(text)
    return page.found


@pytest.fixture(scope="module")
def built() -> Path:
    """The pages of `make docs`; those whose sources have not changed are not rebuilt."""
    html = DOCS / "_build" / "html"
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", DOCS, html]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return html


@pytest.mark.slow
def test_the_pages_ask_nobody_outside(built: Path) -> None:
    files = [path for path in built.rglob("*") if path.suffix in (".html", ".css", ".js")]
    assert len([path for path in files if path.suffix == ".html"]) > 25
    asked = {
        str(path.relative_to(built)): found
        for path in files
        if (found := outside_requests(path.name, path.read_text(encoding="utf-8")))
    }
    assert not asked


@pytest.mark.slow
def test_equations_are_mathml(built: Path) -> None:
    page = (built / "theory" / "contact_force.html").read_text(encoding="utf-8")
    assert page.count("<math") > 20
    assert "$" not in re.sub(r"<(script|pre|code)\b.*?</\1>", "", page, flags=re.S)


def test_equations_are_understood() -> None:
    """Checked without a one-minute build: docutils supports less LaTeX than authors know."""
    from docutils.utils.math import MathError, latex2mathml

    refused, count = [], 0
    for page in DOCS.rglob("*.md"):
        text = re.sub(r"^```.*?^```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
        for block, inline in re.findall(r"\$\$(.+?)\$\$|\$([^$\n]+)\$", text, flags=re.S):
            count += 1
            if re.search(r"\\[dt]?frac\s*\d\d", block or inline):
                refused.append(f"{page.relative_to(DOCS)}: {block or inline}: becomes another fraction without braces")
            try:
                latex2mathml.tex2mathml((block or inline).strip(), as_block=bool(block))
            except MathError as error:
                refused.append(f"{page.relative_to(DOCS)}: {block or inline}: {error}")
    assert count > 200
    assert not refused


@pytest.mark.slow
def test_docstrings_are_read_as_they_are_meant(built: Path) -> None:
    """Sections have titles, entries are lists of names with prose, fields of named tuples are not listed twice."""
    text = re.sub(r"<[^>]+>", "", (built / "reference" / "kinematics.html").read_text(encoding="utf-8"))
    assert "Parameters" in text
    assert "q: (..., n) joint positions [rad or m]." in text
    assert "----" not in text
    assert "Alias for field number" not in (built / "reference" / "wire.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_every_public_name_is_in_the_reference(built: Path) -> None:
    reference = "".join(path.read_text(encoding="utf-8") for path in (built / "reference").glob("*.html"))
    missing = []
    for package in (getattr(armlab, name) for name in armlab.__all__):
        for name in package.__all__ if isinstance(package, ModuleType) else ():
            place = rf'id="(module-)?{re.escape(package.__name__)}(\.\w+)*\.{name}["\.]'
            if not re.search(place, reference):
                missing.append(f"{package.__name__}.{name}")
    assert not missing


@pytest.mark.slow
def test_links_between_pages_hold(built: Path) -> None:
    """Files and anchors of links and embedded content; Sphinx checks only what it generates itself."""
    pages = {path: Links(path) for path in built.rglob("*.html")}
    broken = []
    for path, page in pages.items():
        for link in page.links:
            file, _, place = unquote(link).partition("#")
            target = (path.parent / file.partition("?")[0]).resolve() if file else path
            if not target.exists() or (place and target in pages and place not in pages[target].places):
                broken.append(f"{path.relative_to(built)}: {link}")
    assert not broken


@pytest.mark.slow
def test_pages_say_nothing_of_the_machine_that_built_them(built: Path) -> None:
    said = [str(ROOT), str(built), tempfile.gettempdir() + "/", sys.prefix, socket.gethostname() + ":"]
    found = [
        f"{path.relative_to(built)}: {text}"
        for path in built.rglob("*.html")
        for text in said
        if text in path.read_text(encoding="utf-8")
    ]
    assert not found


@pytest.mark.slow
def test_the_library_is_in_the_reference(built: Path) -> None:
    page = (built / "reference" / "robots.html").read_text(encoding="utf-8")
    for name in armlab.robots.names():
        about = armlab.robots.load(name).source.splitlines()[0].removeprefix("robot: ")
        assert page.count(f'<span class="pre">{name}</span>') >= 2, f"{name}: one row and its sources"
        assert about in page


# For a page in the browser: its width beyond the window [pixels], clipped elements, broken images, empty links.
FITS = """(() => {
    const width = document.documentElement.clientWidth, scrolls = element => {
        for (let e = element.parentElement; e; e = e.parentElement)
            if (["auto", "scroll"].includes(getComputedStyle(e).overflowX)) return true;
        return false;
    };
    const cut = [...document.querySelectorAll("article *")].filter(
        e => e.getBoundingClientRect().right > width + 1 && !scrolls(e));
    return {
        wider: document.documentElement.scrollWidth - width,
        cut: cut.slice(0, 3).map(e => e.outerHTML.slice(0, 80)),
        broken: [...document.images].filter(e => e.complete && !e.naturalWidth).map(e => e.src),
        empty: [...document.querySelectorAll("article a[href]")].filter(
            e => !e.textContent.trim() && !e.querySelector("img, svg, object")).map(e => e.href),
    };
})()"""


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1280])
def test_pages_fit_a_telephone_and_a_desk(width: int, built: Path, browse: Callable[[str], Any]) -> None:  # noqa: F811
    page = browse("about:blank")
    page.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=width < 600)
    found = {}
    for path in sorted(path for path in built.rglob("*.html") if "_static" not in path.parts):
        page.errors.clear()
        page.call("Page.navigate", url=path.as_uri())
        page.wait(f"document.readyState === 'complete' && location.pathname.endsWith({json.dumps(path.name)})")
        seen = page.value(FITS) | {"errors": list(page.errors)}
        if seen != {"wider": 0, "cut": [], "broken": [], "empty": [], "errors": []}:
            found[str(path.relative_to(built))] = seen
    page.close()
    assert not found


SEARCH = """
const fs = require("fs"), vm = require("vm"), [folder, ...queries] = process.argv.slice(1);
const page = {window: globalThis, document: {getElementById: () => null}, _: (text) => text};
Object.assign(globalThis, page, {SPHINX_HIGHLIGHT_ENABLED: false, _ready: () => {}});
const read = (name) => fs.readFileSync(`${folder}/${name}`, "utf8");
const code = ["_static/language_data.js", "_static/searchtools.js"].map(read);
vm.runInThisContext([...code, read("searchindex.js"), "globalThis.Search = Search"].join(";"));
const first = (query) => Search._performSearch(...Search._parseQuery(query)).pop()?.[0];
console.log(JSON.stringify(Object.fromEntries(queries.map((query) => [query, first(query)]))));
"""

FOUND = {
    "install": "install",
    "quick start": "quick_start",
    "impedance": "how_to/impedance",
    "impedance control": "how_to/impedance",
    "stiffness": "how_to/impedance",
    "admittance": "how_to/impedance",
    "force": "how_to/contact_force",
    "contact force": "how_to/contact_force",
    "URDF": "how_to/robot_description",
    "calibrate camera": "how_to/calibrate_camera",
    "hand-eye": "how_to/calibrate_camera",
    "inverse kinematics": "how_to/inverse_kinematics",
    "jacobian": "how_to/kinematics",
    "payload": "how_to/weigh_a_load",
    "identification": "how_to/identify",
    "record replay": "how_to/record_and_replay",
    "rosbag": "how_to/read_a_bag",
    "ROS bag": "how_to/read_a_bag",
    "bag file": "how_to/read_a_bag",
    "ABB": "how_to/connect_abb",
    "EGM": "egm",
    "collision": "how_to/force_control",
    "trajectory": "how_to/plan_a_motion",
    "report a bug": "contributing",
    "time synchronisation": "theory/clocks",
    "load URDF": "how_to/robot_description",
    "UR force": "how_to/contact_force",
    "teach": "how_to/record_and_replay",
    "teach motion": "how_to/learn_a_motion",
    "sign of the force": "how_to/contact_force",
    "sign convention": "conventions",
    "hand guiding": "how_to/force_control",
    "weigh": "how_to/weigh_a_load",
    "ROS 2": "ros",
    "notebook": "notebooks/index",
    "wheel": "install",
}


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed, which runs the search of the pages")
def test_the_search_finds_the_right_page_first(built: Path) -> None:
    command = ["node", "-e", SEARCH, str(built), *FOUND]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == FOUND


@pytest.mark.parametrize(
    ("name", "text", "count"),
    [
        ("a.html", '<script src="https://cdn.example/x.js"></script>', 1),
        ("a.html", '<link rel="stylesheet" href="//fonts.example/f.css"><img src="http://x.example/a.png">', 2),
        ("a.html", '<link rel="canonical" href="https://x.example"><a href="https://x.example">read</a>', 0),
        ("a.html", '<style>@import "https://x.example/a.css";</style><script>fetch("https://x.example")</script>', 2),
        ("a.html", '<svg xmlns="http://www.w3.org/2000/svg"></svg><img src="_images/a.png">', 0),
        (
            "a.css",
            "a { src: url('https://x.example/f.woff2') } b { background: url(data:image/png;base64,A) }",
            1,
        ),
        ("a.js", 'import("https://x.example/m.js"); // see https://x.example/docs', 1),
    ],
)
def test_the_search_sees_what_a_browser_would_load(name: str, text: str, count: int) -> None:
    assert len(outside_requests(name, text)) == count


def test_every_fit_has_its_theory() -> None:
    page = (DOCS / "theory" / "index.md").read_text(encoding="utf-8")
    packages = [getattr(armlab, name) for name in armlab.__all__ if isinstance(getattr(armlab, name), ModuleType)]
    fits = {name for package in packages for name in package.__all__ if name.startswith("fit_")}
    assert len(fits) > 15
    assert fits <= set(re.findall(r"\w+", page))
    linked = set(re.findall(r"\]\((\w+\.md)", page))
    assert linked == {path.name for path in (DOCS / "theory").glob("*.md")} - {"index.md"}


def test_commands_of_the_reference_are_those_of_the_program() -> None:
    from armlab.cli import build_app

    page = (DOCS / "reference" / "commands.md").read_text(encoding="utf-8")
    documented = set(re.findall(r"`armlab (\w+)", page))
    assert documented == {name for name in build_app() if not name.startswith("-")}


def test_readme_names_commands_that_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for page in ("README.md", "CONTRIBUTING.md", "docs/quick_start.md", ".github/workflows/ci.yml"):
        text = (ROOT / page).read_text(encoding="utf-8")
        targets = set(re.findall(r"\bmake (\w+)", text))
        assert targets
        for target in targets:
            assert re.search(rf"^{target}:", makefile, flags=re.M), f"{page}: make {target}"


def test_links_between_files_outside_the_pages_hold() -> None:
    """Sphinx checks the pages; these files are read on their own."""
    for page in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        for link in re.findall(r"\]\((?!https?:)([^)#]+)", text):
            assert (ROOT / link).exists(), f"{page}: {link}"


def test_one_version_everywhere() -> None:
    """The package, its citation and the newest entry of the changelog."""
    package = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    newest = re.search(r"^## \[(.+?)\] - (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.M)
    assert newest
    assert f"version: {package}\n" in citation
    assert newest[1] == package
    assert newest[2] == "unreleased" or f"date-released: {newest[2]}\n" in citation
