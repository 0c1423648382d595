"""The rules of the house hold: layers, configs, constraints, a light command line."""

from __future__ import annotations

import ast
import functools
import graphlib
import importlib
import re
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest

import stereophd
from stereophd.config.loading import load_config

ROOT = Path(__file__).resolve().parent.parent
CONFIGS = sorted(ROOT.glob("configs/**/*.yaml"))
SCHEMA_LINE = re.compile(r"# yaml-language-server: \$schema=(\S+)")

# What `stereophd --help` must not load: each costs more than the help itself.
HEAVY = ("matplotlib", "numba", "numpy", "pandas", "pyarrow", "pydantic", "scipy")


# Scripts that no test runs.
SCRIPTS = sorted(path for place in ("benchmarks", "docs", "tests/fuzz") for path in (ROOT / place).rglob("*.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_what_scripts_import_exists(script: Path) -> None:
    for node in ast.walk(ast.parse(script.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "stereophd":
            module = importlib.import_module(str(node.module))
            for name in node.names:
                if not hasattr(module, name.name):
                    importlib.import_module(f"{node.module}.{name.name}")


def test_import_contracts_hold() -> None:
    result = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    contracts = len(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"])
    assert f"Contracts: {contracts} kept, 0 broken." in result.stdout


def test_no_module_imports_itself_through_others() -> None:
    """Imports inside functions count, those for annotations alone do not."""
    imports = {name: _imported_modules(path) for name, path in _modules().items()}
    order = graphlib.TopologicalSorter(imports)
    try:
        order.prepare()
    except graphlib.CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))
    assert sum(map(len, imports.values())) > 1000


@functools.cache
def _tree(path: Path) -> ast.Module:
    """Return a parsed file of the package."""
    return ast.parse(path.read_text())


def _modules() -> dict[str, Path]:
    """Return the modules of the package by name; the public names of the package itself are only pointers."""
    paths = (ROOT / "stereophd").rglob("*.py")
    parts = {path.relative_to(ROOT).with_suffix("").parts: path for path in paths}
    names = {".".join(name[:-1] if name[-1] == "__init__" else name): path for name, path in parts.items()}
    return {name: path for name, path in names.items() if name != "stereophd"}


def _imported_modules(path: Path) -> set[str]:
    """Return the modules of the package that a file imports at run time, wherever in the file."""
    known, imported = _modules_known(), set()
    nodes: list[ast.AST] = [_tree(path)]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            nodes += node.orelse
            continue
        nodes += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names} & known
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            named = {f"{node.module}.{alias.name}" for alias in node.names}
            imported |= named if named <= known else {node.module} & known
    return imported


@functools.cache
def _modules_known() -> frozenset[str]:
    return frozenset(_modules())


def test_there_are_configs() -> None:
    names = {str(path.relative_to(ROOT / "configs")) for path in CONFIGS}
    assert {"quickstart.yaml", "drone.yaml", "paper/multi_object.yaml"} <= names


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_config_loads_as_it_stands(path: Path) -> None:
    first = path.read_text().splitlines()[0]
    line = SCHEMA_LINE.fullmatch(first)
    assert line is not None, f"{path.name} starts with {first!r}"
    assert (path.parent / line[1]).resolve() == ROOT / "configs" / "schema.json"
    loaded = load_config(path)
    assert loaded.cameras
    scenario = None if loaded.config.experiment is None else loaded.config.experiment.scenario.kind
    assert loaded.config.filter is not None or scenario == "move"
    assert loaded.config.simulate is not None or scenario in ("localisation", "tracking", "move")


def test_version_is_one() -> None:
    assert version("stereophd") == stereophd.__version__
    assert f"## {stereophd.__version__}" in (ROOT / "CHANGELOG.md").read_text()


DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "benchmarks/README.md")),
    *sorted(ROOT.glob("docs/**/*.md")),
]
# Records of decisions and measurements tell of the code of their day.
OF_THE_PRESENT = [path for path in DOCUMENTS if "docs/dev/" not in path.as_posix()]


def test_constraints_are_exact_versions_of_all_requirements() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")]
    pinned = set()
    for line in lines:
        match = re.fullmatch(r"([A-Za-z0-9._-]+)==([0-9][A-Za-z0-9.]*)", line)
        assert match is not None, line
        pinned.add(_normalised(match[1]))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = list(project["dependencies"])
    for extra, requirements in project["optional-dependencies"].items():
        wanted += requirements if extra != "all" else []
    for requirement in wanted:
        name = re.match(r"[A-Za-z0-9._-]+", requirement)
        assert name is not None
        assert _normalised(name[0]) in pinned


