"""The rules of structure: layers, owners, sizes, exports, documentation, error sentences, pose names.

They are read from the sources, never imported, so that a broken module cannot hide from them.
Docstrings do not count in the length of a function; everything else does.
"""

from __future__ import annotations

import ast
import gc
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

from armlab.glossary import columns

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "armlab"
GENERATED = {SOURCE / "wire/egm/armlab_egm_pb2.py"}
FILES = sorted(p for p in SOURCE.rglob("*.py") if p not in GENERATED)
TESTS = sorted((ROOT / "tests").rglob("*.py"))

LAYERS = [  # low to high; packages on one line do not import each other
    {"errors", "_display"},
    {"_files", "glossary", "state", "_interrupts", "_numbers"},
    {"kernels"},
    {"lie", "wire"},
    {"robots", "signals"},
    {"kinematics", "models", "log"},
    {"estimation", "dynamics"},
    {"frames"},
    {"calibrate", "identify", "contact", "motion"},
    {"sim", "bridge"},
    {"live", "plots", "fleet"},
    {"cli"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
SAME_LEVEL_ALLOWED = {("models", "kinematics")}
DISK_OWNERS = {"log", "robots", "models", "cli", "fleet"}
BANNED_NAMES = {"utils", "common", "helpers", "core", "base", "misc"}
MAX_FILE, MAX_FUNCTION = 700, 60


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """All nodes of a file: many rules visit them all, and walking the tree costs more than a rule."""
    return tuple(ast.walk(tree(path)))


def package(path: Path) -> str:
    """Name of the layer that owns a file; the top files (`__init__`, `__main__`) may import everything."""
    parts = path.relative_to(SOURCE).parts
    return parts[0].removesuffix(".py")


def imported(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
        return [node.module] + [f"{node.module}.{alias.name}" for alias in node.names]
    return []


def each_file(paths: list[Path]) -> Callable[[Callable[[Path], None]], Callable[[], None]]:
    """Make one test that applies a rule to all files and names violations: 5000 tests would take ten times as long."""

    def decorate(rule: Callable[[Path], None]) -> Callable[[], None]:
        def test() -> None:
            broken = []
            for path in paths:
                try:
                    rule(path)
                except AssertionError as fault:
                    broken.append(f"{relative(path)}: {fault}")
            assert paths
            assert not broken, "\n".join(broken)

        test.__doc__ = rule.__doc__
        return test

    return decorate


def calls(path: Path, *names: str) -> list[ast.Call]:
    found = [n for n in nodes(path) if isinstance(n, ast.Call)]
    return [n for n in found if getattr(n.func, "attr", getattr(n.func, "id", None)) in names]


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield nodes that may contain a function, without expressions: a fifth of the nodes."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt | ast.excepthandler | ast.match_case):
            yield child
            yield from statements(child)


def functions(path: Path) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [n for n in statements(tree(path)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]


def exports(module: ast.Module) -> list[str] | None:
    for node in module.body:
        if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets):
            return [e.value for e in ast.walk(node.value) if isinstance(e, ast.Constant)]
    return None


@each_file(FILES)
def test_imports_point_down(path: Path) -> None:
    me = package(path)
    if me in ("__init__", "__main__"):
        return
    assert me in LEVEL, f"package {me!r} has no layer: add it to design and LAYERS"
    for node in nodes(path):
        assert not (isinstance(node, ast.ImportFrom) and node.level), f"relative import at line {node.lineno}"
        for name in imported(node):
            if not name.startswith("armlab."):
                continue
            other = name.split(".")[1]
            if other == me or other not in LEVEL:
                continue
            down = LEVEL[other] < LEVEL[me] or (me, other) in SAME_LEVEL_ALLOWED
            assert down, f"{me} may not import {other} (line {node.lineno})"


@each_file(FILES)
def test_owners(path: Path) -> None:
    me = package(path)
    for node in nodes(path):
        for name in imported(node):
            root = name.split(".")[0]
            assert "_native" not in name or me == "kernels", "only kernels imports the extension"
            assert root not in ("socket", "socketserver", "asyncio") or me in ("bridge", "sim"), (
                "only bridge and sim open sockets"
            )
            assert root != "matplotlib" or me == "plots", "only plots imports matplotlib"
            assert root != "viser" or me == "live", "only live imports viser"
        if isinstance(node, ast.Call) and me not in DISK_OWNERS | {"glossary"}:
            called = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            touches = called in {"write_text", "write_bytes", "read_text", "read_bytes"} or (
                called == "open" and isinstance(node.func, ast.Name)
            )
            assert not touches, f"{me} touches the disk at line {node.lineno}; only {sorted(DISK_OWNERS)} may"


@each_file([p for p in FILES if package(p) in ("plots", "live")])
def test_heavy_imports_are_lazy(path: Path) -> None:
    for node in tree(path).body:
        for name in imported(node):
            assert name.split(".")[0] not in ("matplotlib", "viser"), (
                f"line {node.lineno}: import it inside the function"
            )


@each_file(FILES + TESTS)
def test_sizes(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MAX_FILE, f"{relative(path)} has more than {MAX_FILE} lines"
    for function in functions(path):
        body = function.body
        documented = ast.get_docstring(function, clean=False) is not None
        first = body[1] if documented and len(body) > 1 else body[0]
        length = (function.end_lineno or 0) - first.lineno + 1
        assert length <= MAX_FUNCTION, f"{function.name} (line {function.lineno}) has {length} lines"


@each_file(FILES)
def test_file_names(path: Path) -> None:
    assert path.stem not in BANNED_NAMES
    assert package(path) not in BANNED_NAMES


@each_file(FILES)
def test_columns_that_are_made_are_in_the_glossary(path: Path) -> None:
    """The unit of a column that any log may have is defined once; users name their own columns."""
    for call in calls(path, "with_column"):
        name = call.args[0]
        if isinstance(name, ast.Constant):
            assert name.value in columns(), f"{name.value!r} at line {call.lineno} is not in glossary.toml"


@each_file(FILES)
def test_modules_and_public_names_are_documented(path: Path) -> None:
    """Names exported by a package are public and have full docstrings; others may have one sentence or none."""
    module = tree(path)
    assert ast.get_docstring(module), "the module has no docstring"
    exported = public_names(package(path)) & set(exports(module) or public_names(package(path)))
    for node in module.body:
        if not isinstance(node, ast.FunctionDef | ast.ClassDef) or node.name not in exported or is_overload(node):
            continue
        methods = node.body if isinstance(node, ast.ClassDef) else []
        named = [one for one in methods if isinstance(one, ast.FunctionDef) and not one.name.startswith("_")]
        for one in (node, *named):
            assert ast.get_docstring(one), f"{one.name} has no docstring"
            if isinstance(one, ast.FunctionDef):
                check_signature(one)


def is_overload(node: ast.FunctionDef | ast.ClassDef) -> bool:
    return any(getattr(one, "id", "") == "overload" for one in node.decorator_list)


@cache
def public_names(layer: str) -> set[str]:
    """Names exported by a package and its subpackages."""
    found = list((SOURCE / layer).rglob("__init__.py")) or [SOURCE / f"{layer}.py"]
    return {name for path in found if path.exists() for name in exports(tree(path)) or []}


def check_signature(node: ast.FunctionDef) -> None:
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    names = {a.arg for a in arguments} | {a.arg for a in (node.args.vararg, node.args.kwarg) if a}
    for argument in arguments:
        assert argument.annotation or argument.arg in ("self", "cls"), f"{node.name}: {argument.arg} is not annotated"
    assert node.returns is not None, f"{node.name}: the return value is not annotated"
    for documented in documented_parameters(ast.get_docstring(node) or ""):
        assert documented in names, f"{node.name} documents {documented!r}, which is not a parameter"


def documented_parameters(docstring: str) -> list[str]:
    """Names in the NumPy section Parameters."""
    match = re.search(r"^Parameters\n-+\n(.*?)(?=^\w[\w ]*\n-+\n|\Z)", docstring, flags=re.M | re.S)
    if not match:
        return []
    lines = [line for line in match[1].splitlines() if line and not line.startswith(" ") and " : " in line]
    return [name.strip().lstrip("*") for line in lines for name in line.split(" : ")[0].split(",")]


@each_file([p for p in FILES if p.name == "__init__.py" and p.parent != SOURCE])
def test_package_exports_are_imported(path: Path) -> None:
    module = tree(path)
    names = exports(module)
    assert names is not None, "__all__ is missing"
    bound: set[str] = set()
    for node in ast.walk(module):
        if isinstance(node, ast.Import | ast.ImportFrom):
            bound |= {alias.asname or alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            bound.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            bound.add(node.id)
    submodules = {p.stem for p in path.parent.glob("*.py")} | {p.name for p in path.parent.iterdir() if p.is_dir()}
    missing = [name for name in names if name not in bound | submodules]
    assert not missing, f"{missing} are exported but do not exist"


@each_file([p for p in FILES if p.name == "__init__.py" and "__getattr__" in {f.name for f in functions(p)}])
def test_what_is_imported_on_first_use_is_not_hidden_by_a_module(path: Path) -> None:
    """Importing `armlab.sim.x` binds the module to that name of the package, and `sim.x` is no longer a function."""
    modules = {p.stem for p in path.parent.iterdir()}
    for node in nodes(path):
        if isinstance(node, ast.ImportFrom) and (SOURCE.parent / (node.module or "").replace(".", "/")) != path.parent:
            hidden = {alias.name for alias in node.names} & modules
            assert not hidden, f"{hidden} of {node.module} and a module have one name: rename the module"


@each_file([p for p in FILES if p.name == "__init__.py" and p.parent.parent == SOURCE])
def test_every_public_name_is_tested(path: Path) -> None:
    """Somewhere in the tests of its package, or of the whole project (laws, contract)."""
    folders = [ROOT / "tests" / folder for folder in (path.parent.name, "laws", "style")]
    words = {word for folder in folders for test in folder.rglob("*.py") for word in re.findall(r"\w+", source(test))}
    missing = sorted(public_names(path.parent.name) - words)
    assert not missing, f"{missing} do not appear in tests/{path.parent.name}"


@cache
def source(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@each_file(FILES)
def test_validation_raises_sentences(path: Path) -> None:
    for node in nodes(path):
        assert not isinstance(node, ast.Assert), f"assert at line {node.lineno}: validation raises"
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            check_sentence(node.exc, path)


@cache
def errors() -> set[str]:
    return {n.name for n in tree(SOURCE / "errors.py").body if isinstance(n, ast.ClassDef)}


def check_sentence(call: ast.Call, path: Path) -> None:
    name = call.func.id if isinstance(call.func, ast.Name) else ""
    if name not in errors() or not call.args:
        return
    pieces = [n.value for n in ast.walk(call.args[0]) if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    if not pieces or not isinstance(call.args[0], ast.Constant | ast.JoinedStr):
        return
    text = " ".join(pieces)
    where = f"{relative(path)}:{call.lineno}"
    assert len(text.split()) >= 5, f"{where}: {text!r} is not a sentence"
    last = call.args[0].values[-1] if isinstance(call.args[0], ast.JoinedStr) else call.args[0]
    if isinstance(last, ast.Constant):
        assert str(last.value).rstrip().endswith((".", "`", '"')), (
            f"{where}: the sentence does not end with a full stop"
        )


@each_file(FILES + TESTS)
def test_pose_products_match(path: Path) -> None:
    for node in nodes(path) if re.search(r"T_\w+ @|@ [\w.]*T_", source(path)) else ():
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            left, right = pose_frames(node.left), pose_frames(node.right)
            if left and right:
                assert left[1] == right[0], f"line {node.lineno}: T_{'_'.join(left)} @ T_{'_'.join(right)}"


def pose_frames(node: ast.AST) -> tuple[str, str] | None:
    """Frames (a, b) of a name T_a_b; of a product, those of its nearer factor."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
        left, right = pose_frames(node.left), pose_frames(node.right)
        return (left[0], right[1]) if left and right else None
    name = node.id if isinstance(node, ast.Name) else getattr(node, "attr", "")
    match = re.fullmatch(r"T_([a-z0-9]+)_([a-z0-9]+)", name)
    return (match[1], match[2]) if match else None


def test_import_armlab_is_light() -> None:
    """`import armlab` loads NumPy at most; `armlab --help` loads no numerical package."""
    heavy = "scipy matplotlib mujoco mcap rosbags google.protobuf viser"
    code = f"import sys, armlab; print([m for m in {heavy.split()} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
    code = (
        "import sys, contextlib, io\nfrom armlab.cli import main\n"
        "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n    main(['--help'])\n"
        f"print([m for m in {heavy.split()} if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize("layer", ["contact", "identify", "bridge", "estimation", "models"])
def test_the_estimator_never_sees_the_truth(layer: str) -> None:
    """Only the log received over the wire: no file of these packages names the simulator's package."""
    for path in (SOURCE / layer).rglob("*.py"):
        assert not re.search(r"armlab\.sim|from armlab import .*\bsim\b", path.read_text(encoding="utf-8")), relative(
            path
        )


def test_the_rules_can_fail() -> None:
    """The pose rule and the parameter parser detect what they must detect."""
    bad = ast.parse("T_base_tool @ T_cam_marker").body[0].value  # type: ignore[attr-defined]
    assert pose_frames(bad.left)[1] != pose_frames(bad.right)[0]  # type: ignore[index]
    good = ast.parse("T_a_b @ T_b_c").body[0].value  # type: ignore[attr-defined]
    assert pose_frames(good) == ("a", "c")
    assert documented_parameters(
        "x\n\nParameters\n----------\nq, qd : (n,) a\n    more : no\n\nReturns\n-------\nz : b"
    ) == ["q", "qd"]
    with pytest.raises(AssertionError, match=r"(?s)test_architecture.py: it has a test\n.*errors.py: has none"):
        each_file([Path(__file__), SOURCE / "errors.py"])(rule_that_fails)()


@pytest.fixture(scope="module", autouse=True)
def without_garbage() -> Iterator[None]:
    """Millions of nodes stay in memory: collecting garbage among them takes as long as the rules."""
    gc.disable()
    yield
    gc.enable()


def rule_that_fails(path: Path) -> None:
    assert not path.exists(), "it has a test" if path.name.startswith("test_") else "has none"


@each_file([p for p in TESTS if p.parent.name in ("robots", "kinematics", "kernels", "lie", "laws")])
def test_an_absolute_tolerance_is_the_whole_tolerance(path: Path) -> None:
    """`assert_allclose(a, b, atol=1e-12)` keeps rtol=1e-7, which is 1e5 times wider for numbers near 1."""
    for call in calls(path, "assert_allclose"):
        said = {keyword.arg for keyword in call.keywords}
        assert "atol" not in said or "rtol" in said, f"{relative(path)}:{call.lineno}: say rtol beside atol"
