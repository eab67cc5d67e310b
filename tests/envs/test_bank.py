import json
import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace

import gymnasium as gym
import h5py
import numpy as np
import pytest
from helpers import let_newton_stall

import leapnav
from leapnav.envs import FAMILIES, BankError, ScenarioBank, sample_scenario
from leapnav.envs.field.clearance import footprint_clearances
from leapnav.envs.scenarios.bank import ADDED, SPLITS, TYPES, VERSION
from leapnav.envs.scenarios.bank_writing import BankEntry, write_bank
from leapnav.experts import ExpertPolicy, Status, Trajectory, build_bank, find_optimum, solve
from leapnav.experts.data.banks import Rejection, draw, judge
from leapnav.experts.data.store import ResumableStore

ID = "leapnav/Navigate-v0"


def build(out, count=6, **changes):
    return build_bank("clutter", count, out, **{"seed": 3, "progress": False, **changes})


def partial_build(out):
    """The build directory of a bank that is not finished."""
    settings = {"version": VERSION, "software": leapnav.__version__, "family": "clutter", "seed": 3}
    return ResumableStore(out.with_name(f"{out.name}.build"), "bank", settings, BankError)


def shards(directory):
    return {path.name for path in directory.glob("shard-*.npz")}


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    return build(tmp_path_factory.mktemp("bank") / "small.bank")


def test_a_bank_holds_scenarios_with_their_optima(bank):
    assert len(bank) == 6
    assert (bank.family, bank.seed) == ("clutter", 3)
    for index, scenario in enumerate(bank):
        drawn = sample_scenario("clutter", np.random.default_rng([3, int(bank.draws[index])]))
        assert scenario == drawn.model_copy(update={"name": f"clutter-3-{bank.draws[index]}"})
        optimum, reference = find_optimum(scenario), bank.reference(index)
        assert reference.cost == bank.costs[index] == optimum.cost
        assert reference.second_cost == (optimum.alternatives[0].cost if optimum.alternatives else None)
        states, controls, costates = optimum.evaluate(reference.times)
        assert reference.times[-1] == scenario.horizon
        assert np.diff(reference.times).max() <= 0.1 + 1e-9
        for stored, values in zip(
            (reference.states, reference.controls, reference.costates), (states, controls, costates), strict=True
        ):
            assert stored.dtype == np.float32
            assert stored == pytest.approx(values, rel=1e-6, abs=1e-6)
        assert reference.certificate[3] == pytest.approx(optimum.certificate.clearance)


def test_a_stored_optimum_is_a_guess_from_which_it_is_certified_again(bank):
    for index, scenario in enumerate(bank):
        reference = bank.reference(index)
        guess = Trajectory(reference.times, *(a.astype(float) for a in (reference.states, reference.costates)))
        extremal = solve(scenario, "multiple_shooting", guess=guess)
        assert extremal.success
        assert extremal.cost == pytest.approx(reference.cost, rel=1e-9)


def test_a_bank_is_a_sequence(bank):
    assert bank[-1] == bank[5]
    assert bank[1:3] == [bank[1], bank[2]]
    assert list(bank)[2] == bank[2]
    assert bank[0] is bank[0]
    with pytest.raises(IndexError, match=r"index: small\.bank has 6 scenarios, got 6"):
        bank[6]
    with pytest.raises(IndexError, match="has 6 scenarios, got -7"):
        bank.reference(-7)


def test_other_programs_can_read_it(bank):
    """Any HDF5 reader can read the format that the module describes."""
    with h5py.File(bank.path) as file:
        assert file.attrs["format"] == "leapnav-bank"
        assert file.attrs["version"] == VERSION
        assert set(file) == set(TYPES) - set(ADDED)  # no memory layouts
        ends = file["scenario_ends"][:]
        text = file["scenarios"][ends[0] : ends[1]].tobytes().decode()
        assert json.loads(text) == bank[1].to_dict()
        assert file["states"].shape == (file["path_ends"][-1], 3)
        assert file["controls"].shape == (file["path_ends"][-1], 2)


