import os
import sys
from functools import partial
from pathlib import Path

import gymnasium as gym
import pytest
from filelock import FileLock
from hypothesis import HealthCheck, settings

from leapnav.envs.robots.base import MODELS
from leapnav.envs.scenarios.families import REGISTERED
from leapnav.envs.shapes.base import KINDS

sys.path.append(str(Path(__file__).parent))  # for `import helpers`
sys.path.append(str(Path(__file__).parent.parent / "examples"))  # for the robot of `wagon_robot.py`

# The default number of processes: one, because starting others took 29 % of the CPU time of three files of tests with
# trainings and commands. The tests of several processes ask for them.
os.cpu_count = lambda: 1

# The default profile repeats the same examples; HYPOTHESIS_PROFILE=long generates many new ones.
settings.register_profile("default", max_examples=40, deadline=None, derandomize=True)
settings.register_profile("long", max_examples=10_000, deadline=None, suppress_health_check=list(HealthCheck))
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))


def shared_directory(tmp_path_factory, name, make):
    """A directory that one test process makes and all use."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # common to all workers of a run
    out = base / name
    with FileLock(base / f"{name}.lock"):
        if not out.exists():
            partial = base / f"{name}.partial"
            make(partial)
            partial.rename(out)
    return out


@pytest.fixture
def coarse_decisions(monkeypatch):
    """Reports search the optimum every 2 s of an episode; `test_decisions.py` covers the usual resolution."""
    from leapnav.training.scoring import decision_reports

    monkeypatch.setattr(decision_reports, "decisions_of", partial(decision_reports.decisions_of, resolution=2.0))


@pytest.fixture(scope="session")
def demonstrated(tmp_path_factory):
    """Directory with demonstrations of the open family."""
    from leapnav.experts.data.rollouts import rollout

    def make(out):
        rollout("open", 40, out, seed=300, recoveries=1, progress=False)

    return shared_directory(tmp_path_factory, "demonstrated", make)


@pytest.fixture(scope="session")
def dataset(demonstrated):
    from leapnav.training import Dataset

    return Dataset.of(demonstrated)


@pytest.fixture(scope="session")
def clone(dataset, tmp_path_factory):
    """Policy cloned from the demonstrations, and the losses of its epochs."""
    import torch as th

    from leapnav.envs import NavigateEnv
    from leapnav.training import CloningConfig, EpochLoss, behaviour_clone, make_policy

    env = NavigateEnv("open")
    policy = make_policy(env.observation_space, env.action_space, seed=0, hidden=(128, 128))

    def make(out):
        config = CloningConfig(epochs=30, batch_size=256, patience=0)
        losses = behaviour_clone(policy, dataset, config, progress=False)
        out.mkdir()
        th.save({"policy": policy.state_dict(), "losses": [vars(loss) for loss in losses]}, out / "clone.pt")

    state = th.load(shared_directory(tmp_path_factory, "clone", make) / "clone.pt", weights_only=True)
    policy.load_state_dict(state["policy"])
    policy.set_training_mode(False)
    return policy, [EpochLoss(**loss) for loss in state["losses"]]


@pytest.fixture
def env():
    return gym.make("leapnav/Navigate-v0", family="open")


@pytest.fixture(autouse=True)
def _few_scenarios(monkeypatch):
    """Final evaluations of training runs play 5 scenarios, and a test bank that they build has 5."""
    from leapnav.training.runs import run

    monkeypatch.setattr(run, "FINAL_SCENARIOS", 5)
    monkeypatch.setattr(run, "BANK_COUNT", 5)


@pytest.fixture(autouse=True)
def _registered():
    """Forget the robot models, obstacle shapes and families that a test registers."""
    registries = MODELS, KINDS, REGISTERED
    before = [dict(registry) for registry in registries]
    yield
    for registry, content in zip(registries, before, strict=True):
        registry.clear()
        registry.update(content)
