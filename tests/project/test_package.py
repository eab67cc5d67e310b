import importlib.metadata
import subprocess
import sys

import gymnasium as gym

import leapnav


def run(code, **options):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, **options).stdout


HEAVY = {
    "h5py",
    "matplotlib",
    "minari",
    "numba",
    "pydantic",
    "pygame",
    "pymunk",
    "scipy",
    "stable_baselines3",
    "sympy",
    "torch",
}


def test_importing_leapnav_registers_and_loads_nothing_heavy():
    loaded = run("import leapnav, sys, gymnasium; gymnasium.spec('leapnav/Navigate-v0'); print(*sys.modules)").split()
    assert not HEAVY & set(loaded)


def test_the_command_line_loads_nothing_heavy():
    """Help is printed at once."""
    loaded = run("import leapnav.cli, sys; print(*sys.modules)").split()
    assert not HEAVY & set(loaded)


def test_the_solvers_load_neither_torch_nor_minari():
    loaded = run("import leapnav.experts, sys; print(*sys.modules)").split()
    assert not {"torch", "stable_baselines3", "minari", "h5py", "matplotlib", "pygame"} & set(loaded)


def test_registering_twice_is_silent():
    code = "import warnings; warnings.simplefilter('error'); import leapnav, importlib; importlib.reload(leapnav)"
    run(code)


def test_the_module_prefix_form_works_without_an_import():
    run("import gymnasium; gymnasium.make('leapnav:leapnav/Navigate-v0').reset(seed=0)")


def test_the_package_works_from_any_folder(tmp_path):
    # Directories of a user with these names do not shadow the packages, and are not shadowed.
    for name in ("envs", "experts", "training"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("MINE = True\n")
    run("import envs, leapnav.envs; assert envs.MINE; assert hasattr(leapnav.envs, 'Scenario')", cwd=tmp_path)


def test_subprocess_workers_make_the_environment():
    venv = gym.make_vec("leapnav/Navigate-v0", num_envs=2, vectorization_mode="async", family="clutter")
    observations, _ = venv.reset(seed=0)
    assert observations.shape[0] == 2
    venv.step(venv.action_space.sample())
    venv.close()


def test_the_version_is_defined_in_one_place():
    assert leapnav.__version__ == importlib.metadata.version("leapnav")
