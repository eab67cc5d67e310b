import re
import subprocess
import sys
from pathlib import Path

import pytest

from leapnav.envs import Scenario

README = (Path(__file__).parent.parent / "README.md").read_text()


@pytest.mark.parametrize("block", re.findall(r"```python\n(.*?)```", README, re.DOTALL))
def test_the_readme_s_examples_run_as_printed(block, tmp_path):
    done = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_the_readme_s_scenario_is_valid():
    (text,) = re.findall(r"```json\n(.*?)```", README, re.DOTALL)
    assert Scenario.from_json(text).obstacles
