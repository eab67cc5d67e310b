"""Edited banks with correct checksums are refused, or what they contain is consistent.

`HYPOTHESIS_PROFILE=long` makes 5,000 edits.
"""

import json
import math
import re

import h5py
import numpy as np
import pytest
from hypothesis import settings

from leapnav.envs import BankError, NavigateEnv, Scenario, ScenarioBank
from leapnav.envs.scenarios.bank import TYPES, attribute_bytes, digest
from leapnav.envs.scenarios.bank_writing import BankEntry, add_datasets, write_bank

N_EDITS = max(150, settings.default.max_examples // 2)
N_SCENARIOS = 3
NUMBERS = (0.0, -0.0, 1.0, -1.0, 1e-300, 1e8, -1e8, 1e30, math.nan, math.inf, -math.inf, 2.0**63, -(2.0**63))
TEXTS = ("", "x", "[]", "{}", "null", "1e999", '{"a": -1}', '{"a": 1.5}', "[" * 100_000, "\ud7ff", "../../x")
BANKS = [("polygons", "unicycle", "fixed"), ("rooms", "dynamic_unicycle", "fixed"), ("clutter", "unicycle", "free")]


@pytest.fixture(scope="module", params=BANKS, ids="-".join)
def original(request, tmp_path_factory):
    """A small bank with lower bounds, as its arrays, its attributes and its file."""
    family, robot, horizon = request.param
    shipped, path = ScenarioBank.shipped(family, "test", robot, horizon), tmp_path_factory.mktemp("bank") / "small.bank"
    entries = []
    for i in range(N_SCENARIOS):
        r = shipped.reference(i)
        arrays = r.states, r.controls, r.costates
        entries.append(
            BankEntry(shipped[i].to_json(), 2 * i, r.cost, r.second_cost, r.certificate, *arrays, r.times[-1])
        )
    rejected = {"no certified optimum": 2}
    write_bank(path, entries, family=family, seed=1, drawn=N_SCENARIOS + 2, rejected=rejected, software="0")
    lengths = np.append(np.linspace(1.0, 9.0, N_SCENARIOS - 1), math.nan)
    add_datasets(path, lower_bounds=np.append(0.9 * shipped.costs[: N_SCENARIOS - 1], math.nan))
    add_datasets(path, shortest_lengths=lengths, shortest_times=lengths / 2)
    with h5py.File(path) as file:
        attributes = {name: value for name, value in file.attrs.items() if name != "checksums"}
        return {name: dataset[()] for name, dataset in file.items()}, attributes, ScenarioBank(path)


def write(path, arrays, attributes, options):
    """Write a bank with correct checksums."""
    checksums = {name: digest(np.asarray(array)) for name, array in arrays.items()}
    with h5py.File(path, "w", alignment_threshold=1, alignment_interval=64) as file:
        for name, value in attributes.items():
            file.attrs[name] = value
        stored = {name: file.attrs[name] for name in attributes}  # as they are read again
        file.attrs["checksums"] = json.dumps({**checksums, "attributes": digest(attribute_bytes(stored))})
        for name, array in arrays.items():
            file.create_dataset(name, data=array, **options.get(name, {}))


def edit_values(rng, array):
    """Replace a few entries by other numbers."""
    flat = array.reshape(-1)
    for _ in range(rng.integers(1, 4)):
        i = rng.integers(len(flat))
        old, number = float(flat[i]), float(rng.choice(NUMBERS))
        value = float(rng.choice([number, -old, old * rng.normal(1.0, 0.5), old + rng.normal()]))
        if array.dtype.kind in "iu":
            limits = np.iinfo(array.dtype)
            flat[i] = min(max(int(np.nan_to_num(value)), limits.min), limits.max)
        else:
            with np.errstate(over="ignore"):
                flat[i] = value
    return array


def edit_bytes(rng, array):
    """Overwrite a few bytes."""
    flat = array.reshape(-1).view("u1")
    start, length = rng.integers(len(flat)), rng.integers(1, 17)
    flat[start : start + length] = rng.integers(256, size=len(flat[start : start + length]))
    return array


def edit_length(rng, array):
    """Remove or repeat rows, or columns."""
    axis = int(rng.integers(array.ndim))
    count = array.shape[axis]
    return np.take(array, np.arange(rng.choice([0, 1, count - 1, count + 1, 2 * count])) % count, axis=axis)


def edit_order(rng, array):
    """Exchange two rows."""
    i, j = rng.integers(len(array), size=2)
    array[[i, j]] = array[[j, i]]
    return array


def edit_type(rng, array):
    """Store other types or shapes."""
    changes = (
        lambda a: a.astype(rng.choice(["f2", "f4", ">f8", "i4", "u8", "S3", "?"])),
        lambda a: a[..., None],
        lambda a: a[0] if len(a) else a,
        lambda a: a.reshape(-1),
    )
    with np.errstate(all="ignore"):
        return changes[rng.integers(len(changes))](array)


def replace_texts(arrays, change):
    """Replace the texts of the scenarios by those that a function returns for the list of them."""
    encoded = [text.encode() for text in change(texts_of(arrays))]
    arrays["scenarios"] = np.frombuffer(b"".join(encoded), dtype="u1")
    arrays["scenario_ends"] = np.cumsum([len(text) for text in encoded])


def texts_of(arrays):
    return [part.tobytes().decode() for part in np.split(arrays["scenarios"], arrays["scenario_ends"][:-1])]


def edit_scenario(rng, texts):
    """Replace a number or a few characters in the text of a scenario."""
    i = rng.integers(len(texts))
    if rng.random() < 0.8:
        found = list(re.finditer(r"-?\d+\.?\d*(e-?\d+)?", texts[i]))
        place = found[rng.integers(len(found))]
        numbers = float(place.group()) * rng.normal(1.0, 0.5), float(rng.choice(NUMBERS))
        choices = (*map(repr, numbers), "null", "9" * 5000, "[]")
        texts[i] = texts[i][: place.start()] + choices[rng.integers(len(choices))] + texts[i][place.end() :]
    else:
        k = rng.integers(len(texts[i]))
        texts[i] = texts[i][:k] + rng.choice(TEXTS) + texts[i][k + rng.integers(3) :]
    return texts


def edit_attribute(rng, attributes):
    """Replace or remove an attribute."""
    name = rng.choice(list(attributes))
    values = (*NUMBERS, *(text for text in TEXTS if len(text) < 1000), 3, -1, True, np.arange(3), b"bytes")
    value = values[rng.integers(len(values))]
    if rng.random() < 0.1:
        del attributes[name]
    elif rng.random() < 0.2:
        attributes["given"] = value
    else:
        attributes[name] = value


def edit(rng, path, arrays, attributes):
    """Write a bank with one edit to a file; return the name of the edited dataset, or "attributes"."""
    arrays = {name: array.copy() for name, array in arrays.items()}
    attributes, options = dict(attributes), {}
    name = str(rng.choice([*arrays, "attributes", "texts"]))
    if name == "attributes":
        edit_attribute(rng, attributes)
    elif name == "texts":
        replace_texts(arrays, lambda texts: edit_scenario(rng, texts))
    elif rng.random() < 0.05:
        del arrays[name]
    elif rng.random() < 0.05 and arrays[name].size:
        options[name] = {"chunks": True}
    else:
        change = rng.choice([edit_values, edit_values, edit_bytes, edit_length, edit_order, edit_type])
        arrays[name] = change(rng, arrays[name])
    write(path, arrays, attributes, options)
    return name, arrays


def play(bank, rng):
    """Drive a few steps of each scenario."""
    env = NavigateEnv(bank=bank)
    for index in range(len(bank)):
        observation, _ = env.reset(seed=0, options={"index": index})
        assert env.scenario is bank[index]
        for _ in range(3):
            observation, reward, terminated, truncated, _ = env.step(rng.uniform(-1, 1, env.action_space.shape))
            assert np.isfinite(observation).all() and math.isfinite(reward)
            if terminated or truncated:
                break


def check_accepted(bank, arrays, original):
    """Assert that a bank contains what its file contains, and that its optima are near those before the edit."""
    for i, (scenario, text) in enumerate(zip(bank, texts_of(arrays), strict=True)):
        assert scenario == Scenario.from_json(text)
        found, expected = bank.reference(i), original.reference(i)
        weights, limits = scenario.robot.control_weight(scenario.cost), scenario.robot.action_scale()[1]
        step = np.abs(np.diff(expected.states, axis=0)).max(axis=0)
        assert (np.abs(found.states - expected.states) <= step + 1e-5).all()
        for k, ends in ((0, scenario.start_state), (-1, scenario.goal_state)):
            for value, end in zip(found.states[k].tolist(), ends, strict=True):
                assert end is None or value == pytest.approx(end, abs=1e-5) or abs(value - end) > 6
        assert (np.abs(found.controls) <= 1.00001 * np.array(limits)).all()
        assert np.isfinite(found.costates).all()
        assert found.times[-1] == pytest.approx(expected.times[-1], abs=0.1 if scenario.horizon is None else 0)
        effort = np.trapezoid(found.controls.astype(float) ** 2 @ np.array(weights) / 2, found.times)
        assert 0.9 * effort <= found.cost <= 1.1 * expected.cost
        assert found.second_cost is None or found.second_cost >= found.cost * (1 - 1e-8)
        assert found.lower_bound is None or found.lower_bound <= found.cost * (1 + 1e-8)
        *errors, clearance = found.certificate
        assert min(errors) >= 0 and max(errors[:2]) <= 1e-8
        assert abs(clearance - expected.certificate[3]) <= 2 * np.hypot(*step[:2]) and clearance > 0


def test_an_edited_bank_is_refused_or_consistent(original, tmp_path):
    arrays, attributes, bank = original
    refused = 0
    for number in range(N_EDITS // len(BANKS) + 1):
        rng, path = np.random.default_rng([20, number]), tmp_path / "edited.bank"
        name, edited = edit(rng, path, arrays, attributes)
        try:
            opened = ScenarioBank(path)
            for index in range(len(opened)):
                opened.reference(index)
            play(opened, rng)
        except BankError as error:
            message = str(error)
            assert str(path) in message and "\n" not in message and len(message) < 2000
            refused += 1
            continue
        # Another scenario may have the same optimum, for example if its obstacles far from the path are changed.
        if name not in ("texts", "scenarios"):
            check_accepted(opened, edited, bank)
    assert 0.5 * N_EDITS / len(BANKS) < refused


def in_scenario(*keys, value):
    """Return an edit of a field of the second scenario."""

    def change(texts):
        fields = part = json.loads(texts[1])
        for key in keys[:-1]:
            part = part[key]
        part[keys[-1]] = value
        return [texts[0], json.dumps(fields), *texts[2:]]

    return lambda arrays: replace_texts(arrays, change)


def added(values):
    return lambda rows: rows + np.array(values)


def in_dataset(name, change, *rows):
    """Return an edit of rows of a dataset."""

    def edited(arrays):
        arrays[name][rows] = change(arrays[name][rows])

    return edited


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (in_dataset("states", added([0.02, 0, 0])), "states: expected the start"),
        (in_dataset("states", added([0, 0, 0.01]), -1), "states: expected the goal"),
        (in_dataset("states", added([0.5, 0, 0]), 20), "states: not the motion"),
        (in_dataset("states", lambda states: states * np.nan, 20), "states: expected finite numbers"),
        (in_dataset("states", lambda states: states + 1e9, 20), "states: expected positions in the arena"),
        (in_dataset("certificates", added([0, 0, 0, 0.5])), "states: expected a smallest clearance"),
        (in_dataset("costates", added([0, 0, 1]), 20), "costates: not those of an extremal"),
        (in_dataset("costs", lambda costs: 0.4 * costs), "costs: expected"),
        (in_dataset("costs", lambda costs: 1.06 * costs, 2), "costs: expected"),
        (in_scenario("robot", "max_speed", value=0.05), "controls: expected values within"),
        (in_scenario("robot", value={"model": "car"}), "robot.model: expected that of the bank, 'unicycle', got 'car'"),
        (in_scenario("cost", "time_weight", value=0.5), "cost.time_weight"),
        (in_scenario("horizon", value=3.25), "horizon: expected that of the bank, .*, got 3.25"),
        (in_scenario("goal", value=[100, 0, 0]), "goal: .* is inside the arena wall"),
        (in_scenario("obstacles", 0, value={"circle": {"center": [1, 1], "radius": 1e300}}), "radius"),
    ],
)
@pytest.mark.parametrize("original", BANKS[:1], indirect=True, ids="-".join)
def test_each_edit_has_its_message(change, message, original, tmp_path):
    arrays = {name: array.copy() for name, array in original[0].items()}
    arrays["second_costs"][:] = math.nan
    arrays["lower_bounds"][:] = math.nan
    change(arrays)
    write(tmp_path / "edited.bank", arrays, original[1], {})
    opened = ScenarioBank(tmp_path / "edited.bank")
    with pytest.raises(BankError, match=rf"edited\.bank: not a scenario bank, or damaged: scenario \d: .*{message}"):
        list(map(opened.reference, range(N_SCENARIOS)))


@pytest.mark.parametrize("kind", ["external", "soft", "group"])
def test_a_dataset_is_in_its_file(kind, original, tmp_path):
    arrays, attributes, bank = original
    path = tmp_path / "linked.bank"
    write(path, arrays, attributes, {})
    with h5py.File(path, "a") as file:
        del file["costs"]
        if kind == "group":
            file.create_group("costs")
        else:
            file["costs"] = h5py.ExternalLink(bank.path, "/costs") if kind == "external" else h5py.SoftLink("/draws")
    with pytest.raises(BankError, match="costs: type or layout differs from the format"):
        ScenarioBank(path)


def test_an_unedited_bank_is_accepted(original, tmp_path):
    arrays, attributes, bank = original
    write(tmp_path / "same.bank", arrays, attributes, {})
    same = ScenarioBank(tmp_path / "same.bank")
    check_accepted(same, arrays, bank)
    play(same, np.random.default_rng(0))
    assert set(arrays) == set(TYPES)
