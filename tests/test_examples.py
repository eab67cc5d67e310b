import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
D3RLPY = ROOT / ".venv" / "examples"  # `make test` puts it there
SCORE = r"success \d+\.\d %, collision \d+\.\d %, SOC \d\.\d+"
# What each prints last, with arguments that make it short; too short to see whether it learns.
EXAMPLES = {
    "own_robot": ("--plot {out}", r"certified: .*: J = 3\.165478; largest angle at the hitch 66 degrees\nwrote .*\n"),
    "compare_methods": ("--plot {out}", r".*\n(.*SUCCESS.*4\.616791339.*\n){3}.*\n(.*: J = 4\.616791339)\nwrote .*\n"),
    "alternatives": ("--plot {out}", r"the gate: certified: .*\n(J = +\d.*(forward|backward)\n){5,}wrote .*\n"),
    "cleanrl_ppo": ("--total-timesteps 9000 --num-envs 16 --num-steps 64", rf"( +\d.*\n)+{SCORE}\n"),
    "offline_rl": ("--scenarios 20 --steps 50", rf"(.*\n)*{SCORE}\n"),
}


def test_every_example_is_run():
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == set(EXAMPLES)


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_runs(name, tmp_path):
    if name == "offline_rl" and not D3RLPY.exists():
        pytest.skip("d3rlpy is not installed; `make test` does it")
    arguments, printed = EXAMPLES[name]
    words = [word.format(out=tmp_path / "out.png") for word in arguments.split()]
    path = os.pathsep.join(filter(None, [str(D3RLPY) if name == "offline_rl" else "", os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / f"{name}.py"), *words],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stderr
    assert re.search(rf"(^|\n){printed}$", done.stdout), done.stdout
