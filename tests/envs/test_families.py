import math

import numpy as np
import pytest

from leapnav.envs import FAMILIES, sample_scenario
from leapnav.envs.field.clearance import footprint_clearance, footprint_clearances
from leapnav.envs.field.packing import displacements
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.envs.scenarios.layouts.crowd import simulate_crowd
from leapnav.envs.scenarios.layouts.moving import MOVING_LAYOUTS


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
        for pose, time in ((scenario.start, 0.0), (scenario.goal, scenario.horizon)):
            state = np.array([*pose, time])
            assert footprint_clearance(state, scenario.outline, scenario.field)[0] >= 0.24  # 0.25 m before rounding


def test_clutter_is_6_to_12_discs_and_open_is_empty():
    counts = {len(sample_scenario("clutter", seed).obstacles) for seed in range(100)}
    assert counts == set(range(6, 13))
    assert sample_scenario("open", 0).obstacles == ()


def test_families_whose_obstacles_move():
    """Robots start and arrive undisturbed, and nothing moves in the other families."""
    for family in FAMILIES:
        scenarios = [sample_scenario(family, seed) for seed in range(3)]
        assert all(scenario.moves == (family in MOVING_LAYOUTS) for scenario in scenarios)
    for family in MOVING_LAYOUTS:
        for seed in range(3):
            scenario = sample_scenario(family, seed)
            for pose, first in ((scenario.start, 0.0), (scenario.goal, scenario.horizon - 1.0)):
                states = np.array([[*pose, first + share] for share in np.linspace(0.0, 1.0, 11)])
                assert footprint_clearances(states, scenario.outline, scenario.field).min() >= 0.2
            free = sample_scenario(family, seed, horizon="free")
            assert free.obstacles == scenario.obstacles and free.start == scenario.start
            assert sample_scenario(family, seed, obstacles="hard").obstacles == scenario.obstacles


def test_pedestrians_of_a_crowd_keep_apart_and_walk():
    times = np.arange(0.0, 20.0, 0.5)
    paths = simulate_crowd(np.random.default_rng(0), 10, times)
    assert paths.shape == (40, 10, 2)
    apart = np.linalg.norm(paths[:, :, None] - paths[:, None], axis=-1) + 10 * np.eye(10)
    assert (apart[4:] < 0.4).mean() < 0.01  # they may start anywhere
    speeds = np.linalg.norm(np.diff(paths, axis=0), axis=-1) / 0.5
    assert 0.3 < speeds.mean() < 1.1 and speeds.max() < 1.5
    assert (simulate_crowd(np.random.default_rng(0), 10, times) == paths).all()


def test_sliding_doors_close_their_openings():
    scenario = sample_scenario("doors", 1)
    doors = [obstacle for obstacle in scenario.obstacles if obstacle.path is not None]
    assert 3 <= len(doors) <= 4
    for door in doors:
        offsets = displacements(door.knots, np.linspace(0.0, scenario.horizon, 400))
        lengths = np.ptp(door.shape.rounded_polygon()[0], axis=0)
        assert np.abs(offsets).max() == pytest.approx(lengths.max(), abs=1e-3)  # open is closed plus its length
        assert (np.abs(offsets).min(axis=0) == 0.0).all()


def test_an_unknown_family_is_named():
    known = "open, clutter, .*, maze, corridors, crossing, traffic, crowd, doors, all, module:function or a file .*"
    with pytest.raises(ValueError, match=f"family: expected one of {known}, got 'moon'"):
        sample_scenario("moon", 0)


def test_all_families_together_are_drawn_evenly():
    drawn = [sample_scenario("all", seed).name.split("-")[0] for seed in range(300)]
    assert set(drawn) == set(ALL_FAMILIES)
    assert all(drawn.count(family) > 40 for family in ALL_FAMILIES)
    assert sample_scenario("all", 5) == sample_scenario("all", 5)
