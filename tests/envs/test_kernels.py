"""Kernels compile when they are first needed; the cache keeps them until something that they are made of changes."""

import os
import re
import subprocess
import sys
from typing import NamedTuple

import numba
import numpy as np
import pytest
from helpers import ROOT
from numba import float64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.decorator import kernel_cache
from leapnav.envs.kernels.types import VECTOR

CALLING = """
{imports}
from numba import float64
from leapnav.envs.kernels import kernel

@kernel(float64(float64))
def calling(x):
    return {scale} * {called}(x)
"""
CALLED = """
from numba import float64
from leapnav.envs.kernels import kernel

SCALE = {}

@kernel(float64(float64))
def called(x):
    return x + {}
"""
RUN = """
import sys
import leapnav
leapnav.__path__.append(sys.argv[1])
from leapnav.package.calling import calling
print(calling(1.0), sum(calling.stats.cache_hits.values()))
"""


def run(code, *arguments, **variables):
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, env={**os.environ, **variables}, check=True, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("imports", "prefix"),
    [
        ("from leapnav.package.called import SCALE, called", ""),
        pytest.param("from .called import SCALE, called", "", marks=pytest.mark.slow),
        pytest.param("from leapnav.package.nested.again import SCALE, called", "", marks=pytest.mark.slow),
    ],
    ids=["absolute", "relative", "through another module"],
)
def test_a_kernel_is_compiled_again_when_another_module_changes(imports, prefix, tmp_path):
    nested = tmp_path / "package" / "nested"
    nested.mkdir(parents=True)
    for package in (nested, nested.parent):
        (package / "__init__.py").touch()
    (nested / "again.py").write_text("from ..called import SCALE, called\n")
    (tmp_path / "package" / "calling.py").write_text(CALLING.format(imports=imports, scale="SCALE", called="called"))

    def result(scale, shift):
        (tmp_path / "package" / "called.py").write_text(CALLED.format(scale, shift))
        return run(RUN, tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "cache")).stdout.split()

    assert result(2.0, 1.0) == ["4.0", "0"]
    assert result(2.0, 3.0) == ["8.0", "0"]
    assert result(5.0, 3.0) == ["20.0", "0"]


@pytest.mark.parametrize("name", ["beside", "below"])
def test_what_a_kernel_uses_must_be_known_when_it_is_declared(name, tmp_path):
    """Otherwise a change would not be noticed: a module as a whole, or a kernel that is defined below."""
    below = "\n@kernel(float64(float64))\ndef below(x):\n    return x\n"
    code = f"""
from leapnav.envs.robots import arcs as beside
from numba import float64
from numba import float64
from leapnav.envs.kernels import kernel

@kernel(float64(float64))
def calling(x):
    return {"beside.sinc" if name == "beside" else "below"}(x)
{below}"""
    (tmp_path / "script.py").write_text(code)
    done = subprocess.run([sys.executable, tmp_path / "script.py"], capture_output=True, text=True, check=False)
    assert f"NameError: calling: {name} must be a kernel or a constant defined above it" in done.stderr


def test_importing_compiles_nothing(tmp_path):
    code = "import leapnav.envs, leapnav.experts"
    assert run(code, LEAPNAV_CACHE_DIR=str(tmp_path)).stderr == ""
    assert not list(tmp_path.rglob("*.nbi"))


def test_a_kernel_is_compiled_with_those_it_calls(tmp_path):
    code = "from leapnav.envs.robots.arcs import advance_arc; advance_arc(0.0, 0.0, 0.0, 1.0, 0.0)"
    assert run(code, LEAPNAV_CACHE_DIR=str(tmp_path)).stderr == ""
    assert {path.name.split("-")[0] for path in tmp_path.rglob("*.nbi")} == {"arcs.advance_arc", "arcs.sinc"}


PREPARED = """
from leapnav.envs.kernels import compilation, prepare
from leapnav.envs.robots.arcs import advance_arc, sinc
compilation.MIN_KERNELS = 1
if {fail}:
    compilation.WORK = "import sys; sys.exit(1)"
print(*(one.py_func.__name__ for one in compilation.missing([advance_arc])))
print(prepare(advance_arc, jobs=2), len(advance_arc.signatures))
print(advance_arc(1.0, 2.0, 0.0, 2.0, 0.0), compilation.missing([advance_arc]))
print(sum(advance_arc.stats.cache_hits.values()))
"""


@pytest.mark.parametrize("fail", [False, True])
def test_many_kernels_are_compiled_by_several_processes(fail, tmp_path):
    """Kernels that these did not compile are compiled by the process that asked."""
    found = run(PREPARED.format(fail=fail), LEAPNAV_CACHE_DIR=str(tmp_path))
    assert found.stdout.splitlines() == ["sinc advance_arc", f"2 {int(fail)}", "(3.0, 2.0, 0.0) []", str(int(not fail))]
    assert "Compiling, once per installation" in found.stderr


def test_the_name_of_a_cache_directory_is_the_same_in_every_process():
    """Also for options and constants that are sets, whose order changes."""
    code = """
from leapnav.experts.proofs import inequality
from leapnav.envs.kernels.decorator import DECLARATIONS
print(*sorted(declaration.directory.name for declaration in DECLARATIONS.values()))
"""
    assert len({run(code, PYTHONHASHSEED=seed).stdout for seed in "12"}) == 1