def test_a_bank_is_mapped_and_aligned_and_crosses_processes(bank):
    states = bank.reference(0).states
    while not isinstance(states, np.memmap):
        states = states.base
        assert states is not None
    assert not states.flags.writeable
    assert bank.costs.flags.aligned
    again = pickle.loads(pickle.dumps(bank))
    assert again[2] == bank[2]
    assert again.reference(2).states.tobytes() == bank.reference(2).states.tobytes()
    assert len(pickle.dumps(bank)) < 1000


def test_a_bank_is_bitwise_independent_of_workers_and_interruptions(bank, tmp_path):
    content = bank.path.read_bytes()
    assert build(tmp_path / "two.bank", workers=2).path.read_bytes() == content
    with partial_build(tmp_path / "half.bank") as store:
        for number in (4, 0, 2):
            store.write(number, draw(number, "clutter", 3))
        # A process that is killed while it writes a file leaves a part of it.
        (store.directory / ".shard-000001.npz.1.partial").write_bytes(store.path(0).read_bytes()[:500])
    assert build(tmp_path / "half.bank").path.read_bytes() == content
    assert not store.directory.exists()


def test_a_killed_build_resumes(tmp_path):
    whole = build(tmp_path / "whole.bank", count=10)
    code = (
        "from leapnav.experts import build_bank\n"
        "if __name__ == '__main__':\n"
        f"    build_bank('clutter', 10, {str(tmp_path / 'killed.bank')!r}, seed=3, workers=1, progress=False)\n"
    )
    script, directory = tmp_path / "build.py", tmp_path / "killed.bank.build"
    script.write_text(code)
    process = subprocess.Popen([sys.executable, str(script)], start_new_session=True)
    while process.poll() is None and len(shards(directory)) < 3:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "killed.bank").exists() and len(shards(directory)) >= 3
    assert build(tmp_path / "killed.bank", count=10).path.read_bytes() == whole.path.read_bytes()


def test_a_bank_is_built_by_one_process_at_a_time(tmp_path):
    with partial_build(tmp_path / "x.bank"), pytest.raises(BankError, match="another process"):
        build(tmp_path / "x.bank")
    assert len(build(tmp_path / "x.bank")) == 6


def test_a_build_directory_left_beside_a_complete_bank_is_removed(bank):
    with partial_build(bank.path) as store:
        pass
    assert len(build(bank.path)) == 6
    assert not store.directory.exists()


def test_the_error_for_a_damaged_scenario_names_file_and_dataset(bank, tmp_path):
    path = tmp_path / "damaged.bank"
    path.write_bytes(bank.path.read_bytes().replace(bank[1].to_json().encode()[:20], b"\xff" * 20))
    with pytest.raises(BankError, match=r"damaged\.bank: damaged: the checksum of scenarios differs"):
        ScenarioBank(path)


