"""Banks and families of one's own scenarios, from Python and from files."""

import json

import numpy as np
import pytest
import yaml
from helpers import cluster_that_loses_a_worker, drawn_scenario, let_newton_stall

import leapnav
from leapnav.cli import main
from leapnav.envs import (
    BankError,
    Circle,
    NavigateEnv,
    Obstacle,
    Scenario,
    ScenarioBank,
    ScenarioError,
    sample_scenario,
)
from leapnav.envs.scenarios.files import read_scenarios
from leapnav.experts import build_bank_of, find_optimum, load_demonstrations, rollout
from leapnav.experts.data.cards import data_card
from leapnav.training import evaluate, load_policy, policy_environment

RING = [
    Obstacle(circle=Circle(center=(8.0 + dx, 8.0 + dy), radius=0.4))
    for dx in (-1, 0, 1)
    for dy in (-1, 0, 1)
    if dx or dy
]


def worlds(count=4):
    """Scenarios, of which the last has no path to its goal."""
    found = [sample_scenario("clutter", seed) for seed in range(5, 4 + count)]
    closed = Scenario(
        name="closed", arena=(0, 0, 10, 10), start=(1, 1, 0), goal=(8, 8, 0), horizon=15.0, obstacles=tuple(RING)
    )
    return [*found, closed]


@pytest.fixture
def folder(tmp_path):
    out = tmp_path / "worlds"
    out.mkdir()
    for number, scenario in enumerate(worlds()):
        fields = scenario.to_dict()
        if number == 0:
            del fields["name"]
        (out / f"{number}.json").write_text(json.dumps(fields))
    return out


def test_a_bank_of_given_scenarios_names_what_it_rejects(tmp_path):
    given = worlds()
    bank = build_bank_of(given, tmp_path / "mine.bank", progress=False)
    assert (bank.family, len(bank), bank.drawn) == ("mine", 3, 4)
    assert bank.given["rejected"] == {"closed": "no certified optimum"} and "doubtful" not in bank.given
    assert list(bank) == given[:3] and bank.costs[1] == find_optimum(given[1]).cost
    content = bank.path.read_bytes()
    assert build_bank_of(given, bank.path, progress=False).path.read_bytes() == content  # complete
    with pytest.raises(BankError, match="exists, with scenarios"):
        build_bank_of(given[:2], bank.path, progress=False)
    (tmp_path / "more").mkdir()
    assert build_bank_of(given, tmp_path / "more/mine.bank", workers=2, progress=False).path.read_bytes() == content


def test_a_data_card_says_where_the_scenarios_come_from(tmp_path, capsys):
    sources = {"origin": "a laboratory", "licence": "cc-by-4.0"}
    bank = build_bank_of([sample_scenario("open", 5)], tmp_path / "lab.bank", **sources, progress=False)
    assert main(["bank", "card", str(bank.path)]) == 0
    card = capsys.readouterr().out
    assert card == data_card(bank) and not list(tmp_path.glob("*.png"))
    _, metadata, text = card.split("---\n", 2)
    assert yaml.safe_load(metadata)["license"] == "cc-by-4.0"
    for line in (
        "| origin | a laboratory |",
        "| scenarios | 1, of 1 given |",
        f"| software | leapnav {leapnav.__version__} |",
    ):
        assert line in text
    assert text.count("BLAKE2b of ") == len(bank.checksums) >= 12
    shipped = data_card(ScenarioBank.shipped("clutter", "test"))
    assert "sampled by leapnav, family `clutter`, seed 1" in shipped and 'license: "mit"' in shipped


def test_doubtful_optima_are_admitted_on_request(tmp_path, monkeypatch):
    stalled = sample_scenario("clutter", 0).model_copy(update={"name": "stalled"})
    let_newton_stall(monkeypatch, find_optimum(stalled).cost)
    strict = build_bank_of([stalled], tmp_path / "strict.bank", progress=False)
    assert len(strict) == 0 and strict.given["rejected"] == {"stalled": "a cheaper solution was not certified"}
    bank = build_bank_of([stalled], tmp_path / "all.bank", doubtful=True, progress=False)
    assert bank[0] == stalled and bank.given["doubtful"] == {"stalled": "a cheaper solution was not certified"}
    with pytest.raises(BankError, match="exists, with doubtful True instead of False"):
        build_bank_of([stalled], tmp_path / "all.bank", progress=False)
    assert bank.certificates[0, 0] < 1e-8 < bank.certificates[0, 3]


