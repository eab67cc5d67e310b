"""Training of policies with the expert and by reinforcement learning, and their evaluation against the optimum."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from leapnav.training.config import BCConfig, DAggerRunConfig, PPOConfig, SACConfig
from leapnav.training.fit_settings import CloningConfig, DAggerConfig, WarmStartConfig

if TYPE_CHECKING:
    from leapnav.training.environments.level_samplers import (
        LearnabilitySampler,
        PrioritizedSampler,
        RegretSampler,
        UniformSampler,
        make_sampler,
    )
    from leapnav.training.environments.level_scoring import LevelScoring
    from leapnav.training.environments.vec_env import NavigateVecEnv, make_vec_env
    from leapnav.training.learning.cloning import EpochLoss, behaviour_clone
    from leapnav.training.learning.dagger import DAgger
    from leapnav.training.learning.dataset import Dataset
    from leapnav.training.learning.replay import DemonstrationReplayBuffer, imitate
    from leapnav.training.learning.warm_start import WarmStart, warm_start
    from leapnav.training.policies.baselines import GoToGoal, RandomPolicy
    from leapnav.training.policies.files import load_policy, policy_environment, save_policy, shipped_policies
    from leapnav.training.policies.network import NavigationFeatures, make_policy, network
    from leapnav.training.policies.planners import PlannerPolicy
    from leapnav.training.runs.imitation import train_bc, train_dagger
    from leapnav.training.runs.recording import record
    from leapnav.training.runs.reinforcement import train_ppo, train_sac
    from leapnav.training.scoring.adapters import Policy, PolicyFactory
    from leapnav.training.scoring.comparison import Comparison, compare
    from leapnav.training.scoring.decisions import Decisions, PolicyRegret, regret
    from leapnav.training.scoring.evaluation import evaluate
    from leapnav.training.scoring.html_report import write_report
    from leapnav.training.scoring.reports import plot_episodes, plot_scores, print_scores
    from leapnav.training.scoring.results import Episode, Evaluation, read_episodes, write_episodes
    from leapnav.training.scoring.scores import Interval, Limits, Score, profile, score

__all__ = [
    "BCConfig",
    "CloningConfig",
    "Comparison",
    "DAgger",
    "DAggerConfig",
    "DAggerRunConfig",
    "Dataset",
    "Decisions",
    "DemonstrationReplayBuffer",
    "Episode",
    "EpochLoss",
    "Evaluation",
    "GoToGoal",
    "Interval",
    "LearnabilitySampler",
    "LevelScoring",
    "Limits",
    "NavigateVecEnv",
    "NavigationFeatures",
    "PPOConfig",
    "PlannerPolicy",
    "Policy",
    "PolicyFactory",
    "PolicyRegret",
    "PrioritizedSampler",
    "RandomPolicy",
    "RegretSampler",
    "SACConfig",
    "Score",
    "UniformSampler",
    "WarmStart",
    "WarmStartConfig",
    "behaviour_clone",
    "compare",
    "evaluate",
    "imitate",
    "load_policy",
    "make_policy",
    "make_sampler",
    "make_vec_env",
    "network",
    "plot_episodes",
    "plot_scores",
    "policy_environment",
    "print_scores",
    "profile",
    "read_episodes",
    "record",
    "regret",
    "save_policy",
    "score",
    "shipped_policies",
    "train_bc",
    "train_dagger",
    "train_ppo",
    "train_sac",
    "warm_start",
    "write_episodes",
    "write_report",
]

# Names of modules that import torch, which takes seconds; `leapnav solve` and `leapnav --help` do not need it. They are
# imported at first use. The imports above are for type checkers, which do not evaluate `__getattr__`.
_LAZY = {
    "learning.cloning": ("EpochLoss", "behaviour_clone"),
    "learning.dagger": ("DAgger",),
    "learning.dataset": ("Dataset",),
    "runs.recording": ("record",),
    "learning.replay": ("DemonstrationReplayBuffer", "imitate"),
    "learning.warm_start": ("WarmStart", "warm_start"),
    "policies.baselines": ("GoToGoal", "RandomPolicy"),
    "policies.files": ("load_policy", "policy_environment", "save_policy", "shipped_policies"),
    "policies.planners": ("PlannerPolicy",),
    "policies.network": ("NavigationFeatures", "make_policy", "network"),
    "environments.level_samplers": (
        "LearnabilitySampler",
        "PrioritizedSampler",
        "RegretSampler",
        "UniformSampler",
        "make_sampler",
    ),
    "environments.level_scoring": ("LevelScoring",),
    "environments.vec_env": ("NavigateVecEnv", "make_vec_env"),
    "runs.imitation": ("train_bc", "train_dagger"),
    "runs.reinforcement": ("train_ppo", "train_sac"),
    "scoring.comparison": ("Comparison", "compare"),
    "scoring.decisions": ("Decisions", "PolicyRegret", "regret"),
    "scoring.adapters": ("Policy", "PolicyFactory"),
    "scoring.evaluation": ("evaluate",),
    "scoring.results": ("Episode", "Evaluation", "read_episodes", "write_episodes"),
    "scoring.html_report": ("write_report",),
    "scoring.reports": ("plot_episodes", "plot_scores", "print_scores"),
    "scoring.scores": ("Interval", "Limits", "Score", "profile", "score"),
}


def __getattr__(name: str) -> Any:
    for module, names in _LAZY.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
