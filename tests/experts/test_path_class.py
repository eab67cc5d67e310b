import numpy as np
import pytest
from helpers import scenario_fields

from leapnav.envs import Scenario, sample_scenario
from leapnav.experts import find_optimum
from leapnav.experts.search.path_class import driving_modes, heading_winding, path_sides

# A polygon before a disc in the file; circles are packed first, so the packed order differs from that of the file.
OBSTACLES = [
    {"polygon": {"vertices": [[4.0, 6.0], [5.0, 6.0], [5.0, 7.0], [4.0, 7.0]]}},
    {"circle": {"center": [4.5, 3.0], "radius": 0.5}},
]


def test_sides_are_those_seen_by_the_driver_in_the_order_of_the_file():
    field = Scenario.from_dict(scenario_fields(obstacles=OBSTACLES)).field
    line = np.linspace([1.0, 5.0], [9.0, 5.0], 50)
    assert path_sides(np.zeros(50), line, field) == ("left", "right")
    assert path_sides(np.zeros(50), line[::-1], field) == ("right", "left")


def test_passing_an_obstacle_on_the_other_side_changes_only_its_side():
    field = Scenario.from_dict(scenario_fields(obstacles=OBSTACLES)).field
    shares = np.linspace(0.0, 1.0, 200)
    over = np.column_stack([1.0 + 8.0 * shares, 5.0 + 4.0 * np.sin(np.pi * shares)])
    assert path_sides(shares, over, field) == ("right", "right")


@pytest.mark.parametrize(
    ("speeds", "modes"),
    [
        (np.ones(100), ("forward",)),
        (-np.ones(100), ("backward",)),
        (np.concatenate([np.ones(50), -np.ones(50)]), ("forward", "backward")),
        (np.cos(np.linspace(0, 2 * np.pi, 100)), ("forward", "backward", "forward")),
        # A backward section of a centimetre between two long ones is ignored.
        (np.concatenate([np.ones(50), [-0.05, -0.05], np.ones(48)]), ("forward",)),
        (np.zeros(100), ()),
    ],
)
def test_driving_modes_are_listed_in_order(speeds, modes):
    assert driving_modes(np.linspace(0.0, 10.0, 100), speeds) == modes


@pytest.mark.parametrize(
    ("turn", "winding"), [(0.5, 0), (-3.0, 0), (3.5, 1), (-3.5, -1), (2 * np.pi + 0.5, 1), (-4 * np.pi - 1.0, -2)]
)
def test_winding_counts_the_turns_beyond_the_smaller_angle(turn, winding):
    assert heading_winding(1.0 + np.linspace(0.0, turn, 30)) == winding


def test_alternatives_are_distinct_certified_and_in_order():
    found = 0
    for seed in range(910_060, 910_070):
        optimum = find_optimum(sample_scenario("clutter", seed))
        costs = [optimum.cost, *(other.cost for other in optimum.alternatives)]
        assert costs == sorted(costs)
        found += len(optimum.alternatives)
        for number, other in enumerate(optimum.alternatives):
            assert other.success
            assert not other.alternatives
            assert len(other.path_class) == len(optimum.path_class)
            assert set(other.driving_modes) <= {"forward", "backward"}
            times = np.linspace(0.0, other.problem.horizon, 50)
            for earlier in (optimum, *optimum.alternatives)[: number + 1]:
                same_cost = abs(other.cost - earlier.cost) < 1e-6 * earlier.cost
                gap = np.abs(other.evaluate(times)[0] - earlier.evaluate(times)[0]).max()
                assert not same_cost or gap > 0.1
    assert found >= 10


def test_candidates_through_a_closed_passage_do_not_end_the_search():
    """The extremals through a passage with a clearance of 0.02 m cost 5.43; a detour costs 5.097."""
    optimum = find_optimum(sample_scenario("clutter", 910_065))
    assert optimum.cost < 5.0973
    assert optimum.path_class != optimum.alternatives[-1].path_class
