"""Every program on a page runs: the blocks of one page in order, in one namespace, in an empty folder."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import armlab
from armlab import plots, robots
from armlab.lie import quaternion

DOCS = Path(__file__).parents[2] / "docs"
BLOCK = re.compile(r"^```python\n(.*?)^```$", flags=re.M | re.S)


def programs(page: Path) -> list[str]:
    """Return the code blocks of a page, padded with empty lines so that tracebacks give the line on the page."""
    text = page.read_text(encoding="utf-8")
    return ["\n" * text[: found.start(1)].count("\n") + found[1] for found in BLOCK.finditer(text)]


NAME = re.compile(r"\b(bridge|calibrate|dynamics|identify|kinematics|lie|log|motion|robots)((?:\.\w+)+)\(?")
HOW_TO = [page for page in sorted((DOCS / "how_to").glob("*.md")) if page.stem != "index"]
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if "_build" not in page.parts and programs(page)]


def peers() -> dict[str, Any]:
    """Return the arm of the Conventions page as Pinocchio and MuJoCo models."""
    import mujoco
    import pinocchio as pin

    robot = robots.load("yumi_right")
    robots.save(robot, "arm.urdf")
    model = pin.buildModelFromUrdf("arm.urdf")
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for T in robot.frames[:-1]:
        quat = quaternion.from_matrix(T[:3, :3])
        body = body.add_body(pos=T[:3, 3], quat=quat, mass=1.0, inertia=[1.0, 1.0, 1.0], explicitinertial=True)
        body.add_joint(axis=[0, 0, 1])
    quat = quaternion.from_matrix(robot.frames[-1][:3, :3])
    body.add_site(name="tool", pos=robot.frames[-1][:3, 3], quat=quat)
    mj_model = spec.compile()
    return {
        "pin_model": model,
        "pin_data": model.createData(),
        "mj_model": mj_model,
        "mj_data": mujoco.MjData(mj_model),
    }


NAMES: dict[str, Callable[[], dict[str, Any]]] = {"conventions.md": peers}


SLOW = ("robotlab", "from_robotlib", "watch_in_the_browser")  # they identify a whole arm, or wait


@pytest.mark.parametrize(
    "page", [pytest.param(page, id=page.stem, marks=pytest.mark.slow if page.stem in SLOW else ()) for page in PAGES]
)
def test_programs_of_a_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    namespace = NAMES.get(page.name, dict)()
    for program in programs(page):
        exec(compile(program, str(page), "exec"), namespace)


def test_names_for_users_of_other_programs_exist() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in (DOCS / "coming_from").glob("*.md"))
    names = {name for code in re.findall(r"`([^`\n]+)`", text) for name in NAME.findall(code)}
    assert len(names) > 40
    for package, path in names:
        thing = getattr(armlab, package)
        for part in path.strip(".").split("."):
            thing = getattr(thing, part)


@pytest.mark.parametrize("name", ["yumi_left", "yumi_right"])
def test_the_functions_of_robotlib_agree_with_each_other(name: str) -> None:
    """The promise of the original, whose ikine fails for a YuMi and whose ikine(fkine(q)) is off by 1 rad elsewhere."""
    (recipe,) = [program for program in programs(DOCS / "how_to" / "kinematics.md") if "fkine" in program]
    found: dict[str, Any] = {}
    exec(recipe.replace("yumi_left", name), found)
    robot = robots.load(name)
    rng = np.random.default_rng(1)
    T = found["fkine"](rng.uniform(robot.q_min, robot.q_max, (50, robot.n)))
    q = found["ikine"](T)
    assert q.success.all()
    assert np.abs(found["fkine"](q.q) - T).max() < 2e-9
    step = 1e-6 * rng.standard_normal(robot.n)
    ahead, behind = found["fkine"](q.q[0] + step), found["fkine"](q.q[0] - step)
    assert (ahead - behind)[:3, 3] == pytest.approx(2 * found["jacobian"](q.q[0])[:3] @ step, abs=1e-13)


def test_a_how_to_shows_a_program_that_runs() -> None:
    """A page shows a file of examples/ (run by tests/examples), code blocks (run here), or valid settings."""
    for page in HOW_TO:
        text = page.read_text(encoding="utf-8")
        shown = re.findall(r"literalinclude\} \.\./\.\./(examples/\w+\.py)", text)
        settings = [tomllib.loads(block) for block in re.findall(r"^```toml\n(.*?)^```$", text, flags=re.M | re.S)]
        assert shown or programs(page) or any(settings), page.stem
        assert all((DOCS.parent / name).exists() for name in shown), page.stem


def test_commands_on_the_pages_are_those_of_the_program() -> None:
    """Verbs and options of every indented line that calls armlab; the work itself is tested elsewhere."""
    from armlab.cli import build_app
    from armlab.cli.support.options import take_robot_options

    app, lines = build_app(), []
    for page in DOCS.rglob("*.md"):
        lines += re.findall(r"^ {4}(?:\.venv/bin/)?armlab (.+)$", page.read_text(encoding="utf-8"), flags=re.M)
    assert len(lines) > 8
    for line in lines:
        words = take_robot_options(line.split("#")[0].split())
        command, _, ignored = app.parse_args(words, exit_on_error=False, print_error=False)
        assert command.__module__.startswith("armlab.cli"), line
        assert not ignored, line
    take_robot_options([])


SHOWN = re.compile(
    r"^### (\w+)\n.*?^```\{literalinclude\} (\S+)\n.*?^:start-at: (.+?)\n:end-at: (.+?)\n"
    r".*?^```\{figure\} _figures/(\S+)$",
    flags=re.M | re.S,
)


def test_every_figure_is_shown_with_the_line_that_draws_it() -> None:
    shown = SHOWN.findall((DOCS / "gallery.md").read_text(encoding="utf-8"))
    names = [name for name, *_ in shown]
    assert sorted(names) == sorted(plots.__all__)
    for name, source, start, end, picture in shown:
        lines = (DOCS / source).read_text(encoding="utf-8").splitlines()
        first = next(k for k, line in enumerate(lines) if start in line)
        last = next(k for k, line in enumerate(lines[first:], first) if end in line)
        assert any(f"plots.{name}(" in line for line in lines[first : last + 1]), f"{name}: another line"
        written = (picture, re.sub(r"\d", "{number}", picture))
        assert any(word in line for word in written for line in lines), f"{name}: {source} does not write {picture}"
