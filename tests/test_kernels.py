"""Kernels compile when they are first needed; the cache keeps them until something that they are made of changes."""

import importlib.metadata
import os
import pickle
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import pytest
from numba import float64

from leapnav.envs.kernels import decorator, kernel, progress, record_type
from leapnav.envs.kernels.compilation import all_kernels
from leapnav.envs.kernels.decorator import cache_directory, source_stamp
from leapnav.envs.kernels.types import VECTOR
from leapnav.envs.simulation.arcs import arc_point, sinc

ROOT = Path(__file__).parent.parent

CALLING = """
{imports}
from leapnav.envs.kernels import kernel

@kernel("float64(float64)")
def calling(x):
    return {scale} * {called}(x)
"""
CALLED = """
from leapnav.envs.kernels import kernel

SCALE = {}

@kernel("float64(float64)")
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
        ("from .called import SCALE, called", ""),
        ("from leapnav.package.nested.again import SCALE, called", ""),
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
    assert result(2.0, 1.0) == ["4.0", "1"]
    assert result(2.0, 3.0) == ["8.0", "0"]
    assert result(5.0, 3.0) == ["20.0", "0"]


@pytest.mark.parametrize("imports", ["import leapnav.{0}.called as m", "from leapnav.{0} import called as m"])
def test_a_module_that_is_imported_as_a_whole_is_followed_too(imports, tmp_path, monkeypatch):
    import leapnav

    name = re.sub(r"\W", "", tmp_path.name)
    package = tmp_path / name
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "calling.py").write_text(imports.format(name) + "\n")
    monkeypatch.setattr(leapnav, "__path__", [*leapnav.__path__, str(tmp_path)])
    stamps = []
    for text in ("X = 1\n", "X = 2\n"):
        (package / "called.py").write_text(text)
        for function in (decorator._source, decorator._imports, source_stamp):
            function.cache_clear()
        stamps.append(source_stamp(f"leapnav.{name}.calling"))
    assert stamps[0] != stamps[1]


def test_importing_compiles_nothing(tmp_path):
    code = "import leapnav.envs, leapnav.experts"
    assert run(code, LEAPNAV_CACHE_DIR=str(tmp_path)).stderr == ""
    assert not list(tmp_path.rglob("*.nbi"))


def test_a_kernel_is_compiled_with_those_it_calls_and_reported_once(tmp_path):
    code = "from leapnav.envs.simulation.arcs import arc_point; arc_point(0.0, 0.0, 0.0, 1.0, 0.0, 0.5)"
    first = run(code, LEAPNAV_CACHE_DIR=str(tmp_path))
    assert re.match(r"leapnav: compiling, once per installation: 0 of \d+ kernels; `leapnav compile`", first.stderr)
    assert {path.name.split(".")[0] for path in tmp_path.rglob("*.nbi")} == {"arc_point", "sinc"}
    assert run(code, LEAPNAV_CACHE_DIR=str(tmp_path)).stderr == ""


def test_many_kernels_are_compiled_by_several_processes(tmp_path):
    code = """
from leapnav.envs.kernels import compilation, prepare
from leapnav.envs.simulation.arcs import arc_point, sinc
compilation.MIN_PARALLEL = 2
print(*(kernel.py_func.__name__ for kernel in compilation.missing([arc_point])))
prepare(arc_point, jobs=2)
print(*(sum(kernel.stats.cache_hits.values()) for kernel in (sinc, arc_point)))
print(arc_point(1.0, 2.0, 0.0, 2.0, 0.0, 0.5), compilation.missing([arc_point]))
"""
    found = run(code, LEAPNAV_CACHE_DIR=str(tmp_path))
    # Loaded from the cache (with the one that it calls): another process has compiled it.
    assert found.stdout.splitlines() == ["sinc arc_point", "0 1", "(2.0, 2.0) []"]
    assert "0 of 2 kernels" in found.stderr


def test_on_a_terminal_the_progress_line_is_updated_in_place(monkeypatch, capsys):
    monkeypatch.setattr(progress, "_PROGRESS", progress._Progress())
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress.counted([sinc, arc_point]) as done:
        done(sinc)
        done(arc_point)
    lines = capsys.readouterr().err
    assert lines.count("\n") == 1
    assert [part.split(": ")[-1].strip() for part in lines.split("\r")[1:]] == [f"{k} of 2 kernels" for k in (0, 1, 2)]


SCRIPT = """
from beside import SCALE
from leapnav.envs.kernels import kernel

@kernel("float64(float64)")
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


def test_no_two_kernels_have_one_name():
    names = [(one.py_func.__module__, one.py_func.__qualname__) for one in all_kernels()]
    assert len(names) > 80
    assert len(set(names)) == len(names)


def test_a_nested_kernel_is_refused():
    def make(shift):
        return kernel("float64(float64)")(lambda x: x + shift)

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
    with pytest.raises(TypeError, match="Pair: expected the fields factor, values, got values"):
        record_type(Pair, values=VECTOR)
    with pytest.raises(TypeError, match="No matching definition"):
        scaled_sum((2.0, np.arange(4.0)))


def test_kernels_are_pickled_by_name():
    assert pickle.loads(pickle.dumps(sinc)) is sinc


def test_the_cache_is_where_the_variables_say(monkeypatch, tmp_path):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("LEAPNAV_CACHE_DIR", str(tmp_path / "ours"))
    ours = cache_directory("leapnav.envs.simulation.arcs")
    assert ours.parent == tmp_path / "ours" / f"numba-{numba.__version__}"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "numba"))
    assert cache_directory("leapnav.envs.simulation.arcs") == tmp_path / "numba" / ours.name


def test_numba_and_llvmlite_are_bounded_from_above():
    """`leapnav.envs.kernels.numba_internals` uses what these packages do not promise to keep.

    When a bound is raised, run the whole suite with the new version, and check in this order:

    - `Dispatcher`: `get_call_template`, `get_compile_result`, `_compile_for_args` (its result is called by C code) and
      `typeof_pyval` are still called as `Kernel` assumes; `disable_compile` still ends the compilation at a call.
    - `numba.core.caching`: `FunctionCache`, `CompileResultCacheImpl` and `IndexDataCacheFile` have the attributes that
      `_KernelCache` sets; a second process hits the cache (`test_a_kernel_is_compiled_with_those_it_calls...`).
    - `numba.core.config.OPT` is read when a function is compiled.
    - `types.CompileResultWAP(...).__wrapper_address__` is the address of a function with the C calling convention.
    - `numba.core.cgutils.alloca_once`, `numba.np.numpy_support.carray` and typed pointers in llvmlite.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for package in ("numba", "llvmlite"):
        requirement = next(line for line in project["dependencies"] if line.startswith(f"{package}>"))
        bound = re.search(r"<([\d.]+)$", requirement)
        assert bound is not None, requirement
        installed = tuple(map(int, importlib.metadata.version(package).split(".")[:2]))
        assert installed < tuple(map(int, bound[1].split(".")[:2]))


@pytest.mark.skipif(not (ROOT / "envs").is_dir(), reason="there are no sources beside the tests")
def test_only_one_module_uses_the_internals_of_numba():
    internal = re.compile(r"^\s*(from|import) (numba\.(core|np)|llvmlite)\b", re.MULTILINE)
    found = {
        str(path.relative_to(ROOT))
        for folder in ("envs", "experts", "training", "leapnav")
        for path in (ROOT / folder).rglob("*.py")
        if internal.search(path.read_text())
    }
    assert found == {"envs/kernels/numba_internals.py"}
