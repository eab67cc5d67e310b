"""Geodesic distances and detours, and the observation that contains them."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from leapnav.envs import NavigateEnv, Scenario, sample_scenario
from leapnav.envs.geodesics import MAX_DETOUR, geodesic_distance, geodesic_map
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observations import observation_entries
from leapnav.envs.simulation.observer import Observer
from leapnav.experts import find_optimum
from leapnav.training import CloningConfig, Dataset, NavigationFeatures, load_policy, make_policy, policy_environment
from leapnav.training.learning.cloning import behaviour_clone
from leapnav.training.learning.takeovers import Labeller
from leapnav.training.policies.symmetries import mirror, time_reversal

ID, GOAL = "leapnav/Navigate-v0", 9
BEAMS = 16
WALLED = {
    "arena": [0, 0, 10, 10],
    "robot": {"radius": 0.25},
    "start": [2.0, 5.0, 0.0],
    "goal": [8.0, 5.0, 0.0],
    "horizon": 20.0,
    # A wall between start and goal, with a passage at the top
    "obstacles": [{"polygon": {"vertices": [[4.9, 0.0], [5.1, 0.0], [5.1, 8.0], [4.9, 8.0]]}}],
}


def geodesic_env(scenario, beams=BEAMS, **arguments):
    return NavigateEnv(scenario=scenario, observation="geodesic", lidar_beams=beams, **arguments)


def parts(observation, beams=BEAMS):
    """Ranges, detours and distance."""
    sensed = observation[GOAL:]
    return sensed[:beams], sensed[beams : 2 * beams], float(sensed[2 * beams])


def test_in_an_empty_arena_the_distance_is_the_straight_line():
    scenario = sample_scenario("open", 3)
    packed = geodesic_map(scenario.field, *scenario.goal[:2])
    for x, y in np.random.default_rng(0).uniform(2.0, 8.0, (50, 2)):
        straight = math.dist((x, y), scenario.goal[:2])
        # 1 % for the proximity cost of the walls, and the error of the grid (first order)
        assert straight * 0.99 - 0.02 <= geodesic_distance(x, y, packed) <= 1.03 * straight + 0.15


def test_the_distance_leads_around_a_wall_and_the_detours_show_the_passage():
    scenario = Scenario.from_dict(WALLED)
    _, detours, distance = parts(geodesic_env(scenario).reset()[0])
    around = math.dist((2, 5), (4.65, 8.25)) + 0.7 + math.dist((5.35, 8.25), (8, 5))
    assert 0.99 * around < distance < 1.15 * around
    angles = 2 * math.pi * np.arange(BEAMS) / BEAMS
    best = math.remainder(angles[detours.argmin()], 2 * math.pi)
    assert best == pytest.approx(math.atan2(3.25, 2.65), abs=math.pi / BEAMS + 0.01)
    # In the opposite direction, the path returns after 0.25 m.
    opposite = (detours.argmin() + BEAMS // 2) % BEAMS
    assert detours.min() < 0.05 and detours[opposite] == pytest.approx(0.5, abs=0.05)
    assert detours.max() <= MAX_DETOUR


def test_the_expert_drives_where_the_detour_is_small():
    scenario = sample_scenario("rooms", 12)
    optimum = find_optimum(scenario)
    env = geodesic_env(scenario, 32)
    observer = Observer(env.settings)
    times = np.linspace(0.0, 0.8 * optimum.horizon, 20)
    states, controls, _ = optimum.evaluate(times)
    seen = observer.observe([scenario] * len(times), states, times)
    assert observer.observe([scenario], states[:1], times[:1])[0] == pytest.approx(env.reset()[0], abs=1e-5)
    for row, (speed, _) in zip(seen, controls, strict=True):
        _, detours, _ = parts(row, 32)
        assert detours[0 if speed > 0 else 16] < 1.0
    distances = [parts(row, 32)[2] for row in seen]
    assert distances[0] > distances[-1]


def test_vector_and_single_environments_observe_the_same():
    scenarios = [sample_scenario(family, 5) for family in ("clutter", "rooms", "polygons")]
    venv = gym.make_vec(ID, 3, "vector_entry_point", split="fresh", observation="geodesic", lidar_beams=BEAMS)
    observations, _ = venv.reset(options={"scenario": scenarios})
    for scenario, observation in zip(scenarios, observations, strict=True):
        env = geodesic_env(scenario)
        assert np.array_equal(env.reset()[0], observation)
        assert env.observation_space.contains(observation)
        names = [entry.name for entry in observation_entries(env.settings)]
        assert len(names) == len(observation) and names[-1] == "distance"
        assert names[GOAL + BEAMS].startswith("detours[0]")
    moved, *_ = venv.step(np.tile([0.5, 0.2], (3, 1)))
    env.step(np.array([0.5, 0.2], np.float32))
    assert not np.array_equal(moved, observations)


def test_parts_as_a_dictionary():
    env = NavigateEnv("clutter", observation="geodesic", dict_observation=True)
    observation, _ = env.reset(seed=0)
    assert list(observation) == ["goal", "lidar", "detours", "distance"]
    assert env.observation_space.contains(observation)


def test_a_large_arena_has_a_coarser_grid():
    scenario = Scenario.from_dict({**WALLED, "arena": [-40, -40, 60, 60], "horizon": 60.0})
    packed = geodesic_map(scenario.field, *scenario.goal[:2])
    assert len(packed) < 45_000 and packed[2] == pytest.approx(0.5)
    assert geodesic_map(scenario.field, *scenario.goal[:2]) is packed  # kept


def test_goal_conditioned_environments_refuse_it():
    with pytest.raises(ValueError, match=r"observation: .*'geodesic'"):
        gym.make("leapnav/NavigateGoal-v0", observation="geodesic")


def mirrored(scenario):
    """The scenario mirrored at the line y = 5."""
    record = scenario.model_dump(mode="json", exclude_none=True)
    for pose in ("start", "goal"):
        x, y, heading = record[pose]
        record[pose] = [x, 10 - y, -heading]
    for obstacle in record["obstacles"]:
        x, y = obstacle["circle"]["center"]
        obstacle["circle"]["center"] = [x, 10 - y]
    return Scenario.from_dict(record)


def test_symmetries_move_the_detours_with_the_beams():
    scenario = sample_scenario("clutter", 8)
    env = geodesic_env(scenario)
    seen, settings = th.as_tensor(env.reset()[0])[None], env.settings
    action = th.tensor([[0.5, 0.2]])
    observation, changed = mirror(settings)(seen, action)
    expected = geodesic_env(mirrored(scenario)).reset()[0]
    assert observation[0].numpy() == pytest.approx(expected, abs=0.02)
    assert changed.tolist() == [[0.5, pytest.approx(-0.2)]]
    turned = scenario.model_copy(
        update={
            name: (*getattr(scenario, name)[:2], math.remainder(getattr(scenario, name)[2] + math.pi, 2 * math.pi))
            for name in ("start", "goal")
        }
    )
    observation, changed = time_reversal(settings)(seen, action)
    assert observation[0].numpy() == pytest.approx(geodesic_env(turned).reset()[0], abs=1e-3)
    assert changed.tolist() == [[-0.5, pytest.approx(0.2)]]


@pytest.mark.parametrize("horizon", ["fixed", "free"])
def test_features_and_cloning(horizon):
    scenario = sample_scenario("open", 4, horizon=horizon)
    settings = EnvironmentSettings(observation="geodesic", lidar_beams=BEAMS, horizon=horizon)
    samples = Labeller(settings, 3.0, "high").samples(scenario, find_optimum(scenario))
    env = geodesic_env(scenario)
    features = NavigationFeatures(env.observation_space)(th.as_tensor(samples.observations))
    assert features.shape == (60, features.shape[1]) and th.isfinite(features).all()
    assert features.shape[1] == NavigationFeatures(env.observation_space).features_dim
    policy = make_policy(env.observation_space, env.action_space, 0, (16, 16))
    config = CloningConfig(epochs=20, batch_size=16, validation_share=0.0)
    losses = behaviour_clone(policy, samples, config, progress=False)
    assert losses[-1].training < losses[0].training
    assert isinstance(samples, Dataset)


def test_the_included_policies_observe_it():
    assert policy_environment("rooms")["observation"] == "geodesic"
    env = NavigateEnv("rooms", split="test", **policy_environment("rooms"))
    policy = load_policy("rooms", env)
    (observation, _), done, info = env.reset(options={"index": 1}), False, {}
    while not done:
        observation, _, done, _, info = env.step(policy.predict(observation, deterministic=True)[0])
    assert info["is_success"]
