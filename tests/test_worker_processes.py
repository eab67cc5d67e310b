"""Worker processes that end before their work is done."""

import os
import re
import subprocess
import sys

import pytest
from joblib import delayed

from leapnav.cli import main
from leapnav.commands.installation.compile import Compile
from leapnav.experts.pools import process_pool

COMPILING = """
import sys
from leapnav.cli import main
from leapnav.commands.installation import compile
from leapnav.envs.kernels import compilation
from leapnav.envs.robots.arcs import advance_arc, sinc

compilation.MIN_PARALLEL = 2
compilation.all_kernels = lambda: [advance_arc, sinc]
compile._compile_unicycle_flow = lambda: None
compilation.WORKER = sys.argv[1]
sys.exit(main(["compile", "--jobs", "2"]))
"""
SILENT_DEATH = "import os, signal, sys; sys.stdin.readline(); os.kill(os.getpid(), signal.SIGKILL)"
DEATH_WITH_MESSAGE = "import sys; print('leapnav: compiling', file=sys.stderr); sys.exit('no memory')"


@pytest.mark.parametrize(
    ("worker", "reason"),
    [(SILENT_DEATH, "signal 9: no message"), (DEATH_WITH_MESSAGE, "exit code 1: no memory")],
)
def test_a_lost_process_ends_the_compilation_with_its_message(worker, reason, tmp_path):
    environment = {**os.environ, "LEAPNAV_CACHE_DIR": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-c", COMPILING, worker]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 1
    *_, last = done.stderr.splitlines()
    assert re.fullmatch(
        rf"leapnav: worker process \d of 2, which compiled leapnav\.envs\.robots\.arcs\.\w+, ended with {reason}", last
    )
    assert "Traceback" not in done.stderr


def test_the_error_of_a_kernel_is_raised_by_the_process_that_asked(tmp_path):
    code = """
import numba
from leapnav.envs.kernels import compilation
from leapnav.envs.robots.arcs import advance_arc, sinc

compilation.MIN_PARALLEL = 2
compilation.WORKER = "import sys; [print('failed', flush=True) for _ in sys.stdin]"
sinc.declared_signature = numba.float64(numba.types.unicode_type)
try:
    compilation.prepare(advance_arc, sinc, jobs=2)
except numba.TypingError:
    print("TypingError")
"""
    environment = {**os.environ, "LEAPNAV_CACHE_DIR": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "TypingError\n"


def test_a_lost_process_of_a_pool_is_reported_in_one_line(monkeypatch, capsys):
    def run(_):
        with process_pool(2) as pool:
            return len(list(pool(delayed(os._exit)(3) for _ in range(2))))

    monkeypatch.setattr(Compile, "run", run)
    assert main(["compile"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("leapnav: A worker process")
    assert error.count("\n") == 1
