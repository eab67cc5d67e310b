"""The form of the code: what CONTRIBUTING.md promises and no tool checks."""

import ast
import shutil
import subprocess

import pytest
from helpers import ROOT

PACKAGES = ("envs", "experts", "training", "leapnav")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
MAX_LINES, MAX_POSITIONAL, MAX_MODULES = 450, 8, 12

pytestmark = pytest.mark.skipif(not (ROOT / "envs").is_dir(), reason="there are no sources beside the tests")


def test_no_file_is_too_long():
    counts = {path: len(path.read_text().splitlines()) for path in (*FILES, *(ROOT / "tests").rglob("*.py"))}
    assert {str(path.relative_to(ROOT)): count for path, count in counts.items() if count > MAX_LINES} == {}


def test_no_function_has_too_many_positional_arguments():
    found = {}
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                names = [argument.arg for argument in (*node.args.posonlyargs, *node.args.args)]
                count = len([name for name in names if name not in ("self", "cls")])
                if count > MAX_POSITIONAL:
                    found[f"{path.relative_to(ROOT)}: {node.name}"] = count
    assert found == {}


def test_no_folder_has_too_many_modules():
    counts = {path.parent: len(list(path.parent.glob("*.py"))) for path in FILES}
    assert {str(path): count for path, count in counts.items() if count > MAX_MODULES} == {}


@pytest.mark.skipif(
    shutil.which("git") is None or not (ROOT / ".git").exists(), reason="there is no git checkout to ask"
)
def test_git_ignores_no_source():
    command = ["git", "ls-files", "--others", "--ignored", "--exclude-standard", "--", *PACKAGES, "tests"]
    ignored = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    assert [path for path in ignored if not path.endswith(".pyc")] == []
