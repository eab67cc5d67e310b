"""Modules that are generated are those of the present generator."""

from pathlib import Path

import pytest
import sympy as sp

from leapnav.experts import ControlAffineSystem
from leapnav.experts.problem import generated_dynamics, generated_flow


class Generated(Exception):  # noqa: N818 (no error: shows that the generator was called)
    pass


@pytest.mark.parametrize(
    ("generator", "compile_module", "changed"),
    [
        (generated_flow, generated_flow.compile_flow, "generated_flow"),
        (generated_flow, generated_flow.compile_flow, "code_generation"),
        (generated_dynamics, generated_dynamics.compile_dynamics, "generated_dynamics"),
    ],
)
def test_a_changed_generator_generates_again(generator, compile_module, changed, monkeypatch):
    x = sp.Symbol("x")

    def compile_again():
        # Without the cache of results of this process.
        compile_module.__wrapped__(ControlAffineSystem(state=(x,), drift=(-x,), fields=((sp.Integer(1),),)), x**2, None)

    def generate(*_):
        raise Generated

    compile_again()
    monkeypatch.setattr(generator, "_generate", generate)
    compile_again()  # from the cache
    read = Path.read_text

    def read_changed(path, *args, **kwargs):
        return read(path, *args, **kwargs) + "\n# changed" * (path.stem == changed)

    monkeypatch.setattr(Path, "read_text", read_changed)
    with pytest.raises(Generated):
        compile_again()