def test_a_complete_bank_is_not_rebuilt_and_no_other_file_is_overwritten(bank):
    content, changed = bank.path.read_bytes(), bank.path.stat().st_mtime_ns
    assert len(build(bank.path)) == 6
    with pytest.raises(BankError, match="exists, with count 6 instead of 7"):
        build(bank.path, count=7)
    with pytest.raises(BankError, match="exists, with seed 3 instead of 4"):
        build(bank.path, seed=4)
    assert (bank.path.read_bytes(), bank.path.stat().st_mtime_ns) == (content, changed)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("bank.json", b'{"format": "leapnav-bank", "software": "0"}', "other settings: family is None, got 'clutter'"),
        ("bank.json", b"not a manifest", "bank.json: damaged"),
        ("shard-000000.npz", b"not a shard", "shard-000000.npz: damaged"),
    ],
)
def test_a_foreign_build_directory_is_refused_and_kept(file, content, message, tmp_path):
    with partial_build(tmp_path / "new.bank") as store:
        (store.directory / file).write_bytes(content)
    with pytest.raises(BankError, match=message):
        build(tmp_path / "new.bank")
    assert (store.directory / file).read_bytes() == content


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"family": "moon"},
            "family: expected one of open, .*, doors, all, module:function .*, got 'moon'",
        ),
        ({"family": "all"}, "family: expected one family, got 'all'"),
        ({"count": 0}, "count: expected at least 1, got 0"),
        ({"workers": 0}, "workers: expected at least 1, got 0"),
        ({"seed": -1}, "seed: expected at least 0, got -1"),
    ],
)
def test_impossible_arguments_are_named(arguments, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        build_bank(**{"family": "clutter", "count": 1, "out": tmp_path / "x.bank", **arguments})
    assert not list(tmp_path.iterdir())


def damaged(bank, tmp_path, change):
    path = tmp_path / "damaged.bank"
    path.write_bytes(bank.path.read_bytes())
    change(path)
    return path


def with_attribute(name, value):
    def change(path):
        with h5py.File(path, "a") as file:
            file.attrs[name] = value

    return change


def overwritten(name):
    """Overwrite the first bytes of a dataset."""

    def change(path):
        with h5py.File(path) as file:
            start = file[name].id.get_offset()
        content = bytearray(path.read_bytes())
        content[start : start + 40] = bytes(range(40))
        path.write_bytes(content)

    return change


def without_costs(path):
    with h5py.File(path, "a") as file:
        del file["costs"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: path.write_text("text"), "not a scenario bank, or damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:-5000]), "not a scenario bank, or damaged"),
        (lambda path: path.write_bytes(b""), "not a scenario bank, or damaged"),
        (with_attribute("version", 1), "version 1 of the format; this leapnav reads 6; build the bank again"),
        (with_attribute("format", "other"), "an HDF5 file, but not a scenario bank"),
        (with_attribute("seed", 8), "damaged: the checksum of attributes differs"),
        *((overwritten(name), f"damaged: the checksum of {name} differs") for name in ("costs", "states")),
        (without_costs, "not a scenario bank, or damaged: .*costs"),
    ],
)
def test_the_error_for_an_invalid_bank_names_the_file(bank, change, message, tmp_path):
    path = damaged(bank, tmp_path, change)
    with pytest.raises(BankError, match=message) as caught:
        ScenarioBank(path)
    assert "damaged.bank" in str(caught.value)


def test_a_large_dataset_is_verified_when_it_is_first_read(bank, tmp_path, monkeypatch):
    path = damaged(bank, tmp_path, overwritten("states"))
    monkeypatch.setattr("leapnav.envs.scenarios.bank.MAX_VERIFIED_ON_OPENING", 500)
    opened = ScenarioBank(path)
    assert opened[0].name == bank[0].name
    with pytest.raises(BankError, match=r"damaged\.bank: damaged: the checksum of states differs"):
        opened.reference(0)
    with pytest.raises(BankError, match="the checksum"):
        opened.verify_checksums()
    bank.verify_checksums()


def test_the_error_for_a_missing_bank_names_the_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.bank: no such bank"):
        ScenarioBank(tmp_path / "none.bank")


def test_an_empty_bank_can_be_written_and_read(tmp_path):
    path = tmp_path / "empty.bank"
    write_bank(path, [], family="open", seed=0, drawn=0, rejected={}, software="0")
    assert len(ScenarioBank(path)) == 0


def test_a_failed_write_leaves_nothing(tmp_path):
    bad = BankEntry(
        sample_scenario("open", 0).to_json(),
        0,
        1.0,
        None,
        (0, 0, 0, 0),
        np.zeros((3, 3)),
        np.zeros((3, 2)),
        np.zeros((2, 2)),
    )
    with pytest.raises(ValueError, match="dimension"):
        write_bank(tmp_path / "x.bank", [bad], family="open", seed=0, drawn=1, rejected={}, software="0")
    assert not list(tmp_path.iterdir())


def test_only_certified_optima_without_doubts_are_admitted():
    optimum = find_optimum(sample_scenario("clutter", 0))
    assert judge(optimum) is None
    failed = replace(optimum, status=Status.STALLED)
    assert judge(failed) is Rejection.NO_OPTIMUM
    assert judge(replace(optimum, doubts=(failed,))) is Rejection.UNRESOLVED


def test_a_cheaper_path_without_a_certificate_is_a_doubt(monkeypatch):
    best = find_optimum(sample_scenario("clutter", 0))
    let_newton_stall(monkeypatch, best.cost)
    optimum = find_optimum(sample_scenario("clutter", 0))
    assert optimum.success and optimum.cost > best.cost and judge(optimum) is Rejection.UNRESOLVED
    doubt = optimum.doubts[0]
    assert doubt.cost == pytest.approx(best.cost, rel=1e-2) and doubt.status is Status.STALLED


