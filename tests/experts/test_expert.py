"""The expert in closed loop: from any state, with noise, with motors, after a push."""

import gymnasium as gym
import numpy as np
import pytest
from helpers import scenario_fields
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from leapnav.envs import FAMILIES, NavigateEnv, NavigateVectorEnv, Scenario, ScenarioBank
from leapnav.envs.field.clearance import footprint_clearance
from leapnav.experts import ExpertPolicy, NoOptimumError, Trajectory, find_optimum
from leapnav.experts.acting.feedback import Feedback
from leapnav.training import make_vec_env

SETTINGS = [{}, {"disturbance": {"actuation": 0.1}}, {"actuation": "motor"}]


def drive(env, expert, **reset):
    observation, info = env.reset(**reset)
    total, terminated = 0.0, False
    while not terminated:
        observation, reward, terminated, _, info = env.step(expert.predict(observation)[0])
        total += reward
    return total, info


@pytest.mark.parametrize("feedback", ["resolve", "gains"])
@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_the_expert_succeeds_under_disturbances(settings, feedback):
    regrets = []
    for family in list(FAMILIES)[: None if not settings else 5]:
        bank = ScenarioBank.shipped(family, "test")
        env = NavigateEnv(bank=bank, observation="state", **settings)
        expert = ExpertPolicy(env, feedback=feedback)
        for index in (20,):
            total, info = drive(env, expert, seed=index, options={"index": index})
            assert info["is_success"]
            assert total == pytest.approx(-info["cost"])
            regrets.append(info["cost"] / bank.costs[index] - 1)
    assert np.median(regrets) < (0.002 if not settings else 0.03)


def test_without_feedback_noise_causes_failures():
    env = NavigateEnv("clutter", split="test", disturbance={"actuation": 0.1})
    results = {}
    for feedback in ("none", "resolve"):
        expert = ExpertPolicy(env, feedback=feedback)
        results[feedback] = [drive(env, expert, seed=k, options={"index": k})[1]["is_success"] for k in range(8)]
    assert all(results["resolve"])
    assert not all(results["none"])


def test_the_expert_continues_after_a_push():
    """Half a metre and half a radian off, in the middle of an episode."""
    rng = np.random.default_rng(0)
    tried = 0
    for family in FAMILIES:
        bank = ScenarioBank.shipped(family, "test")
        for index in range(4):
            scenario, reference = bank[index], bank.reference(index)
            feedback = Feedback(scenario, Trajectory(reference.times, reference.states, reference.costates))
            k = int(rng.uniform(0.2, 0.6) * len(reference.times))
            direction = rng.uniform(-np.pi, np.pi)
            push = [0.5 * np.cos(direction), 0.5 * np.sin(direction), rng.choice([-0.5, 0.5])]
            state, time = reference.states[k] + push, float(reference.times[k])
            if footprint_clearance(np.append(state, time), scenario.outline, scenario.field)[0] < 0.1:
                continue
            tried += 1
            assert feedback.update(state, time)
            best = find_optimum(scenario.from_state(state, time))
            cost, _ = feedback.value(state, time)
            assert cost >= best.cost - 1e-6
            assert cost <= 1.5 * best.cost + 0.5
    assert tried > 8


@pytest.mark.parametrize("family", FAMILIES)
def test_value_costate_and_return_agree(family):
    bank = ScenarioBank.shipped(family, "test")
    env = NavigateEnv(bank=bank, observation="state")
    expert = ExpertPolicy(env)
    observation, _ = env.reset(options={"index": 30})
    value = expert.value()
    assert value == pytest.approx(bank.costs[30], rel=1e-6)
    spent = 0.0
    for _ in range(40):
        observation, reward, *_ = env.step(expert.predict(observation)[0])
        spent -= reward
    assert spent + expert.value() == pytest.approx(value, rel=5e-4)
    state, h = np.add(env.pose, (0.01, -0.01, 0.02)), 3e-4
    differences = [(expert.value(state + h * e) - expert.value(state - h * e)) / (2 * h) for e in np.eye(3)]
    assert expert.costate(state) == pytest.approx(differences, abs=1e-4 * max(1.0, np.abs(differences).max()))
    later = env.time + 1.0
    assert expert.value(state, later) > expert.value(state)  # less time, more effort
    assert expert.value() == pytest.approx(value - spent, rel=5e-4)  # asking changes nothing


