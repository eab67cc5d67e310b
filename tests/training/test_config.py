from dataclasses import fields, replace
from pathlib import Path

import pytest

from leapnav.training.config import ALGORITHMS, PROFILES, BCConfig, DAggerConfig, DAggerRunConfig, PPOConfig, SACConfig


def test_a_run_that_starts_from_a_policy_has_its_observation():
    for start in ("clutter", Path("clutter"), (Path("clutter"),)):
        config = PPOConfig.tuned("clutter", warm_start=start)
        assert (config.observation, config.lidar_beams) == ("geodesic", 64)
    given = DAggerRunConfig.tuned("clutter", observation="lidar")
    inherited = DAggerRunConfig.tuned("clutter", policy=Path("clutter-lidar"))
    assert inherited.observation == "lidar" and inherited.dagger == given.dagger
    assert DAggerRunConfig.tuned("slalom", policy=Path("slalom-lidar")).components == 1  # not that of the profile
    warm = PPOConfig.tuned("clutter", warm_start=(Path("free-clutter"),))
    assert warm.task["horizon"] == "free" and warm.environment["previous_action"]
    assert PPOConfig.tuned("clutter", warm_start=(Path("car-clutter"),)).task["robot"] == "car"


def test_a_profile_contains_all_settings_of_its_algorithm():
    for name, profile in PROFILES.items():
        algorithm = ALGORITHMS[name.partition("-")[0]]
        assert isinstance(algorithm.tuned("open"), algorithm)
        if algorithm is DAggerRunConfig:
            assert set(profile["dagger"]) == {field.name for field in fields(DAggerConfig)} - {"seed"}
            continue
        own = set(algorithm.__annotations__) - set(BCConfig.__annotations__)
        unset = {"gamma", "levels", "level_bank", "algorithm", "evaluate_every", "checkpoint_every"}
        assert own - unset <= set(profile) <= {field.name for field in fields(algorithm)}


def test_the_start_of_a_run_determines_its_profile():
    for kind in ALGORITHMS.values():
        assert kind.tuned("slalom") == kind(out=Path(), family="slalom")
    warm, motors = PPOConfig.tuned("clutter", warm=True), PPOConfig.tuned("clutter", warm=True, actuation="motor")
    assert (warm.reward, warm.std, motors.std, motors.total_timesteps) == ("cost", 0.1, 0.15, 2_500_000)
    assert PPOConfig.tuned("clutter", warm=True, seed=7).seed == 7
    assert PPOConfig.tuned("clutter", actuation="motor").std == PPOConfig.std
    sac = SACConfig.tuned("clutter", warm=True, actuation="motor")
    assert sac == replace(SACConfig.tuned("clutter", warm=True), actuation="motor")
    assert sac.imitation == 50.0
    lidar = DAggerRunConfig.tuned("clutter", observation="lidar")
    assert lidar.dagger.rounds > DAggerConfig.rounds and lidar.components == 4
    with pytest.raises(ValueError, match="town"):
        PPOConfig.tuned("town")


@pytest.mark.parametrize(("kind", "fixed", "free"), [(PPOConfig, 1.0, 0.995), (SACConfig, 0.99, 0.999)])
def test_the_discount_depends_on_whether_the_time_left_is_observed(kind, fixed, free):
    assert kind(out=Path()).discount == fixed
    config = kind.tuned("clutter", horizon="free", warm=True)
    assert config.discount == free and config.environment["horizon"] == "free"
    assert replace(config, gamma=0.9).discount == 0.9


def test_the_number_of_beams_depends_on_the_observation():
    for kind in (BCConfig, DAggerRunConfig, SACConfig):
        for observation, beams in (("geodesic", 64), ("lidar", 128)):
            assert kind(out=Path(), observation=observation).environment["lidar_beams"] == beams
    assert BCConfig(out=Path(), lidar_beams=32).environment["lidar_beams"] == 32
    assert PPOConfig(out=Path()).environment["lidar_beams"] == 32
