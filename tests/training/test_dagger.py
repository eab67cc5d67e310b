import numpy as np
import pytest
from helpers import QUICK, fresh

from leapnav.envs import NavigateEnv, Scenario, sample_scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.experts import ExpertPolicy, find_optimum
from leapnav.training import CloningConfig, DAgger, DAggerConfig, Dataset, behaviour_clone, evaluate
from leapnav.training.environments.playing import PlayedEpisode
from leapnav.training.learning.driving import DrivenEpisode
from leapnav.training.learning.takeovers import Labeller, rest_of, scheduled_steps


def test_dagger_learns_what_the_expert_does_where_it_takes_over(dataset, env, tmp_path):
    """The samples are those of the optimum from states of the learner; rounds are stored on disk."""
    policy = fresh(env)
    behaviour_clone(policy, dataset, QUICK, progress=False)
    config = DAggerConfig(rounds=2, max_episodes=6, lead=1.0)
    dagger = DAgger(policy, "open", config, cloning=QUICK, dataset=dataset, folder=tmp_path / "rounds", robots=4)
    rounds = dagger.run(progress=False)
    assert [done.number for done in rounds] == [1, 2]
    assert all(done.episodes >= 4 for done in rounds)
    assert len(dagger.dataset) == len(dataset) + sum(done.samples for done in rounds)
    kept = Dataset.load(tmp_path / "rounds" / "round-001.npz")
    assert len(kept) == rounds[0].samples > 0
    assert kept.times.max() < config.lead
    for i in (0, len(kept) // 2, len(kept) - 1):
        scenario = Scenario.from_json(kept.scenarios[kept.episodes[i]])
        rest = scenario.model_copy(
            update={"start": tuple(kept.states[i].tolist()), "horizon": scenario.horizon - float(kept.times[i])}
        )
        one = NavigateEnv(scenario=rest)
        observation, _ = one.reset()
        assert observation == pytest.approx(kept.observations[i], abs=1e-4)
        expert = ExpertPolicy(one)
        assert expert.predict(observation)[0] == pytest.approx(kept.actions[i], abs=2e-2)
        assert -expert.value() == pytest.approx(kept.returns[i], rel=1e-4)
        assert expert.costate() == pytest.approx(kept.costates[i], abs=1e-2 * max(1, np.abs(kept.costates[i]).max()))


def driven(scenario, states, *, success=False, collision=False, costs=None):
    """An episode with given states."""
    count = len(states)
    played = PlayedEpisode(
        states=np.asarray(states, dtype=float),
        actions=np.zeros((count - 1, 2), np.float32),
        costs=np.zeros(count) if costs is None else costs,
        episode_return=0.0,
        clearance=0.1,
        duration=0.05 * (count - 1),
        success=success,
        collision=collision,
        truncated=False,
        goal_distance=1.0,
        heading_error=0.1,
    )
    return DrivenEpisode(scenario, played)


def test_the_expert_takes_over_before_the_failure_and_until_it_is_too_late():
    scenario = sample_scenario("clutter", 7)
    poses = np.linspace(scenario.start, scenario.goal, 101)
    rng = np.random.default_rng(0)
    crash = driven(scenario, poses, collision=True)
    steps = scheduled_steps(crash, 0.05, rng)
    assert len(steps) > 5 and steps == sorted(steps)
    for step in steps:
        assert 0.2 <= 5.0 - step * 0.05 <= 10.0
        rest = rest_of(crash, step, 0.05)
        assert rest.start == tuple(poses[step]) and rest.horizon == pytest.approx(scenario.horizon - step * 0.05)
        assert (rest.goal, rest.obstacles) == (scenario.goal, scenario.obstacles)
    assert len(scheduled_steps(driven(scenario, poses, success=True), 0.05, rng)) == 1
    late = driven(scenario, np.linspace(scenario.start, scenario.goal, round(scenario.horizon / 0.05) + 1))
    assert rest_of(late, len(late.played.states) - 15, 0.05) is None  # less than 1 s before the horizon


def test_with_a_free_horizon_the_expert_takes_over_where_the_robot_stops():
    scenario = sample_scenario("clutter", 7, horizon="free")
    moving, still = np.linspace(scenario.start, scenario.goal, 100), np.tile(scenario.goal, (300, 1))
    episode = driven(scenario, np.concatenate([moving, still]))
    starts = [rest_of(episode, step, 0.05) for step in scheduled_steps(episode, 0.05, np.random.default_rng(0))]
    assert len(starts) > 5 and all(rest.start in map(tuple, moving) for rest in starts[:-2])
    assert scenario.goal in [rest.start for rest in starts]  # where it has stopped
    assert starts[0].time_limit == scenario.time_limit


def test_takeovers_after_the_first_one_without_an_optimum_are_skipped():
    """A robot that drives away from the goal until it is too late to return."""
    scenario = sample_scenario("open", 7)
    steps = np.arange(round(scenario.horizon / 0.05) + 1)
    states = np.array(scenario.start) * np.ones((len(steps), 1))
    labeller = Labeller(EnvironmentSettings(), DAggerConfig().lead, "low")
    parts = labeller.label(driven(scenario, states), np.random.default_rng(0))
    left = [Scenario.from_json(part.scenarios[0]).horizon for part in parts]
    assert left and left == sorted(left, reverse=True)
    assert not find_optimum(rest_of(driven(scenario, states), len(steps) - 25, 0.05)).success
    assert left[-1] > find_optimum(scenario).horizon / 4


@pytest.mark.slow
def test_dagger_is_the_same_with_any_number_of_workers(env, monkeypatch):
    monkeypatch.setattr("leapnav.training.learning.dagger.LABELLED_PER_TASK", 1)
    found = []
    for workers in (1, 2):
        policy = fresh(env)
        config = DAggerConfig(rounds=1, max_episodes=2, max_failures=1, lead=0.5, seed=4)
        dagger = DAgger(policy, "open", config, cloning=QUICK, robots=1, workers=workers)
        dagger.run(progress=False)
        found.append((policy.parameters_to_vector().tobytes(), dagger.dataset.observations.tobytes()))
    assert found[0] == found[1]


@pytest.mark.parametrize(
    "settings", [{"rounds": 0}, {"max_failures": 0}, {"successes": -1.0}, {"learning_rate": -1.0}, {"lead": 0.0}]
)
def test_bad_settings_of_dagger_are_named(settings, env):
    with pytest.raises(ValueError, match=f"{next(iter(settings))}: "):
        DAgger(fresh(env), "open", DAggerConfig(**settings))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"workers": 0}, "workers: expected at least 1, got 0"),
        ({"robots": 0}, "robots: expected at least 1, got 0"),
        ({"effort": "some"}, "effort: expected one of low, medium, high, got 'some'"),
        ({"environment": {"disturbance": 0.1}}, "environment: expected one without disturbances"),
        ({"environment": {"actuation": "motor"}}, "environment: expected one without motors"),
        ({"environment": {"reward": "shaped"}}, "dataset: reward: expected that of the environment, 'shaped', got"),
    ],
)
def test_bad_arguments_of_dagger_are_named(arguments, message, env, dataset):
    with pytest.raises(ValueError, match=message):
        DAgger(fresh(env), "open", dataset=dataset, **arguments)


@pytest.mark.slow
def test_dagger_improves_a_clone(env, dataset):
    """A few rounds raise the success of a clone of few demonstrations in the test split."""
    policy = fresh(env)
    few = dataset[dataset.episodes < 4]
    behaviour_clone(policy, few, QUICK, progress=False)
    options = {"environment": {"lidar_beams": 32}, "timed": False, "progress": False, "count": 40}
    before = evaluate(policy, "open", **options)
    config = DAggerConfig(rounds=1, max_failures=25, max_episodes=100, last_epochs=12)
    dagger = DAgger(policy, "open", config, cloning=CloningConfig(batch_size=128), dataset=few)
    dagger.run(progress=False)
    after = evaluate(policy, "open", **options)
    assert after.success > before.success + 0.15
    assert after.soc > before.soc + 0.1
