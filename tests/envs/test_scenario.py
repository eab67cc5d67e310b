import json
import math
import pickle

import numpy as np
import pytest
from helpers import scenario_fields

from leapnav.envs import Scenario, ScenarioError
from leapnav.envs.field.clearance import clearance
from leapnav.envs.field.proximity import proximity


def square(x, y, side=1.0):
    return {"polygon": {"vertices": [[x, y], [x + side, y], [x + side, y + side], [x, y + side]]}}


def test_a_scenario_survives_json_pickle_and_dict_unchanged():
    fields = scenario_fields(goal=[8.0, 8.0, None], horizon=11.3)
    scenario = Scenario.from_dict(fields)
    assert scenario.to_dict() == fields
    assert Scenario.from_json(scenario.to_json()) == scenario
    assert pickle.loads(pickle.dumps(scenario)) == scenario
    assert hash(Scenario.from_dict(fields)) == hash(scenario)


def test_a_scenario_is_read_from_and_written_to_a_file(tmp_path):
    scenario = Scenario.from_dict(scenario_fields())
    path = tmp_path / "scenario.json"
    scenario.to_json(path)
    assert Scenario.from_json(path) == scenario
    assert Scenario.from_json(str(path)) == scenario


@pytest.mark.parametrize("field", ["start", "goal"])
def test_a_heading_in_degrees_is_refused_in_a_file(field, tmp_path):
    pose = [8.0, 8.0, 90] if field == "goal" else [1.0, 1.0, 90]
    path = tmp_path / "scenario.json"
    path.write_text(json.dumps(scenario_fields(**{field: pose})))
    with pytest.raises(
        ScenarioError, match=rf"{field}: expected a heading in radians, .* got 90; did you mean 1\.571\?"
    ):
        Scenario.from_json(path)
    # In Python a heading may be unwrapped, as poses of the environment are.
    assert Scenario.from_dict(scenario_fields(**{field: pose}))
    pose[2] = -2 * math.pi
    path.write_text(json.dumps(scenario_fields(**{field: pose})))
    assert Scenario.from_json(path)


def test_a_scenario_cannot_be_changed():
    scenario = Scenario.from_dict(scenario_fields())
    with pytest.raises(Exception, match="frozen"):
        scenario.horizon = 3.0  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ValueError, match="read-only"):
        scenario.field[0] = 1.0


def test_fields_nested_too_deeply_are_reported_in_one_line():
    value = 1.0
    for _ in range(900):
        value = [value]
    with pytest.raises(ScenarioError):
        Scenario.from_dict(scenario_fields(start=value))


def test_a_copy_is_validated_and_has_its_own_field():
    scenario = Scenario.from_dict(scenario_fields())
    assert clearance(4.0, 4.5, scenario.field)[0] < 0
    emptied = scenario.model_copy(update={"obstacles": ()})
    assert clearance(4.0, 4.5, emptied.field)[0] > 0
    with pytest.raises(ScenarioError, match="horizon"):
        scenario.model_copy(update={"horizon": -1.0})
    assert not pickle.loads(pickle.dumps(scenario)).field.flags.writeable


def test_a_byte_order_mark_is_read_over(tmp_path):
    path = tmp_path / "scenario.json"
    path.write_text(json.dumps(scenario_fields()), encoding="utf-8-sig")
    assert Scenario.from_json(path).name == "small"


def test_orientation_of_a_polygon_does_not_matter():
    vertices = [[6.0, 3.0], [7.0, 3.5], [6.5, 5.0]]
    one, other = (
        Scenario.from_dict(scenario_fields(obstacles=[{"polygon": {"vertices": v}}]))
        for v in (vertices, vertices[::-1])
    )
    for x, y in np.random.default_rng(0).uniform(0, 10, (50, 2)):
        assert clearance(x, y, one.field) == pytest.approx(clearance(x, y, other.field))
        assert proximity(x, y, one.field) == pytest.approx(proximity(x, y, other.field))