USED = """
import pickle
import gymnasium as gym
import leapnav
import numpy as np
from leapnav.envs import NavigateEnv, Scenario, sample_scenario
from leapnav.envs.kernels import compilation
from leapnav.envs.kernels.decorator import DECLARATIONS
from leapnav.experts import find_optimum

compilation.MIN_KERNELS = 1  # all kernels are compiled by other processes

for robot in ("unicycle", "car"):
    env = gym.make("leapnav/Navigate-v0", family="clutter", split="fresh", robot=robot)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert find_optimum(sample_scenario("clutter", 1, robot)).success
NavigateEnv("clutter", split="test").reset(seed=0)  # checks the optimum of a bank
wall = {"polygon": {"vertices": [[3, 1], [4, 1], [4, 3], [3, 3]]}, "mass": 10.0}
fields = {"arena": [0, 0, 8, 4], "start": [1, 2, 0], "goal": [7, 2, 0], "horizon": 8.0, "obstacles": [wall]}
scenario = Scenario.from_dict({**fields, "robot": {"model": "dynamic_unicycle"}, "start_motion": [1.0, 0.0]})
env = NavigateEnv(scenario=scenario, terminate_on_collision=False)
env.reset(seed=0)
for _ in range(40):  # until it pushes the obstacle
    env = pickle.loads(pickle.dumps(env))
    *_, info = env.step(np.array([0.2, 0.0], np.float32))
assert info["collision"]
prepared = [one for one in DECLARATIONS if one.py_func.__module__.startswith("leapnav.")]
loaded = [one for one in prepared if one.signatures]
print([one.__name__ for one in loaded if one.signatures != [DECLARATIONS[one].signature.args]])
print([one.__name__ for one in loaded if sum(one.stats.cache_misses.values())])
"""


@pytest.mark.parametrize("cache", ["shared", pytest.param("empty", marks=pytest.mark.slow)])
def test_what_is_prepared_suffices_for_a_step_and_a_search(cache, tmp_path):
    """Neither other kernels nor other types of arguments than the declared ones are compiled."""
    environment = {"LEAPNAV_CACHE_DIR": str(tmp_path)} if cache == "empty" else {}
    assert run(USED, **environment).stdout == "[]\n[]\n"


def test_kernels_without_a_file_that_call_each_other_are_compiled():
    """Those of a notebook have no cache."""
    code = """
from numba import float64
from leapnav.envs.kernels import kernel, prepare

@kernel(float64(float64))
def doubled(x):
    return 2.0 * x

@kernel(float64(float64))
def one_more(x):
    return doubled(x) + 1.0

print(prepare(one_more), prepare(one_more), one_more(3.0))
"""
    assert run(code).stdout == "2 0 7.0\n"


SCRIPT = """
from beside import SCALE
from numba import float64
from leapnav.envs.kernels import kernel

@kernel(float64(float64))
def scaled(x):
    return SCALE * x

print(scaled(2.0), sum(scaled.stats.cache_hits.values()))
"""


def test_kernels_of_a_script_are_cached_until_it_or_a_module_beside_it_changes(tmp_path):
    (tmp_path / "script.py").write_text(f"# {tmp_path}{SCRIPT}")  # not in the cache from an earlier test

    def result(*command, scale, **options):
        (tmp_path / "beside.py").write_text(f"SCALE = {scale}\n")
        environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, *command]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True, **options
        )
        return done.stdout.split()

    name = str(tmp_path / "script.py")
    assert result(name, scale=1.0) == ["2.0", "0"]
    assert result(name, scale=1.0) == ["2.0", "1"]
    assert result(name, scale=2.0) == ["4.0", "0"]
    assert result("-", scale=1.0, input=SCRIPT) == ["2.0", "0"]  # without a source file


def test_a_nested_kernel_is_refused():
    def make(shift):
        return kernel(float64(float64))(lambda x: x + shift)

    with pytest.raises(TypeError, match=r"make\.<locals>\.<lambda>: a kernel needs a name that is unique"):
        make(1.0)


class Pair(NamedTuple):
    factor: float
    values: np.ndarray


PAIR = record_type(Pair, factor=float64, values=VECTOR)


@kernel(float64(PAIR))
def scaled_sum(pair):
    return pair.factor * pair.values.sum()


def test_a_record_is_one_argument():
    assert scaled_sum(Pair(2.0, np.arange(4.0))) == 12.0
    assert scaled_sum.signatures == [(PAIR,)]


def test_the_cache_is_where_the_variables_say(monkeypatch, tmp_path):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("LEAPNAV_CACHE_DIR", str(tmp_path / "ours"))
    assert kernel_cache() == tmp_path / "ours" / f"numba-{numba.__version__}"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "numba"))
    assert kernel_cache() == tmp_path / "numba"


@pytest.mark.skipif(not (ROOT / "envs").is_dir(), reason="there are no sources beside the tests")
def test_only_one_module_uses_the_internals_of_numba():
    internal = re.compile(r"^\s*(from|import) (numba\.(core|np)|llvmlite)\b", re.MULTILINE)
    found = {
        str(path.relative_to(ROOT))
        for folder in ("envs", "experts", "training", "leapnav")
        for path in (ROOT / folder).rglob("*.py")
        if internal.search(path.read_text())
    }
    assert found == {"envs/kernels/internals.py"}
