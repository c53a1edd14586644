"""The scripts: sorted by what they do, each with its command, its help and no way around the package."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"
FOLDERS = ("data", "evaluate", "figures", "measure")
LOOSE = {"README.md", "demo.sh", "setup_env.sh", "test.sh", "train_statistics.py"}
PROGRAMS = sorted(SCRIPTS.rglob("*.py"))
TAKEN = sys.stdlib_module_names | {"compression"}
"""Of the standard library: a script's folder comes first on the path, and would hide them from all that it imports."""


def name(path: Path) -> str:
    return str(path.relative_to(SCRIPTS))


@pytest.fixture(scope="module")
def helps() -> dict[str, str]:
    """What every script answers to ``--help``, all in one process."""
    code = """
import contextlib, io, json, runpy, sys
answers = {}
for path in sys.argv[1:]:
    said, sys.argv = io.StringIO(), [path, "--help"]
    with contextlib.redirect_stdout(said):
        try:
            runpy.run_path(path, run_name="__main__")
        except SystemExit as leaving:
            print(f"exit {leaving.code or 0}")
    answers[path] = said.getvalue()
print(json.dumps(answers))
"""

    done = subprocess.run([sys.executable, "-c", code, *map(str, PROGRAMS)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return dict(json.loads(done.stdout.splitlines()[-1]))


def test_scripts_lie_where_their_purpose_says() -> None:
    assert {path.name for path in SCRIPTS.iterdir() if path.is_file()} == LOOSE
    folders = {path.name for path in SCRIPTS.iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders == {*FOLDERS, "results"}
    assert {path.parent.name for path in PROGRAMS} <= {*FOLDERS, "scripts"}


@pytest.mark.parametrize("path", PROGRAMS, ids=name)
def test_a_script_says_its_command(path: Path) -> None:
    said = ast.get_docstring(ast.parse(path.read_text())) or ""
    assert f"python scripts/{name(path)}" in said


@pytest.mark.parametrize("path", PROGRAMS, ids=name)
def test_a_script_goes_through_the_package(path: Path) -> None:
    text, tree = path.read_text(), ast.parse(path.read_text())
    assert "sys.path" not in text
    siblings = {other.stem for other in PROGRAMS}
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert not siblings & imported, "expected shared code in the package"
    # Own parts of classes that extend the package's are fine; parts of other objects are not.
    reached = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and re.match("_[a-z]", node.attr)
        if not (isinstance(node.value, ast.Name) and node.value.id == "self")
        and node.attr not in ("_asdict", "_fields", "_replace")
    }
    assert not reached, "expected no private parts of the package"
    assert not re.search(r"setattr\([^)]*\"_", text)


@pytest.mark.parametrize("path", PROGRAMS, ids=name)
def test_a_script_hides_no_module(path: Path) -> None:
    assert path.stem not in TAKEN


@pytest.mark.parametrize("path", PROGRAMS, ids=name)
def test_a_script_answers_help(path: Path, helps: dict[str, str]) -> None:
    said = helps[str(path)]
    assert said.splitlines()[0].startswith("usage:")
    assert said.splitlines()[-1] == "exit 0"


@pytest.mark.parametrize("path", sorted(SCRIPTS.glob("results/*")), ids=lambda path: path.name)
def test_results_say_how_they_came_about(path: Path) -> None:
    scripts = [stem for stem in (program.stem for program in PROGRAMS) if f"{path.stem}_".startswith(f"{stem}_")]
    assert scripts, "expected the name of the script that wrote it, and what it is of: NAME or NAME_WHAT"
    told = ["command", "date", "machine", "commit"]
    if path.suffix == ".csv":
        lines = path.read_text().splitlines()
        assert [line.split(":")[0] for line in lines[:4]] == [f"# {what}" for what in told]
        assert any(f"/{script}.py" in lines[0] for script in scripts)
    else:
        assert list(json.loads(path.read_text())["made"]) == told


@pytest.mark.parametrize("paper", [SCRIPTS.parent / "README.md", SCRIPTS / "README.md"], ids=("package", "scripts"))
def test_papers_name_scripts_that_are_there(paper: Path) -> None:
    named = set(re.findall(r"scripts/[\w/]+\.(?:py|sh)", paper.read_text()))
    assert named
    assert all((SCRIPTS.parent / script).exists() for script in named)
