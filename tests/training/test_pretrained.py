import gymnasium as gym
import numpy as np
import pytest

from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.training import evaluate, load_policy, policy_environment, shipped_policies
from leapnav.training.policies.files import SHIPPED, read_description
from leapnav.training.scoring.policy_specs import load_policy_spec


def test_the_policies_that_ship_are_small():
    assert sum(file.stat().st_size for file in SHIPPED.glob("*/*")) < 4_000_000
    assert {folder.name for folder in SHIPPED.iterdir()} == set(shipped_policies())


@pytest.mark.parametrize("name", shipped_policies())
def test_a_policy_that_ships_is_loaded_by_its_name_and_drives(name):
    policy, sensors = load_policy(name), policy_environment(name)
    env = gym.make("leapnav/Navigate-v0", family="open", **sensors)
    observation, _ = env.reset(seed=0)
    assert env.action_space.contains(policy.predict(observation, deterministic=True)[0])
    family = name.rpartition("-")[2]  # after the robot, if it is not the unicycle
    families = ALL_FAMILIES if family == "all" else (family,)
    found = [evaluate(policy, family, count=60, environment=sensors, progress=False) for family in families]
    min_success = 0.95 if name in (*ALL_FAMILIES, "all") else 0.85
    assert np.mean([evaluation.success for evaluation in found]) >= min_success
    assert read_description(name)["training"]["family"] == family


def test_a_shipped_policys_name_is_a_policy_wherever_one_is_asked_for(tmp_path, monkeypatch):
    name = shipped_policies()[0]
    assert load_policy_spec(name).environment == policy_environment(name)
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).mkdir()  # a directory takes precedence over a shipped policy
    with pytest.raises(FileNotFoundError, match=f"{name}/policy.json"):
        load_policy(name)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_policy("nowhere")
