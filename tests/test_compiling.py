"""Compiled kernels are found again, but not those that are made of something else by now."""

import os
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

import leapnav.envs
import leapnav.experts
from leapnav.envs import compiling
from leapnav.envs.compiling import source_stamp
from leapnav.envs.obstacles import sinc

KERNEL = """
from leapnav.envs.compiling import njit
from leapnav.called import SCALE, called

@njit("float64(float64)", cache=True)
def kernel(x):
    return SCALE * called(x)
"""
CALLED = """
from leapnav.envs.compiling import njit

SCALE = {}

@njit("float64(float64)", cache=True)
def called(x):
    return x + {}
"""
RUN = """
import sys
import leapnav
leapnav.__path__.append(sys.argv[1])
from leapnav.kernel import kernel
print(kernel(1.0), sum(kernel.stats.cache_hits.values()))
"""


@pytest.mark.parametrize("chosen", [False, True], ids=["beside the module", "NUMBA_CACHE_DIR"])
def test_a_kernel_is_compiled_anew_when_another_module_changes(chosen, tmp_path):
    (tmp_path / "kernel.py").write_text(KERNEL)
    variables = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache") if chosen else ""}

    def run(scale, shift):
        (tmp_path / "called.py").write_text(CALLED.format(scale, shift))
        command = [sys.executable, "-c", RUN, str(tmp_path)]
        return subprocess.run(command, env=variables, check=True, capture_output=True, text=True).stdout.split()

    assert run(2.0, 1.0) == ["4.0", "0"]
    assert run(2.0, 1.0) == ["4.0", "1"]
    assert run(2.0, 3.0) == ["8.0", "0"]
    assert run(5.0, 3.0) == ["20.0", "0"]
    assert (tmp_path / "cache").exists() == chosen


def test_modules_with_kernels_import_what_they_call_in_the_form_that_is_followed():
    with_kernels = 0
    for package in (leapnav.envs, leapnav.experts):
        for path in Path(package.__path__[0]).glob("*.py"):
            source = path.read_bytes()
            if compiling.KERNEL.search(source):
                with_kernels += 1
                assert not re.search(
                    rb"^ *(import leapnav|from leapnav(\.envs|\.experts)? import|from \.)", source, re.M
                )
    assert with_kernels > 15


def test_no_two_kernels_have_one_name():
    kernels = {}
    for package in (leapnav.envs, leapnav.experts):
        for path in Path(package.__path__[0]).glob("*.py"):
            if compiling.KERNEL.search(path.read_bytes()):
                module = import_module(f"{package.__name__}.{path.stem}")
                found = [value for value in vars(module).values() if isinstance(value, Dispatcher)]
                kernels.update({id(kernel): kernel.py_func for kernel in found})
    names = [(function.__module__, function.__qualname__) for function in kernels.values()]
    assert len(names) > 60
    assert len(set(names)) == len(names)


def test_a_nested_kernel_is_refused():
    def make(shift):
        return compiling.njit("float64(float64)", cache=True)(lambda x: x + shift)

    with pytest.raises(TypeError, match=r"make\.<locals>\.<lambda>: a kernel needs a name that no other has"):
        make(1.0)


@pytest.mark.parametrize("looked_at", [True, False])
def test_who_looks_is_told_why_the_first_import_takes_long(looked_at, tmp_path, monkeypatch, capsys):
    def announced():
        compiling.njit("float64(float64)", cache=True)(sinc.py_func)
        return capsys.readouterr().err

    monkeypatch.setattr(sys.stderr, "isatty", lambda: looked_at)
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path))
    compiling._say_what_takes_so_long.cache_clear()
    assert announced() == "leapnav: compiling, once after an installation: about a minute\n" * looked_at
    assert announced() == ""
    shutil.rmtree(tmp_path)
    assert announced() == ""  # once in a process


def test_a_stamp_holds_what_a_kernel_calls(monkeypatch):
    whole = source_stamp("leapnav.experts.direct")
    called = source_stamp("leapnav.envs.fields")
    try:
        source_stamp.cache_clear()
        monkeypatch.setattr(compiling, "IMPORT", re.compile(b"nothing"))
        assert source_stamp("leapnav.experts.direct") != whole
        assert source_stamp("leapnav.envs.fields") == called  # no kernels: its own source alone
    finally:
        source_stamp.cache_clear()
