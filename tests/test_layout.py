"""The layers of the package, held by reading its source."""

from __future__ import annotations

import ast
import graphlib
import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import clamber
from conftest import ROOT

SOURCE = ROOT / "src" / "clamber"

# Each may import only from those before it.
LAYERS = [
    "errors",
    "se3",
    "markup",
    "mesh_files",
    "description",
    "boxes",
    "scene",
    "contact",
    "model",
    "anatomy",
    "proposal",
    "disturbance",
    "truth",
    "sensing",
    "leaning",
    "statics",
    "balance",
    "demo",
    "detect",
    "scaling",
    "policy",
    "moves",
    "posture",
    "transition",
    "path",
    "search",
    "retiming",
    "trajectory",
    "pipeline",
    "exploration",
    "checkup",
    "route",
    "stairs",
    "build",
    "traverse",
    "control",
    "terrain",
    "adaptation",
    "execution",
    "simulation",
    "alternatives",
    "contraction",
    "job",
    "success",
    "experiment",
    "io",
    "sweep",
    "export",
    "viz",
    "curves",
    "policy_plots",
    "meshes",
    "motion",
    "report",
    "view",
    "",  # the package itself: its public names
    "terminal",
    "cli",
]

FILES = sorted(SOURCE.rglob("*.py"))


def module_of(file: Path) -> str:
    """`posture.ik` of src/clamber/posture/ik.py, `` of the package's own."""
    parts = file.relative_to(SOURCE).with_suffix("").parts
    return ".".join(p for p in parts if p != "__init__")


MODULES = {module_of(f) for f in FILES}


def imports_of(tree: ast.AST) -> set[str]:
    """The modules of the package that a source imports, wherever in the file."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            found |= {
                f"{node.module}.{a.name}"
                if f"{node.module}.{a.name}".removeprefix("clamber.") in MODULES
                else str(node.module)
                for a in node.names
            }
    own = {n for n in found if n.split(".")[0] == "clamber"}
    return {n.removeprefix("clamber").removeprefix(".") for n in own}


TREES = {module_of(f): ast.parse(f.read_text()) for f in FILES}
each_module = pytest.mark.parametrize("module", sorted(TREES))


def layer(module: str) -> str:
    return module.split(".")[0]


@each_module
def test_a_module_imports_only_from_the_layers_above_it(module: str):
    assert layer(module) in LAYERS, f"{module} has no place in the list of layers"
    rank = LAYERS.index(layer(module))
    for used in imports_of(TREES[module]):
        if layer(used) != layer(module):
            assert layer(used) in LAYERS, f"{used} has no place in the list of layers"
            assert LAYERS.index(layer(used)) < rank, f"{module} may not import {used}"


def test_no_modules_import_each_other_in_a_circle():
    graph = {m: imports_of(t) - {m} for m, t in TREES.items()}
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError with the circle


def test_the_layer_test_sees_an_import_that_goes_up():
    inside = ast.parse("def f():\n    from clamber.pipeline import plan\n")
    assert imports_of(inside) == {"pipeline"}
    assert LAYERS.index("pipeline") > LAYERS.index("errors")
    assert imports_of(ast.parse("import clamber.se3\nimport numpy")) == {"se3"}
    assert imports_of(ast.parse("from clamber import scene, plan")) == {"scene", ""}


@each_module
def test_no_import_is_hidden_from_the_running_program(module: str):
    names = {n.id for n in ast.walk(TREES[module]) if isinstance(n, ast.Name)}
    names |= {n.attr for n in ast.walk(TREES[module]) if isinstance(n, ast.Attribute)}
    assert "TYPE_CHECKING" not in names


@each_module
def test_only_the_command_line_prints(module: str):
    if module == "cli":
        return
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id != "print", f"{module}, line {node.lineno}"


@each_module
def test_no_module_shares_its_name_with_a_function_it_exports(module: str):
    body = TREES[module].body
    defined = {
        n.name for n in body if isinstance(n, ast.FunctionDef | ast.ClassDef)
    } | {
        a.asname or a.name
        for n in body
        if isinstance(n, ast.ImportFrom)
        for a in n.names
    }
    assert module.split(".")[-1] not in defined or module == ""
    children = {m.split(".")[-1] for m in MODULES if m.rpartition(".")[0] == module}
    functions = {n.name for n in body if isinstance(n, ast.FunctionDef)}
    assert not children & functions, "a module is shadowed by a function of its package"


def test_no_public_name_is_that_of_a_module():
    assert not set(clamber.__all__) & {m.split(".")[0] for m in MODULES}


def test_every_public_name_is_found_where_the_package_says():
    for name, home in clamber._HOME.items():
        value = getattr(clamber, name)
        assert value is getattr(importlib.import_module(f"clamber.{home}"), name)


def test_a_name_that_is_not_public_is_named_in_the_error():
    with pytest.raises(AttributeError, match="no attribute 'climb_everest'"):
        _ = clamber.climb_everest


def test_type_checkers_are_told_the_same_names():
    stub = ast.parse((SOURCE / "__init__.pyi").read_text())
    homes = {
        alias.asname: str(node.module).removeprefix("clamber.")
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert homes == clamber._HOME


def test_importing_the_package_loads_no_library():
    code = "import sys, clamber; print(*sys.modules)"
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert not {"numpy", "mujoco", "scipy", "matplotlib"} & set(out.stdout.split())


def test_the_version_is_written_the_same_everywhere():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == clamber.__version__


def test_every_dependency_has_a_pinned_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = list(project["dependencies"])
    for extra in project["optional-dependencies"].values():
        wanted += extra
    lines = (ROOT / "constraints.txt").read_text().lower().splitlines()
    pinned = {line.split("==")[0] for line in lines if "==" in line}
    names = {w.split(";")[0].split(">")[0].strip().lower() for w in wanted}
    assert names <= pinned
    assert not [line for line in lines if "://" in line], "no host names"


def test_the_documentation_cites_only_what_it_lists():
    import re

    listed = (ROOT / "docs" / "references.md").read_text()
    tag = re.compile(r"\[([A-Z][A-Za-z-]+\d{2})\]")
    texts = [*FILES, *(ROOT / "docs").glob("*.md")]
    cited = {t for f in texts for t in tag.findall(f.read_text())}
    known = set(tag.findall(listed))
    assert cited <= known, f"not in references.md: {sorted(cited - known)}"
