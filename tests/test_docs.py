import io
import re
import shlex
import subprocess
import sys
import warnings
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from leapnav.cli import parse
from leapnav.envs import Scenario

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
BANK = r"rooms-1-7 (\d+\.\d+)\n200 \1\d* \(\d+, 3\)( \(\d+, 3\))?\n"
NUMBER = r"\d+\.\d+(e-\d+)?"
RATE = r"(0\.9\d*|1\.0)"
# What the blocks of the README print; each block is a program of its own.
BLOCKS = [
    r"True \d\.\d+\n",
    r"(.*\n)*41 2 3\n",
    rf"(.*\n)*{RATE}\n",
    r"\(1024, 41\) \(1024,\)\n",
    r"True\n",
    BANK,
    r"True 1\.\d+\n",
    r"(6\.233154049\n){4}certified: .*\[4\.993.* 6\.258.*\]\n",
]
# What the pages print; the blocks of a page build on each other.
PRINTED = {
    "banks.md": BANK,
    "index.md": rf"{NUMBER} {NUMBER}\nRolloutSummary\(demonstrations=50, .*\)\n{RATE}\n",
    "training.md": r"20 True\n1\n2 True\n",
    "tutorial.md": rf"True {NUMBER} 0\.3106\d+\n\[5\.2072\d+, .*\]\nTrue 1\.0000\d*\n"
    rf"RolloutSummary\(demonstrations=50, .*\)\n{NUMBER} {RATE} {RATE} 0\.00\d*\n{RATE}\n",
    "guides/learners.md": r"0\.\d+ 0\.\d+ 0\.\d+\n8 \(\d+, 41\) \['control', 'cost_to_go', 'costate', .*\]\n",
    "guides/obstacles.md": rf"True {NUMBER}\n8 4 True\nrooms-3\n",
    "guides/robots.md": r"1\.7322 \[ 4\. +1\. +-?0\. +-0\.2402\] \[-0\.7902 -0\.2627 +0\.0862 +-?0\. *\]\n",
}


def blocks_of(text):
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def output_of(code, name):
    """Run an example in this process, which has imported the libraries, and return what it prints."""
    module, printed = "example", io.StringIO()
    with warnings.catch_warnings(), redirect_stdout(printed):
        warnings.filterwarnings("error", category=DeprecationWarning, module=module)
        exec(compile(code, name, "exec"), {"__name__": module})
    return printed.getvalue()


def test_the_readme_s_examples_run_as_printed(tmp_path, monkeypatch):
    """In one directory, so that the second rollout finds the demonstrations of the first."""
    monkeypatch.chdir(tmp_path)
    for number, (block, expected) in enumerate(zip(blocks_of(README), BLOCKS, strict=True)):
        assert re.search(r"^(import|from) leapnav\b", block, re.MULTILINE), block  # which registers the environments
        printed = output_of(block, f"README.md, block {number}")
        assert re.fullmatch(expected, printed), (block, printed)


def test_every_page_with_code_is_run():
    pages = [path for path in (ROOT / "docs").rglob("*.md") if "```python" in path.read_text()]
    assert {str(path.relative_to(ROOT / "docs")) for path in pages} == set(PRINTED)


@pytest.mark.parametrize("page", PRINTED)
def test_the_blocks_of_a_page_run_one_after_the_other(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    printed = output_of("\n".join(blocks_of((ROOT / "docs" / page).read_text())), page)
    assert re.fullmatch(PRINTED[page], printed), printed


def test_every_command_that_the_pages_show_is_one():
    shown = 0
    for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        text = path.read_text().replace("\\\n", " ")
        for line in re.findall(r"^    .*?(leapnav [^`\n]*)", text, re.MULTILINE):
            if "--tyro-print-completion" in line:
                continue
            parse(shlex.split(line.rstrip(" &").replace("$seed", "0"), comments=True)[1:])
            shown += 1
    assert shown > 30


def test_the_site_is_built_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    theory, reference, commands = (
        (tmp_path / page / "index.html").read_text() for page in ("theory", "reference/experts", "reference/cli")
    )
    assert "<math" in theory
    assert "arithmatex" not in theory
    for name in ("solve.solve", "find_optimum", "ExpertPolicy", "rollout"):
        assert f'id="leapnav.experts.{name}"' in reference
    assert "usage: leapnav train ppo" in commands


def test_the_readme_s_scenario_is_valid():
    (text,) = re.findall(r"```json\n(.*?)```", README, re.DOTALL)
    assert Scenario.from_json(text).obstacles
