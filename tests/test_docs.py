"""Every block of code in README and docs is run, or at least read by who must read it.

Blocks of a page run in order, in a folder of their own that holds a run, `runs/climb`,
and the examples. A comment before a block says what else is to be done with it:

    <!-- file: scene.yaml -->    the block is written to that file, for those after it
    <!-- slow: why -->           run by the slow tests alone
    <!-- read only: why -->      not run: its commands are parsed, its Python compiled
    <!-- exit 1 -->              the commands end with this code
"""

from __future__ import annotations

import ast
import contextlib
import functools
import importlib.metadata
import importlib.util
import io as text_io
import json
import os
import re
import runpy
import shlex
import shutil
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from PIL import Image

import clamber
from clamber import cli
from clamber.cli import parse
from clamber.errors import InputError
from conftest import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RUN, YAML = ("sh", "console", "python"), ("yaml",)
REST = ("text", "math", "cpp")
NOTE = re.compile(r"<!-- (file|slow|read only|exit):? ?(.*?) -->")
# Programs other than clamber that pages name; their lines are not run.
FOREIGN = {"make", "pip", "python", "dask", "source", "git", "cd"}


@dataclass(frozen=True)
class Block:
    """A fenced block: where it begins, its language, what comments say of it."""

    page: Path
    line: int
    language: str
    text: str
    notes: dict[str, str]

    @property
    def place(self) -> str:
        return f"{self.page.name}, line {self.line}"


def blocks(page: Path) -> list[Block]:
    """The blocks of a page.

    Raises:
        ValueError: Code that is not fenced, a fence without a language that is known,
            or a note that belongs to no block.
    """
    found, notes, body, start, language = [], {}, None, 0, ""
    before, listed = "", False
    for number, line in enumerate(page.read_text().splitlines(), start=1):
        where = f"{page.name}, line {number}"
        fence = re.match(r"\s*```(.*)$", line)
        if fence and body is None:
            language, body, start = fence[1].strip(), [], number
            if language not in (*RUN, *YAML, *REST):
                raise ValueError(f"{where}: a language, not {language!r}")
        elif fence:
            found.append(Block(page, start, language, "\n".join(body), notes))
            notes, body = {}, None
        elif body is not None:
            body.append(line)
        elif note := NOTE.fullmatch(line.strip()):
            notes[note[1]] = note[2].strip()
        elif line.strip():
            if notes:
                raise ValueError(f"{where}: no block follows {notes}")
            # Indented text after an empty line is code, but for that of a list.
            if line.startswith("    ") and not before and not listed:
                raise ValueError(f"{where}: code that is not fenced")
            if not line.startswith(" "):
                listed = bool(re.match(r"([-*:]|\d+\.) ", line))
        before = line
    if body is not None:
        raise ValueError(f"{page.name}, line {start}: a fence that is not closed")
    return found


def commands(text: str) -> list[list[str]]:
    """The words of each command of a shell block, comments and prompts left out."""
    text = re.sub(r"\\\n\s*", " ", text)
    found = []
    for line in text.splitlines():
        words = shlex.split(line, comments=True)
        while words and re.fullmatch(r"[A-Z_0-9]+=\S*", words[0]):
            words.pop(0)
        if words:
            found.append(words)
    return found


def transcript(text: str) -> list[tuple[list[str], list[str]]]:
    """Each command of a console block after its prompt, with what it prints."""
    found: list[tuple[list[str], list[str]]] = []
    for line in text.splitlines():
        if line.startswith("$ "):
            found.append((shlex.split(line[2:], comments=True), []))
        else:
            found[-1][1].append(line)
    return found


@functools.cache
def flags_of(command: str) -> frozenset[str]:
    """The flags that the help of a command lists."""
    out = text_io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        cli.main([command, "--help"])
    return frozenset(re.findall(r"--[a-z][\w.-]*", out.getvalue()))


COMMANDS = frozenset(cli.COMMANDS)


