import os
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from hypothesis import HealthCheck, settings

sys.path.append(str(Path(__file__).parent))  # for `import helpers`

# The same cases each time; HYPOTHESIS_PROFILE=long makes many new ones.
settings.register_profile("default", max_examples=40, deadline=None, derandomize=True)
settings.register_profile("long", max_examples=10_000, deadline=None, suppress_health_check=list(HealthCheck))
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))


@pytest.fixture(scope="session")
def demonstrated(tmp_path_factory):
    """A folder of demonstrations of the open family."""
    from leapnav.experts.rollouts import rollout

    out = tmp_path_factory.mktemp("demonstrated") / "open"
    rollout("open", 40, out, seed=300, recoveries=1, workers=2, progress=False)
    return out


@pytest.fixture(scope="session")
def dataset(demonstrated):
    from leapnav.training import Dataset

    return Dataset.of(demonstrated)


@pytest.fixture(scope="session")
def clone(dataset):
    """A policy cloned from them, and the losses of its epochs."""
    from leapnav.envs import NavigateEnv
    from leapnav.training import CloningConfig, behaviour_clone, make_policy

    env = NavigateEnv("open")
    policy = make_policy(env.observation_space, env.action_space, seed=0)
    config = CloningConfig(epochs=60, batch_size=256, patience=0)
    return policy, behaviour_clone(policy, dataset, config, progress=False)


@pytest.fixture
def env():
    return gym.make("leapnav/Navigate-v0", family="open")
