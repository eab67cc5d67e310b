"""Names of version 0.1 keep working for one version, with a warning that names the new one."""

import importlib
import sys
import warnings

import pytest

import leapnav.envs.settings
import leapnav.experts
from leapnav.deprecated import MOVED, RENAMED
from leapnav.training import DAggerConfig


@pytest.mark.parametrize("old", sorted(MOVED))
def test_a_module_is_found_by_its_old_name(old):
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=f"^{old} is now {MOVED[old]}; ") as caught:
        module = importlib.import_module(old)
    assert caught[0].filename == __file__  # the line that has to be changed
    new = importlib.import_module(MOVED[old])
    for name, value in vars(new).items():
        if not name.startswith("_"):
            assert getattr(module, name) is value
    for name, renamed in RENAMED.get(old, {}).items():
        assert getattr(module, name) is getattr(new, renamed)
    with pytest.raises(AttributeError):
        _ = module.no_such_name
    assert new.__spec__.name == MOVED[old]


@pytest.mark.parametrize(
    ("module", "old", "new"),
    [(leapnav.experts, "Path", "Trajectory"), (leapnav.envs.settings, "Settings", "EnvironmentSettings")],
)
def test_a_renamed_class_is_found_by_its_old_name(module, old, new):
    with pytest.warns(DeprecationWarning, match=rf"{old} is now {module.__name__}\.{new}") as caught:
        assert getattr(module, old) is getattr(module, new)
    assert caught[0].filename == __file__


@pytest.mark.parametrize(
    ("package", "name"),
    [
        ("leapnav.experts.problem", "OptimalControlProblem"),
        ("leapnav.training.policies", "load_policy"),
        ("leapnav.training.policies", "make_policy"),
        ("leapnav.training.runs", "Run"),
    ],
)
def test_the_content_of_a_module_that_is_a_package_now_is_found_in_it(package, name):
    with pytest.warns(DeprecationWarning, match=rf"{package}\.{name} is now {package}\.\w+\.{name}; "):
        assert getattr(importlib.import_module(package), name).__name__ == name


def test_a_renamed_field_is_accepted_and_readable():
    with pytest.warns(DeprecationWarning, match="DAggerConfig.failures is now DAggerConfig.max_failures") as caught:
        config = DAggerConfig(failures=7)
    assert caught[0].filename == __file__
    assert config == DAggerConfig(max_failures=7)
    with pytest.warns(DeprecationWarning, match="max_episodes"):
        assert config.episodes == config.max_episodes


def test_new_names_do_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert leapnav.experts.Trajectory is not None