def test_the_gains_are_the_slope_of_the_costate():
    bank = ScenarioBank.shipped("clutter", "test")
    reference = bank.reference(3)
    feedback = Feedback(bank[3], Trajectory(reference.times, reference.states, reference.costates))
    gains = feedback.gains()
    for k in (0, 20, len(gains.times) // 2):
        time, state, h = gains.times[k], gains.extremal[k, :3], 1e-5
        slope = [(feedback.value(state + h * e, time)[1] - feedback.value(state - h * e, time)[1]) for e in np.eye(3)]
        slope = np.array(slope).T / (2 * h)
        assert gains.slopes[k] == pytest.approx(slope, abs=1e-3 * np.abs(slope).max())
        assert gains.slopes[k] == pytest.approx(gains.slopes[k].T, abs=1e-5 * np.abs(slope).max())  # a Hessian


def test_many_robots_get_what_each_would_get_alone():
    arguments = {"family": "rooms", "observation": "state", "disturbance": {"actuation": 0.1}}
    venv = NavigateVectorEnv(10, autoreset_mode="SameStep", **arguments)
    expert = ExpertPolicy(venv, workers=2)
    envs = [NavigateEnv(**arguments) for _ in range(10)]
    experts = [ExpertPolicy(env) for env in envs]
    observations, _ = venv.reset(seed=4)
    alone = [env.reset(seed=4 + i)[0] for i, env in enumerate(envs)]
    ended = 0
    for _ in range(130):
        actions, _ = expert.predict(observations)
        assert actions.shape == (10, 2)
        observations, _, terminated, _, _ = venv.step(actions)
        for i, env in enumerate(envs):
            action = experts[i].predict(alone[i])[0]
            assert np.array_equal(action, actions[i])
            alone[i], _, end, _, _ = env.step(action)
            if end:
                ended += 1
                alone[i], _ = env.reset()
        assert ended or not terminated.any()
    values, costates = expert.value(), expert.costate()
    assert values.shape == (10,)
    assert costates.shape == (10, 3)
    assert values[3] == pytest.approx(experts[3].value())
    assert ended > 0


def test_stable_baselines_evaluates_the_expert():
    ours = make_vec_env(n_envs=4, family="open", split="test")
    theirs = VecNormalize(
        DummyVecEnv([lambda: NavigateEnv("open", split="test")] * 1), norm_obs=True, norm_reward=False
    )
    for venv in (ours, theirs):
        venv.seed(0)
        mean, _ = evaluate_policy(ExpertPolicy(venv), venv, n_eval_episodes=4, warn=False)
        assert -6 < mean < 0


def test_the_expert_accepts_wrapped_environments():
    env = gym.make("leapnav/Navigate-v0", family="open", dict_observation=True)
    env = gym.wrappers.TimeLimit(gym.wrappers.FlattenObservation(env), 1000)
    assert drive(env, ExpertPolicy(env), seed=0)[1]["is_success"]
    synced = gym.make_vec("leapnav/Navigate-v0", num_envs=2, vectorization_mode="sync", family="open")
    observations, _ = synced.reset(seed=0)
    assert ExpertPolicy(synced).predict(observations)[0].shape == (2, 2)


def test_known_optima_are_used():
    task = Scenario.from_dict(scenario_fields())
    optimum = find_optimum(task)
    env = NavigateEnv(scenario=task)
    path = Trajectory(optimum.times, optimum.states, optimum.costates)
    total, info = drive(env, ExpertPolicy(env, {task: path}))
    assert info["is_success"]
    assert total == pytest.approx(-optimum.cost, rel=1e-3)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="feedback: expected one of resolve, gains, none, got 'pid'"):
        ExpertPolicy(NavigateEnv(), feedback="pid")
    with pytest.raises(TypeError, match="env: expected an environment of leapnav, got CartPoleEnv"):
        ExpertPolicy(gym.make("CartPole-v1"))
    env = NavigateEnv("open")
    env.reset(seed=0)
    expert = ExpertPolicy(env)
    with pytest.raises(ValueError, match=r"state: expected finite numbers of shape \(1, 3\)"):
        expert.value([1.0, 2.0])
    with pytest.raises(ValueError, match="time: expected a number from 0 to"):
        expert.value(time=1e9)
    with pytest.raises(ValueError, match="state: no optimum was found from"):
        expert.value([5.0, 5.0, 0.0], env.scenario.horizon - 1e-3)


def test_a_scenario_without_an_optimum_is_named():
    walls = [[4.9, 0.0], [5.0, 0.0], [5.0, 10.0], [4.9, 10.0]]
    task = scenario_fields(start=[2.0, 2.0, 0.0], goal=[8.0, 8.0, 0.0], obstacles=[{"polygon": {"vertices": walls}}])
    env = NavigateEnv(scenario=task)
    observation, _ = env.reset()
    with pytest.raises(NoOptimumError, match="NO_PATH"):
        ExpertPolicy(env).predict(observation)
