"""The rooms of the package, held by reading its source."""

from __future__ import annotations

import ast
import enum
import graphlib
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import clamber
from clamber import _core
from conftest import ROOT

SOURCE = ROOT / "src" / "clamber"
STUB = SOURCE / "__init__.pyi"

NATIVE = ROOT / "src" / "native"
CORE = SOURCE / "_core.pyi"  # typings of the native core, written by hand

# A tower: a floor imports from those below it; its own rooms do not know each other.
FLOORS = [
    ["_core"],  # native, knows nothing of the package
    ["errors"],
    ["model"],
    ["contact"],
    ["recording", "step"],
    ["planning"],
    ["execution"],
    ["run"],
    ["study"],
    ["show"],
    ["", "cli", "__main__"],  # the package itself: its public names
]
FLOOR_OF = {room: i for i, rooms in enumerate(FLOORS) for room in rooms}


def module_of(file: Path) -> str:
    """`step.ik` of src/clamber/step/ik.py, `` of the package's own."""
    parts = file.relative_to(SOURCE).with_suffix("").parts
    return ".".join(p for p in parts if p != "__init__")


FILES = sorted(SOURCE.rglob("*.py"))
TREES = {module_of(f): ast.parse(f.read_text()) for f in FILES}


def imports_of(tree: ast.AST) -> set[str]:
    """The modules of the package that a source imports, wherever in the file."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            for a in node.names:
                name = f"{node.module}.{a.name}"
                is_module = name.removeprefix("clamber.") in {*TREES, "_core"}
                found.add(name if is_module else str(node.module))
    own = {n for n in found if n.split(".")[0] == "clamber"}
    return {n.removeprefix("clamber").removeprefix(".") for n in own}


def upward(module: str, tree: ast.AST) -> list[str]:
    """What a module may not import."""
    own = module.split(".")[0]
    rooms = {used: used.split(".")[0] for used in imports_of(tree)}
    return [
        used
        for used, room in rooms.items()
        if room != own and FLOOR_OF[room] >= FLOOR_OF[own] and own not in FLOORS[-1]
    ]


def test_rooms_import_from_those_below_them_and_never_in_a_circle():
    assert not {m: up for m, t in TREES.items() if (up := upward(m, t))}
    graph = {m: imports_of(t) - {m} for m, t in TREES.items()}
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError with the circle


def test_an_import_that_goes_up_is_seen_wherever_it_is():
    hidden = "def f():\n    from clamber.planning.planner import plan\n"
    assert upward("step.path", ast.parse(hidden)) == ["planning.planner"]
    assert upward("step.path", ast.parse("from clamber import plan")) == [""]
    assert not upward("errors", ast.parse("from clamber import _core"))
    assert not upward("step.path", ast.parse("import clamber.model.se3\nimport numpy"))
    assert imports_of(ast.parse("from clamber.model import se3")) == {"model.se3"}


def test_only_the_command_line_prints_and_no_import_is_hidden_from_the_program():
    for module, tree in TREES.items():
        for node in ast.walk(tree):
            name = getattr(node, "id", getattr(node, "attr", ""))
            assert name != "TYPE_CHECKING", module
            if name == "print" and isinstance(node, ast.Name):
                assert module.startswith("cli"), f"{module}, line {node.lineno}"


def test_no_module_is_shadowed_by_a_function_or_a_public_name():
    for module, tree in TREES.items():
        names = {
            n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)
        }
        assert not module or module.split(".")[-1] not in names, module
        inside = {m.split(".")[-1] for m in TREES if m.rpartition(".")[0] == module}
        assert not module or not inside & names, module
    assert not set(clamber.__all__) & {m.split(".")[0] for m in TREES}


def stub() -> str:
    """What type checkers are told of the public names."""
    homes = sorted(clamber._HOME.items(), key=lambda x: (x[1], x[0]))
    lines = [f"from clamber.{home} import {n} as {n}\n" for n, home in homes]
    return "".join([*lines, "\n__version__: str\n"])


def test_every_public_name_is_found_where_the_package_and_its_stub_say():
    for name, home in clamber._HOME.items():
        value = getattr(clamber, name)
        assert value is getattr(importlib.import_module(f"clamber.{home}"), name)
    assert STUB.read_text() == stub(), f"python {Path(__file__).name} writes it anew"


def names_of(tree: ast.Module | ast.ClassDef) -> dict[str, ast.AST]:
    """What a stub declares, and the members of its classes: `Statics.solve`."""
    found: dict[str, ast.AST] = {}
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = node
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[node.target.id] = node
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{k}": v for k, v in names_of(node).items()}
    return found


def bound_names() -> dict[str, object]:
    """The same of the compiled module; an enumeration's members are attributes."""
    found: dict[str, object] = {}
    for name, value in vars(_core).items():
        if not name.startswith("_"):
            found[name] = value
        if isinstance(value, type):
            own = {k: v for k, v in vars(value).items() if not k.startswith("_")}
            own.pop("value", None)
            if "__init__" in vars(value) and not issubclass(value, enum.Enum):
                own["__init__"] = value.__init__
            found |= {f"{name}.{k}": v for k, v in own.items()}
    return found