def check_command(words: Sequence[str]) -> None:
    """Have the words of a command read by who reads them, without doing anything.

    Raises:
        InputError: There is no such command, flag or value, target, extra or file.
    """
    program, *rest = words
    if program == "clamber":
        if {"--version", "--help", "--tyro-print-completion"} & set(rest):
            return
        if rest[0] in ("--json", "--quiet"):
            rest = [*rest[1:], rest[0]]
        parse([w for w in rest if w not in (">", "|")][: _redirected(rest)])
    elif program == "make":
        known = re.findall(r"^([a-z0-9-]+):", (ROOT / "Makefile").read_text(), re.M)
        for target in rest:
            if "=" not in target and target not in known:
                raise InputError("a target of the Makefile", value=target)
    elif program == "pip":
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        extras = set(project["optional-dependencies"])
        for found in re.findall(r"\[([\w,]+)\]", " ".join(rest)):
            if not set(found.split(",")) <= extras:
                raise InputError(f"extras {sorted(extras)}", value=found)
    elif program == "python" and rest[0] == "-c":
        compile(rest[1], "<docs>", "exec")
    elif program == "python" and rest[0].endswith(".py"):
        if not (ROOT / rest[0]).is_file():
            raise InputError("a file of the repository", value=rest[0])
    elif program not in FOREIGN:
        raise InputError(f"clamber or one of {sorted(FOREIGN)}", value=program)


def _redirected(words: Sequence[str]) -> int:
    """How many words come before `>` or `|`."""
    ends = [i for i, w in enumerate(words) if w in (">", "|")]
    return min(ends, default=len(words))


def read_yaml_block(block: Block, folder: Path) -> None:
    """Have a YAML block read by the reader that its fields belong to."""
    from clamber.model.robot import RobotFile
    from clamber.model.terrain import SceneFile
    from clamber.recording.recording import RecordingFile
    from clamber.run.state import StateFile
    from clamber.study.spec import Spec, next_runs, strands

    fields = yaml.safe_load(block.text)
    assert isinstance(fields, dict), block.place
    names = set(fields)
    if names & {"limbs", "surfaces"}:
        RobotFile.model_validate(fields)
    elif "joints" in names:
        StateFile.model_validate(fields)
    elif "file" in names:
        RecordingFile.model_validate(fields)
    elif names & {"boxes", "ground"}:
        SceneFile.model_validate(fields).scene(folder)
    elif names & {"meshes", "heightfields"}:  # of files that a reader has
        SceneFile.model_validate(fields)
    elif names & {"about", "grid", "random", "search", "controllers"}:
        fields.setdefault("base", {"height": 0.275})
        if not names & {"grid", "random", "search"}:
            fields["grid"] = {"disturb.seed": [0]}
        spec = Spec.model_validate(fields)
        for strand in strands(spec):
            assert next_runs(spec, strand, [], {}), block.place
    else:  # joint angles of a lead-in
        robot = clamber.load_robot("coman")
        world = clamber.build_world(robot, clamber.Scene.from_height(0.275))
        assert names <= set(world.joints), block.place
        assert all(isinstance(v, float) for v in fields.values()), block.place


@dataclass
class Session:
    """What the blocks of one page share: a folder, and the names that Python has."""

    names: dict[str, object]

    def do(self, words: Sequence[str]) -> tuple[int, str]:
        """Run one command; what it prints on stdout."""
        out = text_io.StringIO()
        with contextlib.redirect_stdout(out):
            if words[0] == "clamber":
                end = _redirected(words)
                with pytest.MonkeyPatch.context() as patch:
                    if words[1] == "view":  # a person looks, and presses Ctrl-C
                        pytest.importorskip("viser")
                        stub = SimpleNamespace(sleep=_interrupted)
                        patch.setattr(cli.tools, "time", stub)
                    code = cli.main(list(words[1:end]))
            elif words[:2] == ["python", "-c"]:
                exec(compile(words[2], "<docs>", "exec"), {})
                code = 0
            else:
                program, script, *arguments = words
                assert program == "python", f"{program} is not run: a note must say so"
                with pytest.MonkeyPatch.context() as patch:
                    patch.setattr(sys, "argv", [script, *arguments])
                    runpy.run_path(script, run_name="__main__")
                code = 0
        return code, out.getvalue()


def _interrupted(_: float) -> None:
    raise KeyboardInterrupt


def run_block(block: Block, session: Session) -> None:
    """Run a block, and compare what it prints with what it is said to print."""
    if block.language == "yaml":
        read_yaml_block(block, Path.cwd())
        return
    if block.language == "python":
        out = text_io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compile(block.text, block.place, "exec"), session.names)
        return
    if block.language == "sh":
        steps = [(words, None) for words in commands(block.text)]
    else:
        steps = transcript(block.text)
    wanted = int(block.notes.get("exit", 0))
    for words, printed in steps:
        check_command(words)
        code, out = session.do(words)
        assert code == wanted, f"{block.place}: {' '.join(words)} ended with {code}"
        if printed is not None:
            compare(printed, out.splitlines(), block.place)


