import math

import gymnasium as gym
import numpy as np
import pytest

from leapnav.envs.scenarios.scenario import Circle, Obstacle, Scenario
from leapnav.training import make_vec_env

ARENA = (0.0, 0.0, 8.0, 8.0)
STILL = np.zeros((1, 2), np.float32)


def last_step(scenario, action=STILL, **arguments):
    """The reward and the infos of the last step of an episode."""
    venv = make_vec_env(n_envs=1, scenario=scenario, miss_penalty=30.0, **arguments)
    venv.reset()
    done = [False]
    while not done[0]:
        _, rewards, done, infos = venv.step(action)
    return rewards[0], infos[0]


def scenario(start, goal):
    return Scenario(start=start, goal=goal, horizon=2.0, arena=ARENA)


@pytest.mark.parametrize(
    ("goal", "fraction"),
    [
        ((5.0, 4.0, 0.0), 0.2 + 0.1 * 1.0),
        ((4.0, 5.0, 1.5), 0.2 + 0.1 * (1.0 + 1.5)),
        ((4.2, 4.0, -3.0), 0.2 + 0.1 * (0.2 + 3.0)),
        ((7.0, 7.0, 3.0), 0.2 + 0.1 * (3 * math.sqrt(2) + 3.0)),
    ],
)
def test_a_miss_costs_the_more_the_farther_it_is(goal, fraction):
    task = scenario((4.0, 4.0, 0.0), goal)
    assert last_step(task)[0] == pytest.approx(-30.0)
    graded, info = last_step(task, graded_miss=True)
    assert graded == pytest.approx(-30.0 * min(1.0, fraction), rel=1e-5)
    assert info["reward_miss"] == pytest.approx(graded)


def test_a_miss_costs_no_more_than_the_penalty():
    task = scenario((0.5, 0.5, 0.0), (7.5, 7.5, 3.0))
    assert last_step(task, graded_miss=True)[0] == last_step(task)[0] == pytest.approx(-30.0, abs=0.05)


def test_the_reward_of_a_success_is_unchanged():
    task = scenario((4.0, 4.0, 0.0), (4.05, 4.0, 0.0))
    reward, info = last_step(task, graded_miss=True)
    assert info["is_success"]
    assert reward == last_step(task)[0] == 0.0


def test_a_free_heading_is_never_off():
    task = scenario((4.0, 4.0, 0.0), (5.0, 4.0, None))
    assert last_step(task, graded_miss=True)[0] == pytest.approx(-30.0 * 0.3, rel=1e-5)


def test_a_collision_has_its_full_penalty_and_that_of_a_graded_miss():
    disc = Obstacle(circle=Circle(center=(4.0, 4.0), radius=0.5))
    task = Scenario(start=(2.0, 4.0, 0.0), goal=(6.0, 4.0, 0.0), horizon=6.0, arena=ARENA, obstacles=(disc,))
    forwards = np.array([[1.0, 0.0]], np.float32)
    plain, info = last_step(task, action=forwards, collision_penalty=20.0)
    graded, _ = last_step(task, graded_miss=True, action=forwards, collision_penalty=20.0)
    assert info["collision"]
    away = math.hypot(*info["terminal_observation"][:2])
    assert graded - plain == pytest.approx(30.0 * (1 - 0.2 - 0.1 * away), rel=1e-5)


def test_a_scale_is_of_the_reward_alone():
    task = scenario((4.0, 4.0, 0.0), (5.0, 4.0, 0.0))
    reward, info = last_step(task, graded_miss=True, reward_scale=0.1)
    assert (reward, info["episode"]["r"]) == (pytest.approx(-0.9), pytest.approx(-9.0))


def test_goal_conditioned_rewards_are_scaled_and_not_graded():
    env = gym.make("leapnav/NavigateGoal-v0", family="open", reward="cost", reward_scale=0.5)
    env.reset(seed=0)
    _, reward, *_, info = env.step(np.ones(2, np.float32))
    assert reward == pytest.approx(0.5 * (info["reward_effort"] + info["reward_proximity"])) != 0.0
    with pytest.raises(ValueError, match="graded_miss: expected False for a goal-conditioned environment, got True"):
        gym.make("leapnav/NavigateGoal-v0", graded_miss=True)
