"""The rules of docs/security.md that can be read from the sources: no input runs as code, nothing listens publicly.

As for the rules of structure, sources are read and never imported.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from .test_architecture import FILES, SOURCE, nodes

RUNS_DATA = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib", "runpy", "code", "ctypes"}
"""Modules by which data can become code."""

NAMES = {"eval", "exec", "compile", "__import__"}

ATTRIBUTES = re.compile(
    r"os\.(system|popen|exec[lv]|spawn|posix_spawn|fork)|builtins\.(eval|exec|compile|__import__)|tempfile\.mktemp$|"
    r"yaml\.(load|load_all|unsafe_\w+|full_\w+)$|subprocess\.get(status)?output$|"
    r".*\.(spec_from_file_location|exec_module|load_module|SourceFileLoader)$"
)
"""Names that run a program or a text, as written, however they are used."""

STARTS_PROGRAMS = {  # file: which
    "bridge/servers/ros1/process.py": "the Python that has rospy, of the system or named in the cell",
    "bridge/servers/supervisor.py": "armlab: a server of the cell",
    "bridge/link.py": "armlab: the simulated robot",
    "cli/bridge.py": "openssl",
    "cli/view.py": "armlab: the demo that is viewed",
    "cli/log.py": "the viewer that the user names, or the first that is installed",
    "log/recording/metadata.py": "git",
}

RUNS_THE_USERS_CODE = {  # file: what the user names on the command line is the user's own program
    "bridge/servers/ros/dds.py": "nothing of a user: ctypes hides the type descriptions of Cyclone DDS",
    "cli/run.py": "the file of a controller; and a prompt after the run, when asked",
}

WIDE = {  # file: why "every address" stands there
    "bridge/cell.py": "named by --listen",
    "bridge/doctor/report.py": "armlab doctor listens where robots send, and never replies",
    "bridge/servers/ros/dds.py": "recognises Cyclone's sockets to narrow them",
    "bridge/servers/zenoh/session.py": "recognises routers that anyone can reach, to refuse them",
    "cli/record.py": "armlab record listens where robots send, and never replies",
    "cli/__init__.py": "an example of a command",
}


def found(path: Path, rule) -> Iterator[str]:
    for node in nodes(path):
        for what in rule(node):
            yield f"{path.relative_to(SOURCE).as_posix()}:{node.lineno}: {what}"  # pyright: ignore


def runs_data(node: ast.AST) -> list[str]:
    """Return names that could turn data into code."""
    if isinstance(node, ast.Import):
        return [one.name for one in node.names if one.name.partition(".")[0] in RUNS_DATA]
    if isinstance(node, ast.ImportFrom) and node.level == 0:
        names = [node.module or "", *(one.name for one in node.names)]
        whole = [f"{node.module}.{one.name}" for one in node.names]
        return [one for one in names if one.partition(".")[0] in RUNS_DATA] + list(filter(ATTRIBUTES.match, whole))
    if isinstance(node, ast.Name):
        return [node.id] if node.id in NAMES else []
    if isinstance(node, ast.Attribute):
        owner = getattr(node.value, "id", "") or getattr(node.value, "attr", "")
        return [name] if ATTRIBUTES.match(name := f"{owner}.{node.attr}") else []
    return []


def starts_programs(node: ast.AST) -> list[str]:
    """Return what starts another program, by module name, so that the rule on shells sees its calls."""
    if isinstance(node, ast.Import):
        return [one.name for one in node.names if one.name == "subprocess"]
    if isinstance(node, ast.ImportFrom) and node.module == "subprocess":
        return ["from subprocess import"]
    if isinstance(node, ast.Attribute):
        return [node.attr] if node.attr.startswith("create_subprocess") else []
    return []


def uses_a_shell(node: ast.AST) -> list[str]:
    """Programs are started with a list of arguments, never a shell command line; NumPy never reads objects."""
    if not isinstance(node, ast.Call) or not node.keywords:
        return []
    starts = ast.unparse(node.func).startswith("subprocess.")
    bad = ("allow_pickle", "shell") if starts else ("allow_pickle",)
    found = {one.arg: ast.unparse(one.value) for one in node.keywords if one.arg in bad}
    return [f"{name}={value}" for name, value in found.items() if value != "False"]


def listens_wide(node: ast.AST) -> list[str]:
    """An address that stands for all interfaces of this computer, or a socket bound to one."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [repr(node.value)] if "0.0.0.0" in node.value else []
    is_bind = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "bind"
    if is_bind and node.args and isinstance(node.args[0], ast.Tuple):  # pyright: ignore
        host = node.args[0].elts[0]  # pyright: ignore
        return ["bind to every address"] if isinstance(host, ast.Constant) and host.value == "" else []
    return []


def reads_without_a_bound(node: ast.AST) -> list[str]:
    """A datagram or stream of a socket is read up to a maximum size."""
    is_read = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
    return [node.func.attr] if is_read and node.func.attr in ("recv", "recvfrom") and not node.args else []  # pyright: ignore


@pytest.mark.parametrize("rule", [runs_data, uses_a_shell])
def test_what_is_read_cannot_run(rule) -> None:
    said = [one for path in FILES for one in found(path, rule)]
    assert [one for one in said if one.partition(":")[0] not in RUNS_THE_USERS_CODE] == []


def test_the_users_own_code_runs_where_it_is_said() -> None:
    for name in RUNS_THE_USERS_CODE:
        assert list(found(SOURCE / name, runs_data))


def test_only_what_is_listed_starts_programs() -> None:
    said = [one for path in FILES for one in found(path, starts_programs)]
    assert sorted({one.partition(":")[0] for one in said}) == sorted(STARTS_PROGRAMS)
    assert {one.rpartition(" ")[2] for one in said} == {"subprocess"}


def test_only_what_is_listed_knows_all_addresses() -> None:
    said = [one for path in FILES for one in found(path, listens_wide)]
    assert sorted({one.partition(":")[0] for one in said}) == sorted(WIDE)


def test_sockets_are_read_up_to_a_size() -> None:
    assert [one for path in FILES for one in found(path, reads_without_a_bound)] == []


BAD = {
    "import pickle": runs_data,
    "from marshal import loads": runs_data,
    "from importlib.util import spec_from_file_location": runs_data,
    "eval('1')": runs_data,
    "os.system('ls')": runs_data,
    "os.execv('/bin/ls', words)": runs_data,
    "os.execlp('ls', 'ls')": runs_data,
    "os.spawnvpe(os.P_WAIT, 'ls', words, {})": runs_data,
    "run = os.popen": runs_data,
    "from os import system": runs_data,
    "from six.moves import cPickle": runs_data,
    "import importlib.util\nimportlib.util.spec_from_file_location('a', path)": runs_data,
    "spec.loader.exec_module(module)": runs_data,
    "builtins.eval('1')": runs_data,
    "from builtins import exec as do": runs_data,
    "do = eval": runs_data,
    "yaml.unsafe_load(text)": runs_data,
    "from subprocess import run": starts_programs,
    "await asyncio.create_subprocess_shell('ls')": starts_programs,
    "subprocess.run('ls', shell=True)": uses_a_shell,
    "np.load(path, allow_pickle=True)": uses_a_shell,
    "one = '0.0.0.0'": listens_wide,
    "one.bind(('', 80))": listens_wide,
    "one.recv()": reads_without_a_bound,
}


def test_the_rules_see_what_they_forbid() -> None:
    assert not [line for line in BAD if not [what for node in ast.walk(ast.parse(line)) for what in BAD[line](node)]]