FAULTS = [
    ({"horizon": 0}, "horizon", "got 0"),
    ({"horizon": -1.5}, "horizon", "-1.5"),
    ({"horizon": math.nan}, "horizon", "nan"),
    ({"horizon": math.inf}, "horizon", "inf"),
    ({"horizon": 1e300}, "horizon", "1e+300"),
    ({"arena": [0, 0, 1e308, 10]}, "arena[2]", "1e+308"),
    ({"horizon": "12"}, "horizon", "'12'"),
    ({"horizon": True}, "horizon", "True"),
    ({"start": [1.0, math.nan, 0.0]}, "start[1]", "nan"),
    ({"start": [1.0, 1.0]}, "start", "missing"),
    ({"start": [1.0, 1.0, None]}, "start[2]", "None"),
    ({"start": [4.0, 4.6, 0.0]}, "start", "(4, 4.6) is inside obstacles[0] (clearance -0.95 m)"),
    ({"start": [6.5, 3.7, 0.0]}, "start", "obstacles[1]"),
    ({"start": [0.1, 5.0, 0.0]}, "start", "the arena wall (clearance -0.15 m)"),
    ({"goal": [4.0, 4.5, 0.0]}, "goal", "obstacles[0]"),
    ({"arena": [0, 0, 0, 10]}, "arena", "(0, 0, 0, 10)"),
    ({"speed": 3}, "speed", "3"),
    ({"robot": {"radius": 0.2, "colour": "red"}}, "robot.colour", "'red'"),
    ({"robot": {"model": "boat"}}, "robot.model", "'boat'"),
    ({"robot": {"radius": 0}}, "robot.radius", "got 0"),
    ({"cost": {"proximity_scale": 0.0}}, "cost.proximity_scale", "got 0.0"),
    ({"self": 1}, "self", "unknown field"),
    ({"two\nlines": 1}, "two lines", "unknown field"),
    ({"cost": {"turn_weight": -1}}, "cost.turn_weight", "-1"),
    ({"obstacles": [{}]}, "obstacles[0]", "exactly one"),
    ({"obstacles": [{**square(5, 5), "circle": {"center": [5, 5], "radius": 1}}]}, "obstacles[0]", "exactly one"),
    ({"obstacles": [{"circle": {"center": [5, 5], "radius": -1}}]}, "obstacles[0].circle.radius", "-1"),
    (
        {"obstacles": [square(2, 2), {"polygon": {"vertices": [[5, 5], [6, 5], [5.1, 5.1], [5, 6]]}}]},
        "obstacles[1].polygon.vertices",
        "not strictly convex",
    ),
    (
        {"obstacles": [{"polygon": {"vertices": [[5, 6], [5.6, 4.2], [4.1, 5.3], [5.9, 5.3], [4.4, 4.2]]}}]},
        "obstacles[0].polygon.vertices",
        "not strictly convex",
    ),
    ({"obstacles": [{"polygon": {"vertices": [[5, 5], [6, 5]]}}]}, "obstacles[0].polygon.vertices", "2"),
    ({"obstacles": [{"polygon": {"vertices": [[5, 5], [6, 6], [7, 7]]}}]}, "obstacles[0]", "not strictly convex"),
    ({"obstacles": 3}, "obstacles", "3"),
    ({"name": 3}, "name", "3"),
]


@pytest.mark.parametrize(("changes", "field", "value"), FAULTS, ids=lambda v: v if isinstance(v, str) else "")
def test_the_error_for_an_invalid_scenario_names_field_and_value(changes, field, value):
    with pytest.raises(ScenarioError) as error:
        Scenario.from_dict(scenario_fields(**changes))
    message = str(error.value)
    assert "\n" not in message
    assert f": {field}" in message
    assert value in message.partition(field)[2]


@pytest.mark.parametrize(
    "text", ["{", '{"horizon": ' + "9" * 5000 + "}", '{"horizon": 1, "horizon": 2}', "{'a': 1}", '{"a": ' * 5000]
)
def test_text_that_is_no_scenario_is_reported_in_one_line(text):
    with pytest.raises(ScenarioError) as error:
        Scenario.from_json(text)
    assert "\n" not in str(error.value)


def test_a_missing_field_is_named():
    fields = scenario_fields()
    del fields["goal"]
    with pytest.raises(ScenarioError, match=r"Scenario 'small': goal: missing"):
        Scenario.from_json(json.dumps(fields))
