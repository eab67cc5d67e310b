import numpy as np
import pytest

from leapnav.envs import FAMILIES, NavigateEnv, NavigateVectorEnv, Scenario, ScenarioBank, sample_scenario
from leapnav.experts import ExpertPolicy, NoOptimumError, find_optimum
from leapnav.experts.acting.policy import plan_actions
from leapnav.experts.data.datasets import dataset_id, open_dataset
from leapnav.experts.data.demonstrations import demonstrate, load_demonstrations
from leapnav.experts.data.rollouts import rollout


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("demonstrations") / "clutter"
    summary = rollout("clutter", 4, out, seed=50, recoveries=3, progress=False)
    assert summary.demonstrations >= 4 + 6
    assert summary.failed_replays == 0
    return out


def test_replaying_the_optimum_succeeds_at_its_cost():
    env = NavigateEnv("clutter")
    for seed in range(20):
        scenario = sample_scenario("clutter", 700 + seed)
        extremal = find_optimum(scenario)
        demonstration = demonstrate(env, scenario, extremal)
        assert demonstration.is_success
        assert -demonstration.rewards.sum() == pytest.approx(extremal.cost, rel=1e-3)
        assert demonstration.running_cost.sum() == pytest.approx(extremal.cost, rel=1e-3)


@pytest.mark.parametrize("family", FAMILIES)
def test_replaying_the_optimum_succeeds_in_the_vector_form_too(family):
    bank = ScenarioBank.shipped(family, "test")
    robots = 4
    plans = [plan_actions(find_optimum(bank[i], "medium"), bank[i], 0.05) for i in range(robots)]
    venv = NavigateVectorEnv(robots, bank=bank, observation="state")
    venv.reset(options={"index": list(range(robots))})
    ended = np.zeros(robots, dtype=bool)
    for step in range(max(map(len, plans))):
        now = np.array([plan[min(step, len(plan) - 1)] for plan in plans])
        _, _, terminated, _, infos = venv.step(now)
        for i in np.flatnonzero(terminated & ~ended):
            assert step == len(plans[i]) - 1
            assert infos["is_success"][i]
            assert infos["cost"][i] == pytest.approx(bank.costs[i], rel=1e-3)
        ended |= terminated
    assert ended.all()


def test_the_error_of_a_replay_falls_with_the_square_of_the_control_period():
    scenario = sample_scenario("clutter", 701)
    extremal = find_optimum(scenario)
    errors = []
    for period in (0.1, 0.05, 0.025):
        env = NavigateEnv(scenario=scenario, control_period=period)
        states = demonstrate(env, scenario, extremal).states
        errors.append(np.abs(states[-1] - extremal.states[-1]).max())
    assert np.all(np.log2(np.array(errors[:-1]) / errors[1:]) > 1.7), errors


def test_the_expert_policy_drives_the_scenario_of_the_environment():
    env = NavigateEnv("clutter")
    expert = ExpertPolicy(env)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        terminated, total = False, 0.0
        while not terminated:
            action, _ = expert.predict(observation, deterministic=True)
            observation, reward, terminated, _, info = env.step(action)
            total += reward
        assert info["is_success"]
        assert -total == pytest.approx(find_optimum(env.scenario).cost, rel=1e-3)


def test_the_error_of_the_expert_names_the_unsolved_scenario():
    walls = tuple({"polygon": {"vertices": ((5.0, y), (5.5, y), (5.5, y + 5.0), (5.0, y + 5.0))}} for y in (0.0, 5.0))
    shut = Scenario(
        name="shut",
        arena=(0.0, 0.0, 10.0, 10.0),
        start=(2.0, 5.0, 0.0),
        goal=(8.0, 5.0, 0.0),
        horizon=9.0,
        obstacles=walls,
    )
    env = NavigateEnv(scenario=shut)
    observation, _ = env.reset()
    with pytest.raises(NoOptimumError, match="'shut': NO_PATH"):
        ExpertPolicy(env).predict(observation)


