"""The studies: their tables in the documentation, and their scripts with a tiny budget."""

import importlib.util
import sys

import pytest
from helpers import ROOT, run_with_d3rlpy

STUDIES = sorted({path.parent.name for path in (ROOT / "studies").glob("*/run.py")} - {"offline"})  # which needs d3rlpy
# Words of a run with a tiny budget, of which a part may stand for all.
WORDS = {
    "components": ["four"],
    "curricula": ["uniform"],
    "demonstrations": ["100"],
    "included_policies": ["open", "--train"],
    "methods": ["open-bc", "open-ppo"],
    "motors": ["ppo"],
    "observations": ["memory"],
    "planners": ["lattice"],
    "sac": ["clone"],
    "transfer": ["open", "clutter"],
}
ALL_WORDS = {"included_policies": ["open", "--train"]}  # of the slow test; training of all would take hours
ROWS = {
    "clients": "| gymnasium ",
    "components": "| 4 |",
    "curricula-scores": "| 0.5 M | MaxMC |",
    "curricula-stages": "| 0.5 M |",
    "curricula-runs": "| uniform |",
    "demonstrations": "| 100 |",
    "methods": "| open | clone |",
    "included_policies": "| `open` ",
    "motors": "PPO from it",
    "observations": "| lidar, also ",
    "planners": "| open | ",
    "sac": "| actor cloned, critic fitted |",
    "sac-runs": "| actor cloned, critic",
    "transfer-map": "| `clutter` |",
    "transfer-lidar": "| `open` |",
}  # of the tables, by study or by table


def load(path, name):
    specification = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def write_tables():
    return load(ROOT / "scripts" / "write_tables.py", "write_tables")


def test_the_tables_of_the_documentation_are_those_of_the_results(write_tables, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["write_tables.py", "--check"])
    write_tables.main()
    assert "all tables" in capsys.readouterr().out
    clients = load(ROOT / "studies" / "clients" / "run.py", "study_clients")
    assert "differs" not in clients.tables(ROOT / "studies" / "clients" / "results")["clients"]
    assert not clients.is_right({"found": -3.9, "expected": -3.8})


def test_a_table_that_differs_is_found(write_tables):
    text = "a\n<!-- table: x -->\n\n| 1 |\n\n<!-- end of table -->\nb\n"
    assert write_tables.with_table(text, "x", "| 1 |\n") == text
    assert "| 2 |" in write_tables.with_table(text, "x", "| 2 |\n")
    with pytest.raises(ValueError, match="table y: expected one place for it, found 0"):
        write_tables.with_table(text, "y", "")


def test_the_demonstrations_of_the_study_are_distinct(monkeypatch, tmp_path):
    """Scenario k of a rollout has the seed of the rollout plus k; the next seeds replace rejected scenarios."""
    study, seeds = load(ROOT / "studies" / "demonstrations" / "run.py", "study_demonstrations"), []

    def demonstrate(family, count, folder, *, seed, tiny):
        seeds.extend(range(seed, seed + 2 * count))
        return folder

    monkeypatch.setattr(study, "demonstrate", demonstrate)
    assert len(study.demonstrations(10_000, tmp_path, tiny=False)) == 5
    assert len(seeds) == len(set(seeds)) == 20_000


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A function that runs a study with a tiny budget in an empty directory, and returns the files of its results."""

    def run(name, words, number=0):
        folder = tmp_path / str(number)
        folder.mkdir()
        monkeypatch.chdir(folder)
        study = load(ROOT / "studies" / name / "run.py", f"study_{name}")
        monkeypatch.setattr(sys, "argv", ["run.py", *words, "--tiny", "--out", "results"])
        study.main()
        for table, text in study.tables(folder / "results").items():
            assert ROWS.get(table, ROWS.get(name)) in text
        return {path.name: path.read_bytes() for path in (folder / "results").iterdir() if path.is_file()}

    return run


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_runs_with_a_tiny_budget(name, run):
    assert run(name, WORDS.get(name, []))


@pytest.mark.slow
@pytest.mark.parametrize("name", STUDIES)
def test_a_study_gives_the_same_bytes_again(name, run):
    words = ALL_WORDS.get(name, [])
    found = run(name, words)
    assert found and run(name, words, 1) == found


@pytest.mark.slow
def test_the_study_with_d3rlpy_gives_the_same_bytes_again(tmp_path):
    found = []
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        assert "| expert | BC |" in run_with_d3rlpy("studies/offline/run.py", ["--tiny", "--out", "results"], folder)
        found.append({path.name: path.read_bytes() for path in folder.glob("results/*.gz")})
    assert len(found[0]) == 9 and found[0] == found[1]
