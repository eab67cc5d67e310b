import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from leapnav.cli import parse
from leapnav.envs import Scenario

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
BLOCKS = [
    block
    for page in (README, (ROOT / "docs" / "banks.md").read_text())
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL)
]
BANK = r"rooms-1-7 (\d+\.\d+)\n200 \1\d* \(\d+, 3\)( \(\d+, 3\))?\n"


@pytest.mark.parametrize(
    ("block", "output"),
    list(
        zip(
            BLOCKS,
            [
                r"True \d\.\d+\n",
                r"(.*\n)*41 2 3\n",
                r"(.*\n)*(0\.9\d*|1\.0)\n",
                r"\(1024, 41\) \(1024,\)\n",
                r"True\n",
                BANK,
                r"True 1\.\d+\n",
                r"(6\.233154049\n){4}certified: .*\[4\.993.* 6\.258.*\]\n",
                BANK,
            ],
            strict=True,
        )
    ),
)
def test_the_readme_s_examples_run_as_printed(block, output, tmp_path):
    done = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(output, done.stdout)


def test_the_page_on_training_runs_as_printed(tmp_path):
    """Its blocks build on each other."""
    page = (ROOT / "docs" / "training.md").read_text()
    code = "\n".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "20 True\n1\n2 True\n"


NUMBER = r"\d+\.\d+(e-\d+)?"
PRINTED = {
    "index.md": rf"{NUMBER} {NUMBER}\nRolloutSummary\(demonstrations=100, .*\)\n(0\.9\d*|1\.0)\n",
    "tutorial.md": rf"True {NUMBER} 0\.3106\d+\n\[5\.2072\d+, .*\]\nTrue 1\.0000\d*\n"
    rf"RolloutSummary\(demonstrations=100, .*\)\n{NUMBER} (0\.9\d*|1\.0) (0\.9\d*|1\.0) 0\.00\d*\n(0\.9\d*|1\.0)\n",
    "guides/learners.md": r"0\.\d+ 0\.\d+ 0\.\d+\n8 \(\d+, 41\) \['control', 'cost_to_go', 'costate', .*\]\n",
    "guides/obstacles.md": rf"True {NUMBER}\n8 4 True\nrooms-3\n",
    "guides/robots.md": r"1\.7322 \[ 4\. +1\. +-?0\. +-0\.2402\] \[-0\.7902 -0\.2627 +0\.0862 +-?0\. *\]\n",
}


def test_every_page_with_code_is_run():
    pages = [path for path in (ROOT / "docs").rglob("*.md") if "```python" in path.read_text()]
    assert {str(path.relative_to(ROOT / "docs")) for path in pages} == {*PRINTED, "banks.md", "training.md"}


@pytest.mark.parametrize("page", PRINTED)
def test_the_blocks_of_a_page_run_one_after_the_other(page, tmp_path):
    code = "\n".join(re.findall(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(PRINTED[page], done.stdout), done.stdout


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
    for name in ("solve", "find_optimum", "ExpertPolicy"):
        assert f'id="leapnav.experts.{name}"' in reference
    assert "usage: leapnav train ppo" in commands


def test_the_readme_s_scenario_is_valid():
    (text,) = re.findall(r"```json\n(.*?)```", README, re.DOTALL)
    assert Scenario.from_json(text).obstacles