def compare(said: Sequence[str], printed: Sequence[str], place: str) -> None:
    """Lines that are said to be printed, in order; `...` stands for any."""
    left = [" ".join(line.split()) for line in printed]
    for line in said:
        if line.strip() == "...":
            continue
        words = re.escape(" ".join(line.split())).replace(r"\.\.\.", ".*")
        fits = [i for i, x in enumerate(left) if re.fullmatch(words, x)]
        assert fits, f"{place}: nothing printed is {line!r}; there is {printed}"
        left = left[fits[0] + 1 :]


def check_block(block: Block) -> None:
    """What can be said of a block without running it."""
    if block.language == "python":
        tree = ast.parse(block.text)
        public = set(clamber.__all__)
        for node in ast.walk(tree):
            if (
                isinstance(node, ast.Attribute)
                and isinstance(node.value, ast.Name)
                and node.value.id == "clamber"
            ):
                home = importlib.util.find_spec(f"clamber.{node.attr}")
                assert node.attr in public or home, f"{block.place}: {node.attr}"
    elif block.language == "sh":
        assert commands(block.text), block.place
        for words in commands(block.text):
            check_command(words)
    elif block.language == "console":
        for words, _ in transcript(block.text):
            check_command(words)
    elif block.language == "math":
        mathml_of(block.text)
    elif block.language == "text":
        assert not re.match(r"(\$ |clamber |make |pip |import )", block.text), (
            f"{block.place} is no text"
        )


def mathml_of(text: str) -> str:
    """As the site's hook makes it."""
    path = ROOT / "docs" / "tools" / "mathml.py"
    spec = importlib.util.spec_from_file_location("mathml", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.mathml(text)


@pytest.fixture(scope="session")
def climb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a fast climb, with its pictures, made once."""
    folder = tmp_path_factory.mktemp("docs") / "climb"
    assert cli.main(["climb", "--speed", "max", "--quiet", "--out", str(folder)]) == 0
    return folder


@contextlib.contextmanager
def page_folder(page: Path, folder: Path, climb: Path) -> Iterator[Session]:
    """The current folder of a page's blocks."""
    shutil.copytree(climb, folder / "runs" / "climb")
    shutil.copytree(climb, folder / "runs" / "climb-2")
    (folder / "examples").symlink_to(ROOT / "examples")
    here = Path.cwd()
    os.chdir(folder)
    try:
        yield Session(names={"__name__": "__docs__"})
    finally:
        os.chdir(here)


def play(page: Path, folder: Path, climb: Path, slow: bool) -> int:
    """Run the blocks of a page; how many ran."""
    done = 0
    with page_folder(page, folder, climb) as session:
        for block in blocks(page):
            check_block(block)
            if "file" in block.notes:
                Path(block.notes["file"]).write_text(block.text + "\n")
            skipped = "read only" in block.notes or ("slow" in block.notes and not slow)
            if block.language in (*RUN, *YAML) and not skipped:
                run_block(block, session)
                done += 1
    return done


def ids(page: Path) -> str:
    return page.stem


@pytest.mark.docs
@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_the_blocks_of_a_page_do_what_they_say(page: Path, tmp_path: Path, climb: Path):
    play(page, tmp_path, climb, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [p for p in PAGES if "<!-- slow" in p.read_text()], ids=ids
)
def test_the_slow_blocks_do_too(page: Path, tmp_path: Path, climb: Path):
    assert play(page, tmp_path, climb, slow=True)


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_a_block_that_is_not_run_says_why(page: Path):
    for block in blocks(page):
        for kind in ("slow", "read only"):
            if kind in block.notes:
                assert len(block.notes[kind].split()) >= 2, f"{block.place}: {kind}"
        others = [w[0] for w in commands(block.text)] if block.language == "sh" else []
        if set(others) - {"clamber", "python"}:
            assert "read only" in block.notes, (
                f"{block.place}: {others} are not run, which a note must say"
            )


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_commands_within_the_text_exist(page: Path):
    prose = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    for span in re.findall(r"`(clamber [^`]+)`", prose):
        words = span.replace("|", " ").split()
        if words[1] in ("COMMAND", "..."):  # any of them
            continue
        if words[1].startswith("--"):
            assert words[1] in ("--help", "--version", "--tyro-print-completion"), span
            continue
        assert words[1] in COMMANDS, f"{page.name}: {span}"
        for word in words[2:]:
            if word.startswith("--") and word not in ("--help", "--version"):
                assert word in flags_of(words[1]), f"{page.name}: {span}"


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("    clamber climb\n", "code that is not fenced"),
        ("```\nclamber climb\n```\n", "a language"),
        ("```bash\nclamber climb\n```\n", "a language"),
        ("```sh\nclamber climb\n", "not closed"),
        ("<!-- slow: it takes long -->\ntext\n", "no block follows"),
    ],
)
def test_no_block_slips_by(text: str, fault: str, tmp_path: Path):
    (tmp_path / "page.md").write_text(f"# Page\n\n{text}")
    with pytest.raises(ValueError, match=fault):
        blocks(tmp_path / "page.md")