def test_plans_of_an_odd_horizon_cover_it():
    fields = sample_scenario("open", 1).to_dict()
    scenario = Scenario.from_dict({**fields, "horizon": 7.03})
    extremal = find_optimum(scenario)
    assert plan_actions(extremal, scenario, 0.05).shape == (141, 2)
    assert demonstrate(NavigateEnv(), scenario, extremal).is_success


def test_minari_alone_reads_the_dataset(folder, monkeypatch):
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    dataset = minari.load_dataset(dataset_id("clutter"))
    env = dataset.recover_environment()
    for episode in dataset.iterate_episodes([0, 5]):
        steps = len(episode.actions)
        assert episode.observations.shape == (steps + 1, *env.observation_space.shape)
        assert episode.terminations[-1]
        assert not episode.terminations[:-1].any()
        for name, shape in (("state", (3,)), ("costate", (3,)), ("cost_to_go", ()), ("running_cost", ())):
            assert episode.infos[name].shape == (steps + 1, *shape)
        # The episode's own options play it again, bit for bit.
        options = next(iter(dataset.storage.get_episode_metadata([episode.id])))["options"]
        observation, _ = env.reset(options=options)
        for k, action in enumerate(episode.actions):
            assert np.array_equal(observation, episode.observations[k])
            observation, reward, terminated, _, info = env.step(action)
            assert reward == episode.rewards[k]
        assert terminated
        assert info["is_success"]


def test_demonstrations_survive_the_dataset(folder):
    demonstrations = load_demonstrations(folder)
    first = demonstrations[0]
    assert first.scenario == sample_scenario("clutter", 50)
    extremal = find_optimum(first.scenario, "medium")
    again = demonstrate(NavigateEnv(), first.scenario, extremal)
    for name in ("observations", "actions", "rewards", "states", "costates", "cost_to_go", "running_cost"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes(), name
    assert first.reference_cost == extremal.cost


def test_recoveries_start_off_the_optimum_and_lead_to_the_same_goal(folder):
    demonstrations = load_demonstrations(folder)
    optimum = demonstrations[0]
    recoveries = [d for d in demonstrations if d.scenario.name.startswith(f"{optimum.scenario.name}-recovery")]
    assert recoveries
    for recovery in recoveries:
        assert recovery.scenario.goal == optimum.scenario.goal
        assert recovery.scenario.horizon < optimum.scenario.horizon
        distance = np.hypot(*(optimum.states[:, :2] - recovery.scenario.start[:2]).T).min()
        assert 0 < distance < 1.0
        assert -recovery.rewards.sum() == pytest.approx(recovery.reference_cost, rel=1e-2)


def test_a_rollout_does_not_depend_on_the_number_of_workers(folder, tmp_path):
    rollout("clutter", 2, tmp_path / "one", seed=50, recoveries=3, workers=1, progress=False)
    for one, other in zip(load_demonstrations(tmp_path / "one"), load_demonstrations(folder), strict=False):
        assert one.scenario == other.scenario
        assert one.actions.tobytes() == other.actions.tobytes()


def test_nothing_is_overwritten(folder):
    with pytest.raises(FileExistsError, match="holds a rollout whose"):
        rollout("clutter", 1, folder, progress=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"family": "moon"}, "family: .*'moon'"),
        ({"count": 0}, "count: .*0"),
        ({"recoveries": -1}, "recoveries: .*-1"),
        ({"workers": 0}, "workers: .*0"),
        ({"seed": -1}, "seed: .*-1"),
    ],
)
def test_bad_arguments_are_named(arguments, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        rollout(**{"family": "open", "count": 1, "out": tmp_path / "out", "progress": False, **arguments})
    assert not (tmp_path / "out").exists()


def test_a_folder_without_a_dataset_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected one Minari dataset, found 0"):
        open_dataset(tmp_path)