def _normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.parametrize("module", ["stereophd", "stereophd.cli.app"])
def test_the_command_line_starts_light(module: str) -> None:
    code = f"import sys, {module}; print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(result.stdout.split())
    assert module in loaded
    assert not loaded.intersection(HEAVY)


@pytest.mark.parametrize("target", ["demo", "test"])
def test_readme_names_the_two_commands_and_the_makefile_has_them(target: str) -> None:
    assert f"make {target}" in (ROOT / "README.md").read_text()
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE)


def test_public_definitions_have_docstrings() -> None:
    bare = []
    for path in (ROOT / "stereophd").rglob("*.py"):
        tree = _tree(path)
        bare += [
            f"{path.relative_to(ROOT)}: {node.name}"
            for node in tree.body
            if isinstance(node, ast.FunctionDef | ast.ClassDef)
            and not node.name.startswith("_")
            and not ast.get_docstring(node)
        ]
        if not ast.get_docstring(tree):
            bare.append(f"{path.relative_to(ROOT)}: module")
    assert not bare


def test_public_classes_have_names_of_their_own() -> None:
    """Two public classes of one name would be two meanings of one word."""
    homes: dict[str, list[str]] = {}
    for path in (ROOT / "stereophd").rglob("*.py"):
        for node in _tree(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert {name: files for name, files in homes.items() if len(files) > 1} == {}


def test_nothing_below_the_command_line_names_an_option() -> None:
    """Messages and docstrings name parameters; `stereophd.cli.flags` turns them into options."""
    option = re.compile(r"(?<![-\w])--[a-z]")
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in (ROOT / "stereophd").rglob("*.py")
        if "cli" not in path.relative_to(ROOT / "stereophd").parts
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if option.search(line)
    ]
    assert not found


def test_a_number_and_its_percent_sign_have_a_space_between_them() -> None:
    """Messages and documents write 12 %; Python's own format of percentages does not (use `percent`)."""
    sign = {".py": re.compile(r"\.\d+%\}|\d%[ .,;:)'\"]"), ".md": re.compile(r"\d%")}
    files = [*(ROOT / "stereophd").rglob("*.py"), *DOCUMENTS]
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in files
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if sign[path.suffix].search(line)
    ]
    assert not found


PLACEHOLDERS = re.compile(r"WORD|KIND|NAME|HASH")


def test_modules_that_documents_name_exist() -> None:
    """A path in backticks, such as `multi/pmb/filter.py`, ends the path of a file of the repository."""
    files = {path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*.py") if ".venv" not in path.parts}
    name = re.compile(r"`((?:[\w.-]+/)*[\w-]+\.py)(?:::\w+)?`")
    named = {(path.name, found) for path in OF_THE_PRESENT for found in name.findall(path.read_text())}
    named = {(document, file) for document, file in named if not PLACEHOLDERS.search(file)}
    assert len(named) > 30
    assert {one for one in named if not any(f"/{file}".endswith(f"/{one[1]}") for file in files)} == set()


def test_lines_of_documents_are_at_most_120_characters() -> None:
    """Tables, formulas and commands may be longer."""
    long = []
    for document in DOCUMENTS:
        code = False
        for number, line in enumerate(document.read_text().splitlines(), 1):
            code ^= line.lstrip().startswith("```")
            if len(line) > 120 and not code and not line.lstrip().startswith(("|", "$$", "![", "```")):
                long.append(f"{document.relative_to(ROOT)}:{number}")
    assert len(DOCUMENTS) > 100
    assert long == []


def test_rooms_that_docstrings_name_are_there() -> None:
    """``core.multi.swaps.swap_test`` in backticks is a room or a module, or stands in one."""
    lost, package = [], ROOT / "stereophd"
    for path in package.rglob("*.py"):
        for name in re.findall(r"`(?:stereophd\.)?((?:core|io|pipeline|multi)(?:\.\w+)+)`", path.read_text()):
            parts = name.split(".")
            places = [place.joinpath(*parts) for place in (package, package / "core")]
            files = [file for place in places for file in (place, place.parent, place.parent.parent)]
            if not any(place.is_dir() for place in places) and not any(f.with_suffix(".py").exists() for f in files):
                lost.append(f"{path.relative_to(package)}: {name}")
    assert not lost