@pytest.mark.parametrize(
    "line",
    [
        "clamber clim",
        "clamber climb --hieght 0.3",
        "clamber climb --height tall",
        "clamber export runs/climb --to bvh",
        "make dmeo",
        "pip install 'clamber[vidoe]'",
        "python examples/none.py",
        "rm -rf /",
    ],
)
def test_a_wrong_line_is_found(line: str, tmp_path: Path):
    (tmp_path / "page.md").write_text(f"```sh\n{line}\n```\n")
    (block,) = blocks(tmp_path / "page.md")
    with pytest.raises((InputError, SystemExit)):
        check_block(block)


def test_wrong_python_yaml_output_and_mathematics_are_found(tmp_path: Path):
    def block(language: str, text: str) -> Block:
        return Block(tmp_path / "page.md", 1, language, text, {})

    with pytest.raises(AssertionError, match="load_demos"):
        check_block(block("python", "clamber.load_demos('climb')"))
    with pytest.raises(SyntaxError):
        check_block(block("python", "x ="))
    with pytest.raises(ValueError, match="colour"):
        read_yaml_block(block("yaml", "boxes: []\ncolour: red"), tmp_path)
    with pytest.raises(ValueError, match=r"\\foo"):
        check_block(block("math", r"\foo x"))
    with pytest.raises(AssertionError, match="nothing printed"):
        compare(["stance 1"], ["stance 2"], "here")
    compare(["a ...", "...", "c"], ["a  b", "b", "c"], "here")


def imported(text: str) -> set[str]:
    """The packages that Python imports, without those that Python brings."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {a.name.split(".")[0] for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(str(node.module).split(".")[0])
    return found - sys.stdlib_module_names - {"clamber"}


def brought(extras: set[str]) -> set[str]:
    """The packages that `pip install clamber[...]` brings by itself."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = list(project["dependencies"])
    asked += [d for e in extras for d in project["optional-dependencies"][e]]
    names = {re.split(r"[^\w.-]", d)[0].lower() for d in asked}
    places = importlib.metadata.packages_distributions()
    return {m for m, owners in places.items() if names & {o.lower() for o in owners}}


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_a_page_installs_what_its_python_imports(page: Path):
    text = page.read_text()
    lines = re.findall(r"pip install[^`\n]*?(?:clamber|\.)\[([\w,]+)\]", text)
    known = brought({e for line in lines for e in line.split(",")})
    for block in blocks(page):
        if block.language == "python":
            assert imported(block.text) <= known, block.place


NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=ids)
def test_a_notebook_is_small_and_wants_nothing_that_is_not_installed(path: Path):
    cells = json.loads(path.read_text())["cells"]
    assert path.stat().st_size < 20_000
    for cell in (c for c in cells if c["cell_type"] == "code"):
        assert cell["outputs"] == []
        assert cell["execution_count"] is None
        assert imported("".join(cell["source"])) <= brought(set())


@pytest.mark.docs
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # PIL's
@pytest.mark.parametrize("path", NOTEBOOKS, ids=ids)
def test_a_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for k, cell in enumerate(json.loads(path.read_text())["cells"]):
        if cell["cell_type"] == "code":
            text = "".join(cell["source"])
            exec(compile(text, f"{path.name}, cell {k}", "exec"), names)
    assert names["verdict"].reached
    assert (tmp_path / "runs" / "notebook" / "climb.png").is_file()


