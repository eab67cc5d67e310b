import math

import numpy as np
import pytest

from leapnav.envs import FAMILIES, sample_scenario
from leapnav.envs.field.clearance import clearance
from leapnav.envs.scenarios.families import ALL_FAMILIES


@pytest.mark.parametrize("family", FAMILIES)
def test_the_same_seed_gives_the_same_scenario(family):
    assert sample_scenario(family, 3) == sample_scenario(family, 3)
    assert sample_scenario(family, 3) != sample_scenario(family, 4)
    first, second = (sample_scenario(family, np.random.default_rng(5)) for _ in range(2))
    assert first == second


@pytest.mark.parametrize("family", FAMILIES)
def test_sampling_leaves_the_global_generator_alone(family):
    before = np.random.get_state()[1].copy()
    sample_scenario(family, 0)
    assert np.array_equal(before, np.random.get_state()[1])


@pytest.mark.parametrize("family", FAMILIES)
def test_scenarios_are_neither_trivial_nor_rushed(family):
    for seed in range(50 if family in ALL_FAMILIES else 8):  # the others are sampled more slowly
        scenario = sample_scenario(family, seed)
        distance = math.dist(scenario.start[:2], scenario.goal[:2])
        x_min, y_min, x_max, y_max = scenario.arena
        assert distance >= 0.4 * min(x_max - x_min, y_max - y_min)
        assert distance / scenario.horizon <= 0.81  # 0.8 m/s, and the horizon is rounded to 0.1 s
        for pose in (scenario.start, scenario.goal):
            assert clearance(pose[0], pose[1], scenario.field)[0] >= 0.24  # 0.25 m before rounding


def test_clutter_is_6_to_12_discs_and_open_is_empty():
    counts = {len(sample_scenario("clutter", seed).obstacles) for seed in range(100)}
    assert counts == set(range(6, 13))
    assert sample_scenario("open", 0).obstacles == ()


def test_an_unknown_family_is_named():
    known = "open, clutter, polygons, rooms, slalom, maze, corridors, all, module:function or a file .*"
    with pytest.raises(ValueError, match=f"family: expected one of {known}, got 'moon'"):
        sample_scenario("moon", 0)


def test_all_families_together_are_drawn_evenly():
    drawn = [sample_scenario("all", seed).name.split("-")[0] for seed in range(300)]
    assert set(drawn) == set(ALL_FAMILIES)
    assert all(drawn.count(family) > 40 for family in ALL_FAMILIES)
    assert sample_scenario("all", 5) == sample_scenario("all", 5)