def test_files_are_scenarios_of_a_bank_and_of_a_family(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["bank", "build", "--scenarios", "worlds/*.json", "--out", "mine.bank", "--workers", "1"]) == 0
    printed = capsys.readouterr().out
    assert "closed: rejected: no certified optimum\nwrote mine.bank: 3 of 4 given scenarios (1 rejected: " in printed
    bank = ScenarioBank("mine.bank")
    assert [scenario.name for scenario in bank] == ["0", "clutter-6", "clutter-7"]
    assert main(["bank", "show", "mine.bank"]) == 0
    assert "3 scenarios of mine, given, leapnav" in capsys.readouterr().out
    evaluation = evaluate(load_policy("clutter"), bank, environment=policy_environment("clutter"), progress=False)
    assert [episode.family for episode in evaluation] == ["mine"] * 3
    for family in ("mine.bank", "worlds/[012].json"):
        env = NavigateEnv(family)
        names = {drawn_scenario(env, seed=seed).name for seed in range(12)}
        assert names == {"0", "clutter-6", "clutter-7"}
        rollout(family, 2, tmp_path / f"demos-{len(family)}", seed=3, progress=False)
        assert {demo.scenario.name for demo in load_demonstrations(tmp_path / f"demos-{len(family)}")} <= names
    assert read_scenarios(folder) == read_scenarios("worlds/*.json") == read_scenarios(sorted(folder.iterdir()))


@pytest.mark.parametrize(
    ("files", "error", "message"),
    [
        ("none/*.json", FileNotFoundError, r"none/\*\.json: no such scenario file"),
        ([], ScenarioError, "scenarios: expected at least one, got none"),
        ("broken.json", ScenarioError, "broken.json: .*horizon: expected a number > 0, got -1"),
        (["a.json", "a.json"], ScenarioError, "scenarios: expected different names, 2 are named 'clutter-5'"),
        (["a.json", "car.json"], ScenarioError, "'car-9': robot: expected that of 'clutter-5', 'unicycle', got 'car'"),
        (
            ["a.json", "free.json"],
            ScenarioError,
            "'free-9': horizon: expected that of 'clutter-5', 'fixed', got 'free'",
        ),
    ],
)
def test_files_that_cannot_be_a_bank_are_named(files, error, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = sample_scenario("clutter", 5)
    first.to_json("a.json")
    (tmp_path / "broken.json").write_text(json.dumps({**first.to_dict(), "horizon": -1}))
    for name, arguments in (("car", {"robot": "car"}), ("free", {"horizon": "free"})):
        sample_scenario("clutter", 9, **arguments).model_copy(update={"name": f"{name}-9"}).to_json(f"{name}.json")
    with pytest.raises(error, match=message):
        build_bank_of(files, "x.bank", progress=False)
    assert not (tmp_path / "x.bank").exists() and not (tmp_path / "x.bank.build").exists()


@pytest.mark.slow
@pytest.mark.parametrize("count", [30, 2000])
def test_a_dask_cluster_that_loses_a_worker_builds_the_same_bank(count, tmp_path):
    given, out = [sample_scenario("open", seed) for seed in range(5, 5 + count)], tmp_path / "dask/given.bank"
    out.parent.mkdir()
    with cluster_that_loses_a_worker(out.parent, "given.bank.build/shard-*.npz") as address:
        bank = build_bank_of(given, out, dask=address, progress=False)
        on_dask = evaluate(load_policy("open"), bank, timed=False, progress=False, dask=address)
    assert len(bank) > 0.9 * count
    assert bank.path.read_bytes() == build_bank_of(given, tmp_path / "given.bank", progress=False).path.read_bytes()
    here = evaluate(load_policy("open"), bank, timed=False, progress=False)
    assert [episode.to_dict() for episode in on_dask] == [episode.to_dict() for episode in here]


def test_an_evaluation_does_not_depend_on_the_number_of_processes():
    one, two = (
        evaluate(load_policy("open"), "open", count=80, timed=False, workers=workers, progress=False)
        for workers in (1, 2)
    )
    for first, second in zip(one, two, strict=True):
        np.testing.assert_equal(
            first.to_dict(), second.to_dict()
        )  # NaN, of a score that is not known, is equal to itself
    with pytest.raises(ValueError, match="workers: expected at least 1, got 0"):
        evaluate(load_policy("open"), "open", workers=0)