BUILT_IN = re.compile(r"built-in,? (?:\w+ )?(demonstration|climb|crossing)", re.I)


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_nothing_synthetic_is_called_a_recording_of_a_person(page: Path):
    text = " ".join(page.read_text().split())
    assert not re.search(r"built-in(,? \w+)? (recording|take)", text)
    assert not re.search(r"(crossing|climb)`,? is of a person", text)
    if BUILT_IN.search(text) or 'load_demo("c' in text:
        assert "synthetic" in text.lower()


# What was said in words that nobody in the field uses: glossary.md has the field's.
ODD = re.compile(
    r"holds a push|\d weights\b|felt (for|on the way)|(parts|links?) that (is|are) no "
    r"surface|way of the (limb|surface)|did not make it|made it all the same|got there"
    r"|what is (only )?seen of|mass inside \[|probed for (again|in vain)|asked of key"
    r"|red outside of it|\bmends?\b|\d m before the (ankles|robot)|coin toss"
    r"|on nothing\b|see-through|(is|are|was) fed forward|bear [\d.]+ N m|gone on with"
    r"|(is|was|are|were) felt\b|not felt\b|(is|are) told from"
)


@pytest.mark.parametrize(
    "path",
    [*PAGES, *sorted((ROOT / "src" / "clamber").rglob("*.py"))],
    ids=lambda path: f"{path.parent.name}/{path.name}",
)
def test_pages_messages_and_docstrings_use_the_words_of_the_field(path: Path):
    text = path.read_text()
    if path.name == "glossary.md":  # it names the others
        return
    assert not (found := ODD.search(" ".join(text.split()))), found


def test_the_moving_picture_moves_and_is_small():
    path = ROOT / "docs" / "front.webp"
    assert path.stat().st_size < 1_000_000
    with Image.open(path) as picture:
        assert picture.n_frames > 50
    for page in (ROOT / "README.md", ROOT / "docs" / "index.md"):
        above = page.read_text().split("\n## ")[0]
        assert "front.webp" in above
        assert "synthetic" in above
    assert "(crossing.png)" in (ROOT / "docs" / "index.md").read_text()


def test_the_readme_shows_says_and_runs_it_before_anything_else():
    """Picture, a plain sentence, two commands, then Python, then results as a table."""
    text = (ROOT / "README.md").read_text()
    titles = re.findall(r"^## (.+)$", text, re.M)
    assert titles[:3] == ["Two commands", "In Python", "Results"]
    top, two, python, results = text.split("\n## ")[:4]
    assert len(top.split()) < 140
    assert text.index("front.webp") < 700
    (block,) = re.findall(r"```sh\n(.*?)```", two, re.S)
    assert [words[0] for words in commands(block)] == ["make", "make"]
    assert "```python" in python
    assert results.count("\n|") > 5
    for paragraph in re.sub(r"```.*?```", "", text, flags=re.S).split("\n\n"):
        if not paragraph.startswith("|"):
            assert len(paragraph.split()) < 80, paragraph


def test_pages_name_the_speed_that_is_the_default():
    speed = f"{clamber.PlanOptions().speed:g} rad/s"
    for name, said in {
        "options.md": f"| `--speed` | {speed};",
        "method.md": f"({speed} by default;",
        "results.md": f"at the default {speed}",
    }.items():
        assert said in (ROOT / "docs" / name).read_text(), name


def test_every_page_is_in_the_menu_and_every_public_name_in_the_reference():
    menu = (ROOT / "mkdocs.yml").read_text()
    for page in (ROOT / "docs").glob("*.md"):
        assert f" {page.name}\n" in menu, page.name
    told = re.findall(
        r"^::: clamber\.(\w+)$", (ROOT / "docs" / "api.md").read_text(), re.M
    )
    assert sorted(told) == sorted(set(clamber.__all__) - {"__version__"})


def test_pictures_are_there_and_small():
    for page in PAGES:
        for name in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", page.read_text()):
            picture = page.parent / name
            assert picture.is_file(), f"{page.name}: {name}"
    for picture in (ROOT / "docs" / "stages").iterdir():
        assert picture.stat().st_size < 200_000, picture.name
