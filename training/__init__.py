"""Learning from the optimum, and the score that says how near a policy comes to it."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from leapnav.training.baselines import GoToGoal, RandomPolicy
    from leapnav.training.cloning import EpochLoss, behaviour_clone
    from leapnav.training.config import (
        BCConfig,
        CloningConfig,
        DAggerConfig,
        DAggerRunConfig,
        PPOConfig,
        SACConfig,
        WarmStartConfig,
    )
    from leapnav.training.dagger import DAgger
    from leapnav.training.dataset import Dataset
    from leapnav.training.evaluation import Episode, Evaluation, Policy, evaluate
    from leapnav.training.html_report import write_report
    from leapnav.training.imitation import train_bc, train_dagger
    from leapnav.training.policies import (
        NavigationFeatures,
        load_policy,
        make_policy,
        network,
        policy_environment,
        save_policy,
        shipped_policies,
    )
    from leapnav.training.reinforcement import train_ppo, train_sac
    from leapnav.training.replay import DemonstrationReplayBuffer, imitate
    from leapnav.training.scores import Interval, Score, profile, score
    from leapnav.training.vec_env import NavigateVecEnv, make_vec_env
    from leapnav.training.warmstart import WarmStart, warm_start

__all__ = [
    "BCConfig",
    "CloningConfig",
    "DAgger",
    "DAggerConfig",
    "DAggerRunConfig",
    "Dataset",
    "DemonstrationReplayBuffer",
    "Episode",
    "EpochLoss",
    "Evaluation",
    "GoToGoal",
    "Interval",
    "NavigateVecEnv",
    "NavigationFeatures",
    "PPOConfig",
    "Policy",
    "RandomPolicy",
    "SACConfig",
    "Score",
    "WarmStart",
    "WarmStartConfig",
    "behaviour_clone",
    "evaluate",
    "imitate",
    "load_policy",
    "make_policy",
    "make_vec_env",
    "network",
    "policy_environment",
    "profile",
    "save_policy",
    "score",
    "shipped_policies",
    "train_bc",
    "train_dagger",
    "train_ppo",
    "train_sac",
    "warm_start",
    "write_report",
]

# Loaded when first used: torch takes seconds, which `leapnav solve` and `leapnav --help` need not spend.
_MODULES = {
    "baselines": ("GoToGoal", "RandomPolicy"),
    "cloning": ("EpochLoss", "behaviour_clone"),
    "config": (
        "BCConfig",
        "CloningConfig",
        "DAggerConfig",
        "DAggerRunConfig",
        "PPOConfig",
        "SACConfig",
        "WarmStartConfig",
    ),
    "dagger": ("DAgger",),
    "dataset": ("Dataset",),
    "evaluation": ("Episode", "Evaluation", "Policy", "evaluate"),
    "policies": (
        "NavigationFeatures",
        "load_policy",
        "make_policy",
        "network",
        "policy_environment",
        "save_policy",
        "shipped_policies",
    ),
    "html_report": ("write_report",),
    "imitation": ("train_bc", "train_dagger"),
    "reinforcement": ("train_ppo", "train_sac"),
    "replay": ("DemonstrationReplayBuffer", "imitate"),
    "scores": ("Interval", "Score", "profile", "score"),
    "vec_env": ("NavigateVecEnv", "make_vec_env"),
    "warmstart": ("WarmStart", "warm_start"),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"leapnav.training.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