def parameters(function: object) -> list[str]:
    """Of a bound function, from nanobind's signature."""
    text = function.__nb_signature__[0][0].split(" -> ")[0]  # type: ignore[attr-defined]
    while text != (flat := re.sub(r"\[[^][]*\]", "", text)):
        text = flat
    inside = text[text.index("(") + 1 : text.rindex(")")].split(", ")
    return [p.split(":")[0] for p in inside if p not in ("", "/", "*")]


def test_typings_of_the_native_core_name_all_that_it_has_and_nothing_else():
    declared, bound = names_of(ast.parse(CORE.read_text())), bound_names()
    assert not declared.keys() ^ bound.keys()
    for name, node in declared.items():
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            assert name.endswith(".__init__") or ast.get_docstring(node), name
        if isinstance(node, ast.FunctionDef) and hasattr(
            bound[name], "__nb_signature__"
        ):
            told = [a.arg for a in (*node.args.args, *node.args.kwonlyargs)]
            takes = parameters(bound[name])
            assert len(told) == len(takes), name
            for a, b in zip(told, takes, strict=True):
                assert a == b or re.fullmatch(r"arg\d*", b), f"{name}: {a}, {b}"


def test_native_sources_are_short_and_the_core_takes_nothing_from_the_package():
    files = [f for f in NATIVE.rglob("*") if f.suffix in {".h", ".cpp"}]
    for file in files:
        if NATIVE / "daqp" not in file.parents:
            lines = file.read_text().splitlines()
            assert len(lines) <= 700, file
            assert max(map(len, lines)) <= 110, file
            assert 'import_("clamber' not in file.read_text(), file


def test_a_name_that_is_not_public_is_named_in_the_error():
    with pytest.raises(AttributeError, match="no attribute 'climb_everest'"):
        _ = clamber.climb_everest


def test_importing_the_package_loads_no_library():
    code = "import sys, clamber; print(*sys.modules)"
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    loaded = set(out.stdout.split())
    own = {m for m in loaded if m.split(".")[0] == "clamber"}
    assert own <= {"clamber", "clamber.model", "clamber.model.shown"}
    libraries = {"numpy", "mujoco", "scipy", "matplotlib", "PIL", "pydantic", "yaml"}
    assert not (libraries | {"tyro", "rich", "viser", "inspect"}) & loaded


def test_the_version_is_written_the_same_everywhere():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == clamber.__version__


def test_every_dependency_has_a_pinned_version():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project, build = settings["project"], settings["build-system"]
    wanted = list(project["dependencies"])
    wanted += build["requires"]
    for extra in project["optional-dependencies"].values():
        wanted += extra
    lines = (ROOT / "constraints.txt").read_text().lower().splitlines()
    pinned = {line.split("==")[0] for line in lines if "==" in line}
    names = {w.split(";")[0].split(">")[0].strip().lower() for w in wanted}
    assert names <= pinned
    assert not [line for line in lines if "://" in line], "no host names"


def test_the_documentation_cites_only_what_it_lists():
    listed = (ROOT / "docs" / "references.md").read_text()
    tag = re.compile(r"\[([A-Z][A-Za-z-]+\d{2})\]")
    texts = [*FILES, *(ROOT / "docs").glob("*.md")]
    cited = {t for f in texts for t in tag.findall(f.read_text())}
    known = set(tag.findall(listed))
    assert cited <= known, f"not in references.md: {sorted(cited - known)}"


if __name__ == "__main__":
    STUB.write_text(stub())