@pytest.mark.parametrize("family", FAMILIES)
def test_the_included_banks_are_certified_and_complete(family):
    for split, count in zip(SPLITS, (200 if family in ("maze", "corridors") else 400, 200), strict=True):
        shipped = ScenarioBank.shipped(family, split)
        assert len(shipped) == count
        assert shipped.family == family
        residual, defect, drift, clearance = shipped.certificates.T
        assert max(residual.max(), defect.max()) <= 1e-8
        assert drift.max() <= 1e-7  # at the vertices of polygons the curvature of the level lines jumps
        assert clearance.min() > 0
        assert (np.isnan(shipped.second_costs) | (shipped.second_costs >= shipped.costs)).all()
        for index in range(0, count, 50):
            scenario, reference = shipped[index], shipped.reference(index)
            timed = np.column_stack([reference.states, reference.times])
            assert footprint_clearances(timed, scenario.outline, scenario.field).min() > 0
            assert reference.states[0] == pytest.approx(scenario.start, abs=1e-6)
            assert reference.states[-1, :2] == pytest.approx(scenario.goal[:2], abs=1e-6)
    assert {s.start for s in ScenarioBank.shipped(family, "train")}.isdisjoint(s.start for s in shipped)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_shipped_references_are_found_again(family):
    shipped = ScenarioBank.shipped(family, "test")
    for index in (0, 77, 154):
        assert find_optimum(shipped[index]).cost == pytest.approx(shipped.costs[index], rel=1e-9)


@pytest.mark.parametrize("family", FAMILIES)
def test_episodes_come_from_the_bank_with_their_reference(family):
    env = gym.make(ID, family=family, split="test")
    shipped = ScenarioBank.shipped(family, "test")
    _, info = env.reset(options={"index": 7})
    assert info["index"] == 7
    assert env.unwrapped.scenario == shipped[7]
    assert info["reference_cost"] == shipped.costs[7]
    expert = ExpertPolicy(env)
    observation, terminated = env.reset(options={"index": 7})[0], False
    while not terminated:
        observation, _, terminated, _, info = env.step(expert.predict(observation)[0])
    assert info["is_success"]
    assert info["cost"] == pytest.approx(shipped.costs[7], rel=2e-3)


def test_episodes_are_drawn_from_the_bank_by_the_seed(bank):
    env = gym.make(ID, bank=bank)
    first = [env.reset(seed=5)[1]["index"], *(env.reset()[1]["index"] for _ in range(30))]
    assert first == [env.reset(seed=5)[1]["index"], *(env.reset()[1]["index"] for _ in range(30))]
    assert set(first) == set(range(6))
    assert gym.make(ID, bank=str(bank.path)).reset(seed=5)[1]["index"] == first[0]
    env.reset(options={"scenario": bank[2]})
    assert env.unwrapped.scenario == bank[2]


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"split": "validation"}, ValueError, "split: expected one of train, test, fresh, got 'validation'"),
        ({"split": "test", "bank": "x.bank"}, ValueError, "split: cannot be combined with bank"),
        ({"bank": "x.bank"}, FileNotFoundError, "x.bank: no such bank"),
    ],
)
def test_invalid_banks_are_refused_when_the_environment_is_made(arguments, error, message):
    with pytest.raises(error, match=message):
        gym.make(ID, **arguments)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"index": 6}, IndexError, "has 6 scenarios, got 6"),
        ({"index": 1.5}, ValueError, "index: expected an integer, got 1.5"),
        ({"index": True}, ValueError, "index: expected an integer, got True"),
        ({"number": 1}, ValueError, "expected 'scenario' or 'index', got 'number'"),
        ({"index": 1, "scenario": {}}, ValueError, "'index' needs a bank and no 'scenario'"),
    ],
)
def test_impossible_options_are_named(bank, options, error, message):
    env = gym.make(ID, bank=bank)
    with pytest.raises(error, match=message):
        env.reset(options=options)


def test_an_index_without_a_bank_is_refused():
    with pytest.raises(ValueError, match="'index' needs a bank"):
        gym.make(ID, split="fresh").reset(options={"index": 1})
